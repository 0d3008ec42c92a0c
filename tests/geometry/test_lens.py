"""Lenses that change: pinholes that stand for them, rays by their parameters, and the vector that holds these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.cameras import Camera, Lenses, Pinhole, bearings, distort, refit_pinhole, undistort

PINHOLE = Pinhole(320, 240, 250.0, 251.0, 161.0, 119.0)
PLAIN = Camera("PINHOLE", 640, 480, np.array([500.0, 502.0, 322.0, 238.0]))
BENT = Camera("OPENCV", 640, 480, np.array([500.0, 502.0, 322.0, 238.0, -0.05, 0.01, 4e-4, -3e-4]))


def changed(camera: Camera, change: list[float]) -> Camera:
    return replace(camera, params=camera.params + np.array(change))


def shown_at(pinhole: Pinhole, before: Camera, after: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of an image undistorted with `before`, and the pinhole's pixels of their rays under `after`."""
    x, y = np.meshgrid(np.linspace(10, 310, 31), np.linspace(10, 230, 23))
    pixel = np.stack([x.ravel(), y.ravel()], axis=1)
    ray = undistort(after, distort(before, PINHOLE.rays(pixel)[:, :2]))
    return pixel, ray * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]


def test_other_focal_lengths_and_principal_points_are_exact() -> None:
    after = changed(PLAIN, [3.0, -2.0, 1.5, -0.7])
    refitted = refit_pinhole(PINHOLE, PLAIN, after)
    pixel, shown = shown_at(refitted, PLAIN, after)
    np.testing.assert_allclose(shown, pixel, atol=1e-9)
    # By hand, at half the size: f' = 250 · 503 / 500.
    assert refitted.fx == pytest.approx(251.5, abs=1e-9)
    assert (refitted.width, refitted.height) == (320, 240)


def test_other_focal_lengths_of_a_bent_lens_are_nearly_exact() -> None:
    after = changed(BENT, [1.0, 1.0, 0.5, -0.5, 0, 0, 0, 0])
    pixel, shown = shown_at(refit_pinhole(PINHOLE, BENT, after), BENT, after)
    # A quarter of a pixel of shift, through distortion whose slope differs by 10 % across the image.
    assert np.abs(shown - pixel).max() < 0.1


def test_another_distortion_is_fitted_as_far_as_a_pinhole_can() -> None:
    after = changed(BENT, [0, 0, 0, 0, 1e-3, 0, 0, 0])
    pixel, shown = shown_at(refit_pinhole(PINHOLE, BENT, after), BENT, after)
    _, unfitted = shown_at(PINHOLE, BENT, after)
    # f δk₁ r² x is 0.09 px in the corner. The best line for u³ from 0 to 1 is 0.6 u: it leaves 0.4 at the rim, and
    # of the root mean square √(1/7) a root of 4/175, which is 0.4 too.
    assert np.abs(unfitted - pixel).max() > 0.08
    assert np.abs(shown - pixel).max() < 0.5 * np.abs(unfitted - pixel).max()
    assert np.sqrt(((shown - pixel) ** 2).mean()) < 0.45 * np.sqrt(((unfitted - pixel) ** 2).mean())


def test_the_same_lens_is_the_same_pinhole() -> None:
    assert refit_pinhole(PINHOLE, BENT, changed(BENT, [0.0] * 8)) == PINHOLE


def test_parameters_of_all_cameras_are_one_vector() -> None:
    simple = Camera("SIMPLE_RADIAL", 640, 480, np.array([500.0, 320.0, 240.0, 0.01]))
    lenses = Lenses({7: simple, 3: BENT}, np.array([3, 7, 3]))
    assert lenses.longest == 8
    change = np.arange(16.0) / 100
    moved = lenses.moved(change)
    np.testing.assert_allclose(moved.of(1).params - simple.params, change[:4], atol=1e-12)
    np.testing.assert_allclose(moved.of(0).params - BENT.params, change[8:], atol=1e-12)
    assert lenses.of(2) is BENT
    unused = [4, 5, 6, 7]  # the simple camera has four
    np.testing.assert_allclose(np.delete(lenses.change_to(moved), unused), np.delete(change, unused), atol=1e-12)
    assert not lenses.change_to(moved)[unused].any()


def test_bearings_change_with_the_parameters_as_they_are_said_to() -> None:
    rng = np.random.default_rng(0)
    simple = Camera("SIMPLE_RADIAL", 640, 480, np.array([500.0, 320.0, 240.0, 0.01]))
    lenses = Lenses({7: simple, 3: BENT}, np.array([3, 7, 3]))
    image, pixel = np.array([0, 1, 2, 1]), rng.uniform([20, 20], [620, 460], (4, 2))
    slope = lenses.bearing_jacobian(image, pixel)
    assert slope.shape == (4, 3, 16)
    assert not slope[1, :, 4:].any()  # neither beyond a shorter list, nor of another camera
    step = rng.normal(size=16) * np.tile([0.01] * 4 + [1e-5] * 4, 2)
    step[3] *= 1e-3  # k of the simple camera
    rays = [
        np.array([bearings(state.of(i), xy[None])[0] for i, xy in zip(image, pixel, strict=True)])
        for state in (lenses.moved(step), lenses.moved(-step))
    ]
    # Central differences: third order in steps of 1e-5.
    np.testing.assert_allclose((rays[0] - rays[1]) / 2, slope @ step, atol=1e-11)
