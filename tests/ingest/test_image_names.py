"""Names in tables: forgiving of folders, case and suffix, never of ambiguity or escape."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.core.errors import InputError
from pipelines.ingest.photo_folder import ImageNames

TABLE = Path("gcp_list.txt")
NAMES = ImageNames(["100/DJI_1.JPG", "100/DJI_2.JPG", "101/DJI_1.JPG", "top.png"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("100/DJI_1.JPG", "100/DJI_1.JPG"),
        ("100\\DJI_1.JPG", "100/DJI_1.JPG"),
        ("./top.png", "top.png"),
        ("DJI_2.JPG", "100/DJI_2.JPG"),
        ("photos/DJI_2.JPG", "100/DJI_2.JPG"),
        ("dji_2.jpg", "100/DJI_2.JPG"),
        ("TOP", "top.png"),
        ("absent.jpg", None),
        ("", None),
    ],
)
def test_ways_to_name_an_image(text: str, expected: str | None) -> None:
    assert NAMES.find(text, path=TABLE, line=3) == expected


@pytest.mark.parametrize("text", ["../top.png", "/etc/passwd", "100/../../top.png", "C:\\top.png"])
def test_paths_that_leave_the_folder(text: str) -> None:
    with pytest.raises(InputError, match=r"gcp_list\.txt:3 \[image\]: .* leaves the image folder"):
        NAMES.find(text, path=TABLE, line=3)


def test_ambiguity_is_an_error() -> None:
    with pytest.raises(InputError, match=r"may be 100/DJI_1\.JPG or 101/DJI_1\.JPG"):
        NAMES.find("DJI_1.JPG", path=TABLE, line=3)
