"""Photographs as training sees them: shrunken without a shift, masked only where something is missing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import Camera, Pinhole
from pipelines.survey.photographs import ImageCache, Photograph, Pinholes
from pipelines.train.target_images import ImageLook, TargetImages, shrunken

pytestmark = pytest.mark.usefixtures("one_thread")

PINHOLE = Camera("PINHOLE", 42, 30, np.array([40.0, 40.0, 21.0, 15.0]))
BARREL = Camera("OPENCV", 42, 30, np.array([40.0, 40.0, 21.0, 15.0, 0.3, 0.0, 0.0, 0.0]))


def cache(folder: Path, camera: Camera, count: int = 1) -> ImageCache:
    random = np.random.default_rng(0)
    shots = []
    for index in range(count):
        file = folder / f"{index}.png"
        cv2.imwrite(str(file), random.integers(0, 255, (30, 42, 3), dtype=np.uint8))
        shots.append(Photograph(file.name, file, camera))
    return ImageCache(folder / "cache", shots, 42)


def test_a_shrunken_photograph_is_the_mean_of_its_blocks(tmp_path: Path) -> None:
    images = cache(tmp_path, PINHOLE)
    target = TargetImages(images, Pinholes(images), torch.device("cpu")).get(ImageLook(0, 4))
    full = images.image(0)[:28, :40].astype(np.float64) / 255
    blocks = full.reshape(7, 4, 10, 4, 3).mean(axis=(1, 3))
    assert np.abs(target.colour.numpy() - blocks).max() <= 0.5 / 255 + 1e-6  # stored as bytes
    assert (target.camera.width, target.camera.height) == (10, 7)
    assert target.mask is None


def test_a_shrunken_camera_sees_the_same_rays() -> None:
    camera = shrunken(Pinhole(42, 30, 40.0, 41.0, 20.3, 15.2), 4)
    # The outer corner of a block of four pixels is that of the pixel that replaces it.
    for pixel in (0.0, 8.0, 40.0):
        assert (pixel / 4 - camera.cx) / camera.fx == pytest.approx((pixel - 20.3) / 40.0)
        assert (pixel / 4 - camera.cy) / camera.fy == pytest.approx((pixel - 15.2) / 41.0)


def test_a_block_counts_only_where_all_of_its_pixels_do(tmp_path: Path) -> None:
    images = cache(tmp_path, BARREL)
    covered = np.array(images.mask(0))
    assert covered.any() and not covered.all()
    targets = TargetImages(images, Pinholes(images), torch.device("cpu"))
    mask = targets.get(ImageLook(0, 2)).mask
    assert mask is not None
    assert np.array_equal(mask.numpy(), covered.reshape(15, 2, 21, 2).all(axis=(1, 3)))
    full = targets.get(ImageLook(0)).mask
    assert full is not None and np.array_equal(full.numpy(), covered)


def test_images_of_one_camera_share_a_mask_and_only_one_map_is_kept(tmp_path: Path) -> None:
    images = cache(tmp_path, BARREL, count=3)
    images.build()
    assert len({images.mask_key(index) for index in range(3)}) == 1
    for index in range(3):
        images.mask(index)
    assert len(list((tmp_path / "cache").glob("*.mask.npy"))) == 1
    targets = TargetImages(images, Pinholes(images), torch.device("cpu"))
    assert targets.get(ImageLook(0)).mask is targets.get(ImageLook(2)).mask
