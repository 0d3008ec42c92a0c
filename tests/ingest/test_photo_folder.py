"""What in a folder counts as a photograph, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.ingest.photo_folder import scan_folder
from pipelines.ingest.remarks import Remarks
from tests.photos import jpeg
from tests.refusals import codes, refused


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
    (root / "notes.txt").write_text("not looked at")
    (root / "link.jpg").symlink_to(outside)
    remarks = Remarks()
    photos = scan_folder(root, remarks)
    assert [photo.name for photo in photos] == ["b.jpg", "sub/a.JPEG"]
    assert codes(remarks.warnings) == ["image-link-outside", "image-unreadable", "image-copies"]
    link, unreadable, copies = (warning.sentence for warning in remarks.warnings)
    assert "(1): link.jpg" in link and "(1): copy.jpg (as b.jpg)" in copies
    assert "(3): " in unreadable and all(f"{name} (" in unreadable for name in ("cut.jpg", "empty.jpg", "text.png"))


def test_no_folder_and_no_image(tmp_path: Path) -> None:
    with refused("no-image-folder", InputError) as error:
        scan_folder(tmp_path / "absent", Remarks())
    assert (error.value.path, error.value.field) == (tmp_path / "absent", "--images")
    with refused("no-images", InputError):
        scan_folder(tmp_path, Remarks())
