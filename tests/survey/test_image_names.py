"""Names in tables: forgiving of folders, case and suffix, never of ambiguity or escape."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.core.errors import InputError
from pipelines.survey.image_names import ImageNames
from tests.refusals import refused

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
    with refused("image-outside-folder", InputError) as error:
        NAMES.find(text, path=TABLE, line=3)
    assert str(error.value).startswith("gcp_list.txt:3 [image]: ")


def test_ambiguity_is_an_error() -> None:
    with refused("image-ambiguous", InputError) as error:
        NAMES.find("DJI_1.JPG", path=TABLE, line=3)
    assert "100/DJI_1.JPG or 101/DJI_1.JPG" in error.value.message
