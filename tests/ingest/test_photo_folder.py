"""What in a folder counts as a photograph, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.core.errors import InputError
from pipelines.ingest.photo_folder import scan_folder
from pipelines.ingest.remarks import Remarks
from tests.photos import jpeg


def test_every_defect_is_left_out_and_counted(tmp_path: Path) -> None:
    outside = tmp_path / "outside.jpg"
    outside.write_bytes(jpeg(9))
    root = tmp_path / "images"
    (root / "sub").mkdir(parents=True)
    (root / "b.jpg").write_bytes(jpeg(1))
    (root / "sub" / "a.JPEG").write_bytes(jpeg(2))
    (root / "copy.jpg").write_bytes(jpeg(1))
    (root / "empty.jpg").touch()
    (root / "cut.jpg").write_bytes(jpeg(3)[:700])
    (root / "text.png").write_text("no image")
    (root / "._b.jpg").write_bytes(b"resource fork")
    (root / "remarks.txt").write_text("not looked at")
    (root / "link.jpg").symlink_to(outside)
    remarks = Remarks()
    photos = scan_folder(root, remarks)
    assert [photo.name for photo in photos] == ["b.jpg", "sub/a.JPEG"]
    assert remarks.warnings == [
        "1 image is a link that leaves the folder and was left out: link.jpg",
        "3 images were left out: cut.jpg (is damaged: it does not decode to its end), empty.jpg (is empty), "
        "text.png (is no JPEG, PNG or TIFF image)",
        "1 image is a copy of another and was left out: copy.jpg (as b.jpg)",
    ]


def test_no_folder_and_no_image(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent \[--images\]: no such folder of photographs"):
        scan_folder(tmp_path / "absent", Remarks())
    with pytest.raises(InputError, match="holds no JPEG, PNG or TIFF image"):
        scan_folder(tmp_path, Remarks())
