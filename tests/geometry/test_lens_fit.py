"""Lenses of other programs: COLMAP's nearest camera shows each ray where the program's own formula does."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.cameras import distort
from pipelines.geometry.lens_fit import Brown, ForeignLens, brown_lens, fisheye_lens, nearest_camera

SIZE, FOCAL, CENTER = (4000, 3000), (3100.0, 3098.0), (2011.0, 1490.0)
RADIAL, TANGENTIAL = (-0.09, 0.03, -0.01, 0.004), (4e-4, -7e-4)
GRID = np.stack(np.meshgrid(np.linspace(-0.63, 0.63, 31), np.linspace(-0.47, 0.47, 31)), axis=-1).reshape(-1, 2)


def metashape_pixels(ray: np.ndarray, b1: float, b2: float, growth: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Metashape's manual, appendix D, frame cameras; P1 there stands with r² + 2 x²."""
    (k1, k2, k3, k4), (p2, p1) = RADIAL, TANGENTIAL
    x, y = ray.T
    r2 = x * x + y * y
    gain, more = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4, 1 + growth[0] * r2 + growth[1] * r2**2
    u = x * gain + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * more
    v = y * gain + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * more
    f, cx, cy = FOCAL[1], CENTER[0] - SIZE[0] / 2, CENTER[1] - SIZE[1] / 2
    return np.column_stack([SIZE[0] / 2 + cx + u * f + u * b1 + v * b2, SIZE[1] / 2 + cy + v * f])


def in_image(pixels: np.ndarray) -> np.ndarray:
    return ((pixels >= 0) & (pixels <= SIZE)).all(axis=1)


@pytest.mark.parametrize(
    ("b2", "growth", "most_px"),
    # A rational lens holds k4, P3 is a third of 1 px in the corners; skew moves them by b2 · y = 0.48 b2.
    [(0.0, (0.0, 0.0), 0.05), (0.0, (0.3, -0.1), 0.3), (1.5, (0.0, 0.0), 0.9), (-0.6, (0.0, 0.0), 0.4)],
)
def test_the_stated_error_bounds_the_error(b2: float, growth: tuple[float, float], most_px: float) -> None:
    lens = brown_lens(Brown(SIZE, FOCAL, CENTER, RADIAL, TANGENTIAL, growth, b2))
    camera, stated = nearest_camera(lens)
    pixels = metashape_pixels(GRID, FOCAL[0] - FOCAL[1], b2, growth)
    off = np.hypot(*(distort(camera, GRID) - pixels)[in_image(pixels)].T)
    assert camera.model == "FULL_OPENCV"
    # The error is stated for 25×25 pixels, corners included, and these rays lie between them.
    assert off.max() <= 1.05 * stated + 1e-3 and stated < most_px
    assert stated < 2 * off.max() + 1e-3


@pytest.mark.parametrize("equisolid", [False, True])
def test_fisheyes(equisolid: bool) -> None:
    """The equidistant one is exact; 2 sin θ/2 follows a polynomial of θ up to θ⁹ to hundredths of a pixel."""
    radial = (0.02, -0.004, 1e-3, 0.0)
    brown = Brown(SIZE, (1500.0, 1500.0), CENTER, radial)
    camera, stated = nearest_camera(fisheye_lens(brown, equisolid=equisolid))
    ray = 2.5 * GRID
    radius = np.hypot(*ray.T)
    angle = np.arctan(radius)
    bent = 2 * np.sin(angle / 2) if equisolid else angle
    grown = bent * (1 + sum(k * bent ** (2 * i) for i, k in enumerate(radial, start=1)))
    pixels = 1500.0 * ray * (grown / np.maximum(radius, 1e-12))[:, None] + CENTER
    off = np.hypot(*(distort(camera, ray) - pixels)[in_image(pixels)].T)
    assert stated < 0.03 if equisolid else stated == 0.0
    assert off.max() < 0.03 and camera.model == "OPENCV_FISHEYE"


def test_exact_lenses_keep_their_parameters_and_their_simplest_model() -> None:
    plain = brown_lens(Brown(SIZE, FOCAL, CENTER))
    opencv = brown_lens(Brown(SIZE, FOCAL, CENTER, (-0.09, 0.03, 0.0, 0.0), TANGENTIAL))
    full = brown_lens(Brown(SIZE, FOCAL, CENTER, (-0.09, 0.03, -0.01, 0.0), TANGENTIAL))
    found = [nearest_camera(lens) for lens in (plain, opencv, full)]
    assert [camera.model for camera, _ in found] == ["PINHOLE", "OPENCV", "FULL_OPENCV"]
    assert [error for _, error in found] == [0.0, 0.0, 0.0]


def test_a_lens_that_is_no_lens_has_no_end_of_error() -> None:
    folded = brown_lens(Brown(SIZE, FOCAL, CENTER, (-9.0, 0.0, 0.0, 50.0)))
    assert nearest_camera(folded)[1] > 10
    nowhere = ForeignLens(folded.start, lambda ray: np.full_like(ray, np.nan))
    assert nearest_camera(nowhere)[1] == np.inf
