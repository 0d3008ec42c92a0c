"""Marks made on photographs as EXIF shows them, and as they are stored."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from pipelines.core.errors import InputError
from pipelines.ingest.ground_points import stored_pixel
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.photos import SHORT, Exif, gps_entries, jpeg
from tests.refusals import codes, refused

SIZE = (64, 48)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_stored_pixel_is_where_pillow_takes_it_from(orientation: int) -> None:
    """Pillow turns a picture with one bright pixel as EXIF says."""
    pixels = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
    pixels[7, 50] = 255
    picture = Image.fromarray(pixels)
    picture.getexif()[0x0112] = orientation
    picture.save(stream := io.BytesIO(), "png", exif=picture.getexif())
    turned = np.asarray(ImageOps.exif_transpose(Image.open(stream)))
    row, column = np.argwhere(turned == 255)[0]
    assert stored_pixel(orientation, column + 0.5, row + 0.5, *SIZE) == (50.5, 7.5)


def ingested(folder: Path, orientation: int, mark: tuple[float, float], *, as_shown: bool) -> Survey:
    """Ingest three photographs that EXIF turns, each with a mark of a point."""
    (folder / "images").mkdir(exist_ok=True)
    rows = ""
    for at in range(3):
        exif = Exif(image=[(0x0112, SHORT, orientation)], gps=gps_entries(46.02, 7.75 + 1e-4 * at, 100.0))
        (folder / f"images/{at}.jpg").write_bytes(jpeg(at, SIZE, exif))
        rows += f"7.75 46.02 50 {mark[0]} {mark[1]} {at}.jpg G\n"
    (folder / "gcp_list.txt").write_text("EPSG:4979\n" + rows)
    options = IngestOptions(
        images=folder / "images", gcp=folder / "gcp_list.txt", marks_as_shown=as_shown, vertical="ellipsoidal"
    )
    return survey_and_track(options, None)[0]


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_marks_outside_as_stored_but_inside_as_shown_are_named(tmp_path: Path, orientation: int) -> None:
    with refused("mark-on-turned-picture", InputError) as error:
        ingested(tmp_path, orientation, (10.0, 60.0), as_shown=False)
    assert "--marks-as-shown" in error.value.message and f"orientation {orientation}" in error.value.message
    survey = ingested(tmp_path, orientation, (10.0, 60.0), as_shown=True)
    expected = {5: (60.0, 10.0), 6: (60.0, 38.0), 7: (4.0, 38.0), 8: (4.0, 10.0)}[orientation]
    assert {(mark.x_px, mark.y_px) for mark in survey.control_points[0].marks} == {expected}
    assert "marks-as-shown" in codes(survey.assumptions)


def test_half_a_turn_cannot_be_told_by_size_and_is_said(tmp_path: Path) -> None:
    survey = ingested(tmp_path, 3, (10.0, 40.0), as_shown=False)
    assert {(mark.x_px, mark.y_px) for mark in survey.control_points[0].marks} == {(10.0, 40.0)}
    assert "marks-as-stored" in codes(survey.warnings)
    survey = ingested(tmp_path, 3, (10.0, 40.0), as_shown=True)
    assert {(mark.x_px, mark.y_px) for mark in survey.control_points[0].marks} == {(54.0, 8.0)}


def test_marks_as_stored_and_pictures_that_nothing_turns(tmp_path: Path) -> None:
    with refused("mark-on-turned-picture", InputError) as error:
        ingested(tmp_path, 6, (60.0, 10.0), as_shown=True)
    assert "remove --marks-as-shown" in error.value.message
    survey = ingested(tmp_path, 1, (60.0, 10.0), as_shown=True)
    assert "no-mark-turned" in codes(survey.warnings)
