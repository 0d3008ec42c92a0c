"""HEIC photographs: the picture and its tags as a JPEG, and the survey of a folder of them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.exif import read_tags
from pipelines.formats.heif import jpeg_of_heif
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import check_inputs
from pipelines.survey.survey import Survey
from tests.refusals import codes, refused

WIDTH, HEIGHT = 320, 240


def picture(seed: int) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(40, 215, (HEIGHT // 20, WIDTH // 20, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def tags(lat_deg: float, orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = orientation, "Maker", "Telephone"
    gps = exif.get_ifd(0x8825)
    minutes = (lat_deg % 1) * 60
    gps.update(
        {1: "N", 2: (int(lat_deg), int(minutes), (minutes % 1) * 60), 3: "E", 4: (7.0, 45.0, 0.0), 5: 0, 6: 500.0}
    )
    return exif.tobytes()


def write_heic(path: Path, rgb: np.ndarray, exif: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = pillow_heif.from_pillow(Image.fromarray(rgb))
    image.save(path, quality=95, exif=exif)


def test_picture_and_tags_come_over_upright(tmp_path: Path) -> None:
    path = tmp_path / "a.heic"
    write_heic(path, picture(0), tags(46.02, orientation=6))
    jpeg = jpeg_of_heif(path)
    found = read_tags(jpeg)
    assert (found.model, found.orientation) == ("Telephone", 1)
    assert found.gps is not None
    np.testing.assert_allclose([found.gps.lat_deg, found.gps.lon_deg], [46.02, 7.75], atol=1e-6)
    shown = np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))
    expected = picture(0)
    if shown.shape != expected.shape:  # turned by what the tag says
        expected = np.rot90(expected, -1)
    assert np.abs(shown.astype(float) - expected).mean() < 4


def test_a_folder_with_heic_becomes_a_survey(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    for number in range(3):
        write_heic(folder / "sub" / f"IMG_{number}.HEIC", picture(number), tags(46.0 + number * 1e-4))
    Image.fromarray(picture(9)).save(folder / "b.jpg", exif=tags(46.001), quality=95)
    (folder / "broken.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 40)
    options = {"images": folder, "vertical": "ellipsoidal"}
    workspace = Workspace(tmp_path / "ws")
    told = check_inputs(workspace, IngestOptions.model_validate(options))
    assert "5 photographs, 4 of them HEIC" in told.key_figure
    run_stage(workspace, BY_NAME["ingest"], options)
    survey = load_json(Survey, workspace.path(SURVEY))
    assert [image.name for image in survey.images] == ["b.jpg", *(f"sub/IMG_{k}.HEIC.jpg" for k in range(3))]
    assert all(image.fix is not None for image in survey.images)
    assert (workspace.root / survey.image_dir / "sub/IMG_1.HEIC.jpg").is_file()
    assert {"heif-converted"} <= set(codes(survey.assumptions)) and "image-unreadable" in codes(survey.warnings)


def test_what_is_no_heic_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.heic"
    for data, code in ((b"", "file-empty"), (b"no picture" * 20, "not-an-image")):
        path.write_bytes(data)
        with refused(code, InputError):
            jpeg_of_heif(path)
    whole = tmp_path / "whole.heic"
    write_heic(whole, picture(1), tags(46.0))
    path.write_bytes(whole.read_bytes()[:-400])
    with pytest.raises(InputError):
        jpeg_of_heif(path)
