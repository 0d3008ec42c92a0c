"""Focal lengths against the pinhole's own geometry: pixels = mm on the sensor × pixels per mm."""

from __future__ import annotations

import math

import pytest

from pipelines.formats.exif import LensTags, PhotoTags, read_tags
from pipelines.formats.image_file import ImageFile
from pipelines.ingest.photo_folder import Photo, camera_priors, focal_px
from pipelines.ingest.remarks import Remarks
from tests.photos import SHORT, Exif, dji_xmp, jpeg
from tests.refusals import numbers, said


def _photo(name: str, width: int, height: int, tags: PhotoTags) -> Photo:
    return Photo(name, ImageFile(width, height, name), tags)


def test_known_sensor_of_a_scaled_image() -> None:
    tags = PhotoTags(make="DJI", model="FC300S", lens=LensTags(focal_mm=3.61, taken_width_px=4000.0))
    assert focal_px(tags, 2000, 1125)[0] == pytest.approx(3.61 / 6.17 * 2000)


def test_focal_plane_resolution_counts_pixels_before_scaling() -> None:
    # 35 mm lens on 36 mm with 6000 px, later scaled to 1500 px, also when it is turned upright.
    lens = LensTags(focal_mm=35.0, px_per_mm=6000 / 36.0, taken_width_px=6000.0)
    for width, height in ((1500, 1000), (1000, 1500)):
        assert focal_px(PhotoTags(model="?", lens=lens), width, height)[0] == pytest.approx(35 / 36 * 1500)


def test_nonsense_resolution_falls_back_to_35_mm() -> None:
    lens = LensTags(focal_mm=35.0, px_per_mm=0.001, focal_35mm_mm=35.0)
    focal, source, how = focal_px(PhotoTags(lens=lens), 3000, 2000)
    assert focal == pytest.approx(35.0 / math.hypot(36, 24) * math.hypot(3000, 2000))
    assert source == "exif" and "35 mm film" in how


def test_nothing_known_is_called_assumed() -> None:
    focal, source, _ = focal_px(PhotoTags(), 900, 1200)
    assert (focal, source) == (1020.0, "assumed")


def test_digital_zoom_lengthens() -> None:
    lens = LensTags(focal_mm=3.61, zoom=2.0)
    assert focal_px(PhotoTags(model="FC300S", lens=lens), 4000, 3000)[0] == pytest.approx(2 * 3.61 / 6.17 * 4000)


def test_one_camera_for_each_size_model_and_focal_length() -> None:
    near = PhotoTags(make="A", model="B", lens=LensTags(focal_35mm_mm=24.0))
    far = PhotoTags(make="A", model="B", lens=LensTags(focal_35mm_mm=70.0))
    photos = [
        _photo("1", 60, 40, near),
        _photo("2", 60, 40, near),
        _photo("3", 60, 40, far),
        _photo("4", 30, 20, near),
    ]
    remarks = Remarks()
    cameras, camera_of = camera_priors(photos, None, remarks)
    assert camera_of == {"1": 1, "2": 1, "3": 2, "4": 3}
    assert cameras[0].model == "SIMPLE_RADIAL" and cameras[0].params[1:] == (30.0, 20.0, 0.0)
    assert "2 sizes (30×20, 60×40)" in said(remarks.warnings, "image-sizes")


def test_an_option_overrides_exif() -> None:
    photos = [_photo("1", 60, 40, PhotoTags(model="FC300S", lens=LensTags(focal_mm=3.61)))]
    cameras, _ = camera_priors(photos, 77.0, Remarks())
    assert cameras[0].params[0] == 77.0 and cameras[0].focal_source == "option"


@pytest.mark.parametrize(
    ("px_per_mm", "focal_35mm_mm"),
    [
        (82.0, 38.0),  # the resolution of a preview
        (6000 / 36.0 / 2.54, 26.0),  # per inch where it says per centimetre
        (6000 / 36.0 * 2.54, 26.0),  # and the reverse
    ],
)
def test_a_focal_plane_that_contradicts_35_mm_is_named_and_not_used(px_per_mm: float, focal_35mm_mm: float) -> None:
    lens = LensTags(focal_mm=25.6, px_per_mm=px_per_mm, focal_35mm_mm=focal_35mm_mm, taken_width_px=6000.0)
    focal, source, how = focal_px(PhotoTags(lens=lens), 6000, 4000)
    assert focal == pytest.approx(focal_35mm_mm / math.hypot(36, 24) * math.hypot(6000, 4000))
    assert source == "exif"
    assert round(25.6 * px_per_mm) in numbers(how) and focal_35mm_mm in numbers(how)


def test_a_focal_plane_that_agrees_has_more_digits() -> None:
    lens = LensTags(focal_mm=25.6, px_per_mm=6000 / 36.0, focal_35mm_mm=26.0, taken_width_px=6000.0)
    focal, _, how = focal_px(PhotoTags(lens=lens), 6000, 4000)
    assert focal == pytest.approx(25.6 / 36 * 6000) and "35 mm" not in how


@pytest.mark.parametrize("value", [1, 65535])
def test_a_35_mm_equivalent_that_means_none_is_said(value: int) -> None:
    tags = read_tags(jpeg(exif=Exif(photo=[(0xA405, SHORT, value)])))
    assert tags.lens.focal_35mm_mm is None
    assert numbers(tags.problems[0])[0] == value


def test_calibration_in_xmp_counts_before_the_focal_plane() -> None:
    lens = LensTags(focal_mm=8.8, px_per_mm=200.0, taken_width_px=5472.0)
    xmp = read_tags(jpeg(xmp=dji_xmp(CalibratedFocalLength="3666.67"))).xmp
    focal, _, how = focal_px(PhotoTags(lens=lens, xmp=xmp), 1368, 912)
    assert focal == pytest.approx(3666.67 / 4)
    assert 440.0 in numbers(how)  # the focal plane says 1760 px of 5472
