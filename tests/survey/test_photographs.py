"""Undistorted photographs: against a pattern whose undistorted form is known, and as a cache."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Camera, distort, undistort
from pipelines.survey.photographs import ImageCache, Photograph, pinhole_of
from tests.refusals import numbers, refused

WIDTH, HEIGHT = 240, 180
BARREL = Camera("OPENCV", WIDTH, HEIGHT, np.array([200.0, 202.0, 118.0, 93.0, -0.18, 0.03, 1e-3, -5e-4]))
CUSHION = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([200.0, 120.0, 90.0, 0.15]))


def pattern(ray: np.ndarray) -> np.ndarray:
    """Smooth colours (…, 3) from 0 to 255 of rays (…, 2)."""
    x, y = ray[..., 0], ray[..., 1]
    waves = np.stack([np.sin(9 * x + 2 * y), np.cos(8 * y - 3 * x), np.sin(6 * x * y + 5 * y)], axis=-1)
    return 127.5 + 100 * waves


def pixel_centers(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def photograph(camera: Camera, file: Path) -> Photograph:
    """What a camera with that lens sees of the pattern, as a PNG."""
    ray = undistort(camera, pixel_centers(camera.width, camera.height))
    rgb = np.nan_to_num(pattern(ray), nan=0.0).round().astype(np.uint8)
    cv2.imwrite(str(file), rgb[..., ::-1])
    return Photograph(file.name, file, camera)


@pytest.mark.parametrize("camera", [BARREL, CUSHION], ids=["barrel", "cushion"])
@pytest.mark.parametrize("size", [WIDTH, WIDTH // 2])
def test_undistorted_image_is_the_pattern_of_a_pinhole(camera: Camera, size: int, tmp_path: Path) -> None:
    cache = ImageCache(tmp_path / "cache", [photograph(camera, tmp_path / "a.png")], size)
    pinhole = cache.pinhole(0)
    assert (pinhole.width, pinhole.height) == (size, size * 3 // 4)
    image, mask = cache.image(0), cache.mask(0)
    assert image.shape == (pinhole.height, pinhole.width, 3)
    assert mask.shape == image.shape[:2]
    ray = (pixel_centers(pinhole.width, pinhole.height) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    error = np.abs(image - pattern(ray))[mask]
    # Cubic interpolation, twice rounded; half size averages 2 × 2 pixels of a wave of 130 pixels.
    assert error.mean() < 0.8
    assert np.percentile(error, 99.5) < 3.0
    # A shift of half a pixel would show: 100 · 9 / 200 / 2 grey values in the mean wave.
    assert np.abs(image - pattern(ray + 0.5 / pinhole.fx))[mask].mean() > 0.9


@pytest.mark.parametrize("camera", [BARREL, CUSHION], ids=["barrel", "cushion"])
def test_mask_is_where_the_photograph_reaches(camera: Camera, tmp_path: Path) -> None:
    cache = ImageCache(tmp_path / "cache", [photograph(camera, tmp_path / "a.png")], WIDTH)
    pinhole = cache.pinhole(0)
    ray = (pixel_centers(WIDTH, HEIGHT) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    source = distort(camera, ray)
    inside = ((source >= 0.5) & (source <= [WIDTH - 0.5, HEIGHT - 0.5])).all(axis=-1)
    assert (cache.mask(0) == inside).mean() > 0.999
    # A barrel lens sees beyond a pinhole's corners, a cushion less.
    assert cache.mask(0)[0, 0] == (camera is BARREL)
    assert cache.mask(0).mean() > 0.85


def test_pinhole_keeps_the_angles() -> None:
    small = pinhole_of(BARREL, 100)
    assert (small.width, small.height) == (100, 75)
    assert small.fx / small.width == pytest.approx(200.0 / 240)
    assert small.cy / small.height == pytest.approx(93.0 / 180)
    assert pinhole_of(BARREL, 5000).width == WIDTH
    tiny = pinhole_of(Camera("SIMPLE_PINHOLE", 4000, 10, np.array([3000.0, 2000.0, 5.0])), 100)
    assert (tiny.width, tiny.height) == (100, 1)
    assert tiny.fx == tiny.width / 4000 * 3000


def test_one_focal_models_put_the_centre_where_it_is() -> None:
    for model, params in (("RADIAL", [200.0, 121.0, 88.0, 0.1, 0.0]), ("SIMPLE_PINHOLE", [200.0, 121.0, 88.0])):
        pinhole = pinhole_of(Camera(model, WIDTH, HEIGHT, np.array(params)), WIDTH)
        assert (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == (200.0, 200.0, 121.0, 88.0)


def test_cache_is_kept_and_made_again_when_something_changed(tmp_path: Path) -> None:
    shot, folder = photograph(BARREL, tmp_path / "a.png"), tmp_path / "cache"
    ImageCache(folder, [shot], WIDTH).build()
    (made,) = folder.iterdir()
    stamp = made.stat().st_mtime_ns
    ImageCache(folder, [shot], WIDTH).build()
    assert [path.stat().st_mtime_ns for path in folder.iterdir()] == [stamp]
    before = np.array(ImageCache(folder, [shot], WIDTH).image(0))
    cv2.imwrite(str(shot.file), np.full((HEIGHT, WIDTH, 3), 77, np.uint8))
    os.utime(shot.file, ns=(stamp + 10**9, stamp + 10**9))
    assert (ImageCache(folder, [shot], WIDTH).image(0) == 77).all()
    assert not (before == 77).all()
    ImageCache(folder, [Photograph(shot.name, shot.file, CUSHION)], WIDTH).build()
    ImageCache(folder, [shot], WIDTH // 2).build()
    assert len(list(folder.iterdir())) == 4


def test_photograph_of_another_size_is_refused(tmp_path: Path) -> None:
    shot = photograph(BARREL, tmp_path / "a.png")
    other = Photograph(shot.name, shot.file, Camera("PINHOLE", 320, 240, np.array([200.0, 200.0, 160.0, 120.0])))
    with refused("photograph-size", InputError) as error:
        ImageCache(tmp_path / "cache", [other], WIDTH).build()
    assert error.value.path == tmp_path / "a.png" and numbers(error.value.message) == [240, 180, 320, 240]


def test_what_is_no_photograph_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"not a JPEG")
    cache = ImageCache(tmp_path / "cache", [Photograph("a.jpg", tmp_path / "a.jpg", BARREL)], WIDTH)
    with refused("photograph-damaged", InputError) as damaged:
        cache.build()
    with refused("photograph-missing", InputError) as missing:
        ImageCache(tmp_path / "cache", [Photograph("b.jpg", tmp_path / "b.jpg", BARREL)], WIDTH).build()
    assert (damaged.value.path, missing.value.path) == (tmp_path / "a.jpg", tmp_path / "b.jpg")


def test_cut_off_cache_file_is_made_again(tmp_path: Path) -> None:
    cache = ImageCache(tmp_path / "cache", [photograph(BARREL, tmp_path / "a.png")], WIDTH)
    cache.build()
    (made,) = (tmp_path / "cache").iterdir()
    whole = made.read_bytes()
    made.write_bytes(whole[:1000])
    assert cache.image(0).shape == (HEIGHT, WIDTH, 3)
    assert made.read_bytes() == whole


def test_strong_lens_does_not_fold_the_outside_in(tmp_path: Path) -> None:
    # r (1 − 0.6 r²) turns back at r = 0.75: what lies beyond must be masked, not mirrored in.
    wide = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([150.0, 120.0, 90.0, -0.6]))
    cache = ImageCache(tmp_path / "cache", [photograph(wide, tmp_path / "a.png")], WIDTH)
    ray = (pixel_centers(WIDTH, HEIGHT) - [120.0, 90.0]) / 150.0
    beyond = np.linalg.norm(ray, axis=-1) > 0.75
    assert beyond.any()
    assert not cache.mask(0)[beyond].any()


def test_photograph_that_was_replaced_after_ingest_is_refused(tmp_path: Path) -> None:
    shot = photograph(BARREL, tmp_path / "a.png")
    recorded = replace(shot, sha256=hashlib.sha256(shot.file.read_bytes()).hexdigest())
    ImageCache(tmp_path / "cache", [recorded], WIDTH).build()
    shot.file.write_bytes(shot.file.read_bytes() + b"\0")  # decodes as before
    with refused("photograph-changed", InputError) as error:
        ImageCache(tmp_path / "cache", [recorded], WIDTH).build()
    assert error.value.path == tmp_path / "a.png"


def test_bands_of_rows_give_the_same_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shot = photograph(BARREL, tmp_path / "a.png")
    one = ImageCache(tmp_path / "one", [shot], WIDTH)
    expected = np.array(one.image(0)), np.array(one.mask(0))
    monkeypatch.setattr("pipelines.survey.photographs._BAND_PX", 7 * WIDTH)
    bands = ImageCache(tmp_path / "bands", [shot], WIDTH)
    np.testing.assert_array_equal(bands.image(0), expected[0])
    np.testing.assert_array_equal(bands.mask(0), expected[1])


def test_a_shrunken_image_is_made_once_and_again_if_damaged(tmp_path: Path) -> None:
    images = ImageCache(tmp_path / "cache", [photograph(BARREL, tmp_path / "a.png")], WIDTH)
    blocks = images.image(0)[:175, :].astype(np.float64).reshape(35, 5, 48, 5, 3).mean(axis=(1, 3))
    assert np.abs(images.image(0, 5)[:35] - blocks).max() <= 0.5 + 1e-9
    (file,) = (tmp_path / "cache").glob("*.5.npy")
    before = file.stat().st_mtime_ns
    images.image(0, 5)
    assert file.stat().st_mtime_ns == before
    file.write_bytes(file.read_bytes()[:200])
    assert np.abs(images.image(0, 5)[:35] - blocks).max() <= 0.5 + 1e-9
