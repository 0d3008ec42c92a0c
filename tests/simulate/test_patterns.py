"""Textures must not alias: stripes are box-filtered exactly, and patterns that are too fine fade out."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.simulate.textures import Pyramid, band, cell_random, fbm, noise, stripes


def averaged(on: np.ndarray) -> np.ndarray:
    return on.mean(axis=1)


@pytest.mark.parametrize("pixel", [0.01, 0.13, 0.9, 7.3])
def test_stripes_are_the_mean_over_the_pixel(pixel: float) -> None:
    x = np.linspace(-5, 5, 101, dtype=np.float32)
    # 20 001 points across the pixel: their mean is off by no more than an edge's share of 1/20 000 an edge.
    inside = x[:, None].astype(np.float64) + pixel * np.linspace(-0.5, 0.5, 20_001)
    expected = averaged(np.mod(inside, 0.7) < 0.2)
    filtered = stripes(x, 0.7, 0.2, np.full(101, pixel, dtype=np.float32))
    np.testing.assert_allclose(filtered, expected, atol=2e-3)


@pytest.mark.parametrize("pixel", [0.01, 0.4, 3.0])
def test_band_is_the_mean_over_the_pixel(pixel: float) -> None:
    x = np.linspace(-2, 2, 101, dtype=np.float32)
    inside = x[:, None].astype(np.float64) + pixel * np.linspace(-0.5, 0.5, 20_001)
    expected = averaged((inside > -0.3) & (inside < 0.8))
    filtered = band(x, -0.3, 0.8, np.full(101, pixel, dtype=np.float32))
    np.testing.assert_allclose(filtered, expected, atol=2e-3)


def test_noise_fades_before_it_aliases() -> None:
    u = np.linspace(0, 50, 400, dtype=np.float32)
    near, far = (np.full(400, pixel, dtype=np.float32) for pixel in (0.05, 1.0))
    assert noise(u, u, 0.5, near).std() > 0.1
    # Blobs of 0.5 m have a period of 1 m: one pixel of 1 m cannot show them.
    assert not noise(u, u, 0.5, far).any()


def test_noise_is_mixed_per_point_as_all_at_once() -> None:
    u = np.linspace(0, 50, 400, dtype=np.float32)
    pixel = np.where(np.arange(400) % 2, 0.05, 1.0).astype(np.float32)
    near = noise(u, u, 0.5, np.full(400, 0.05, dtype=np.float32))
    np.testing.assert_array_equal(noise(u, u, 0.5, pixel), np.where(np.arange(400) % 2, near, 0))


def test_noise_does_not_repeat_within_a_town() -> None:
    u, v = np.random.default_rng(0).uniform(0, 100, (2, 4000)).astype(np.float32)
    pixel = np.full(4000, 0.05, dtype=np.float32)
    sizes = (7.0, 3.0, 1.3)
    first, second = fbm(u, v, sizes, pixel), fbm(u + np.float32(128 * 0.7), v, sizes, pixel)
    # Two independent patches of 4000 samples correlate by about 1/√(some hundred blobs).
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.15


def test_cells_are_uniform_and_their_own() -> None:
    i, j = (part.ravel().astype(np.float32) for part in np.mgrid[-60:60, -60:60])
    value = cell_random(i, j, 3)
    # Mean of 14 400 uniform numbers: σ = 1/√(12 · 14 400) = 0.0024.
    assert abs(value.mean() - 0.5) < 0.01
    assert len(np.unique(value)) > 14_000
    assert not np.array_equal(value, cell_random(i, j, 4))


def test_pyramid_keeps_the_mean_and_finds_the_place() -> None:
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    image[:, 32:] = 255
    pyramid = Pyramid(image, 0.5)
    at = np.array([-8.0, 8.0, 0.0], dtype=np.float32)
    sharp = pyramid.sample(at, 0 * at, np.full(3, 0.1, dtype=np.float32))
    np.testing.assert_allclose(sharp[:, 0], [0, 1, 0.5], atol=0.01)
    blurred = pyramid.sample(0 * at, 0 * at, np.full(3, 8.0, dtype=np.float32))
    np.testing.assert_allclose(blurred, 0.5, atol=0.02)
