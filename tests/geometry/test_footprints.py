"""Footprints: rectangles on a plane, the horizon, hills, and clipped rings."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.cameras import Camera
from pipelines.geometry.footprints import PointSurface, border_rays, clipped_ring, footprint, ground_points
from pipelines.geometry.rotations import geo_from_cam

LENS = Camera("PINHOLE", 400, 300, np.array([200.0, 200.0, 200.0, 150.0]))
FISHEYE = Camera("OPENCV_FISHEYE", 800, 800, np.array([300.0, 300.0, 400.0, 400.0, 0, 0, 0, 0]))
GRID = np.stack(np.meshgrid(np.arange(-300.0, 301, 10), np.arange(-300.0, 301, 10)), axis=-1).reshape(-1, 2)
PLANE = PointSurface(np.column_stack([GRID, np.full(len(GRID), 7.0)]))


def outline_of(angles: tuple[float, float, float], surface: PointSurface, height: float = 107.0) -> np.ndarray:
    rays = border_rays(LENS) @ geo_from_cam(angles).T
    return footprint(rays, np.array([5.0, -3.0, height]), surface).outline


def area(outline: np.ndarray) -> float:
    x, y = outline[:, 0], outline[:, 1]
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@settings(max_examples=15)
@given(st.floats(-180, 180))
def test_level_photograph_of_a_plane_shows_a_rectangle(yaw: float) -> None:
    outline = outline_of((yaw, -90.0, 0.0), PLANE)
    # 400 × 300 px at f = 200 px, from 100 m: 200 m by 150 m, anticlockwise, about the point below the camera.
    assert area(outline) == pytest.approx(200 * 150, rel=1e-5)
    np.testing.assert_allclose(outline[:, 2], 7.0, atol=1e-3)
    assert np.linalg.norm(outline[:, :2] - [5, -3], axis=1).max() == pytest.approx(125.0, abs=1e-3)


def test_part_above_the_horizon_is_cut_off() -> None:
    rays = border_rays(LENS) @ geo_from_cam([0.0, -20.0, 0.0]).T
    found = footprint(rays, np.array([0.0, 0.0, 107.0]), PLANE)
    assert found.clipped
    assert area(found.outline) > 0
    distance = np.linalg.norm(found.outline[:, :2], axis=1)
    assert distance.max() == pytest.approx(1000.0, rel=0.01)  # ten times the height above ground
    assert found.outline[:, 1].min() > 50  # the camera faces north
    sky = footprint(border_rays(LENS) @ geo_from_cam([0.0, 60.0, 0.0]).T, np.array([0.0, 0.0, 107.0]), PLANE)
    assert sky.clipped
    assert sky.outline.shape == (0, 3)


def test_ray_ends_at_the_roof_that_hides_the_ground_behind() -> None:
    roof = (np.abs(GRID[:, 0] - 5) < 60) & (GRID[:, 1] > 20) & (GRID[:, 1] < 60)
    town = PointSurface(np.column_stack([GRID, np.where(roof, 92.0, 7.0)]))
    outline = outline_of((0.0, -60.0, 0.0), town)
    # The middle of the upper edge passes the roof; without it, it would meet the ground 300 m away.
    ahead = outline[np.abs(outline[:, 0] - 5) < 20]
    assert outline_of((0.0, -60.0, 0.0), PLANE)[:, 1].max() > 200
    assert 15 < ahead[:, 1].max() < 65


@pytest.mark.parametrize("seed", range(12))
def test_outline_over_any_relief_does_not_cross_itself(seed: int) -> None:
    rng = np.random.default_rng(seed)
    town = PointSurface(np.column_stack([GRID, rng.choice([0.0, 30.0, 60.0], len(GRID))]))
    outline = outline_of((rng.uniform(-180, 180), rng.uniform(-90, -45), 0.0), town)
    edges = list(zip(outline, np.roll(outline, -1, axis=0), strict=True))
    for (a, b), (c, d) in combinations(edges, 2):
        assert not (_turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def test_camera_below_the_points_shows_no_ground() -> None:
    assert outline_of((0.0, -90.0, 0.0), PLANE, height=5.0).shape == (0, 3)


@pytest.mark.parametrize("slope", [0.3, -0.3])
def test_outline_lies_on_a_slope(slope: float) -> None:
    hill = PointSurface(np.column_stack([GRID, slope * GRID[:, 0]]))
    outline = outline_of((30.0, -70.0, 0.0), hill)
    near = outline[(np.abs(outline[:, :2]) < 290).all(axis=1)]
    assert len(near) > 50
    # The median of the nine nearest points, 10 m apart, is the height of a place at most a step away.
    assert np.abs(near[:, 2] - slope * near[:, 0]).max() < 10 * abs(slope)
    assert area(outline) > 0


def test_fisheye_leaves_out_pixels_beyond_a_right_angle() -> None:
    rays = border_rays(FISHEYE)
    assert 3 < len(rays) < len(border_rays(LENS))
    assert np.isfinite(rays).all()


def test_corners_of_the_image_are_on_its_border() -> None:
    slopes = border_rays(LENS)[:, :2] * 200 + [200, 150]
    for corner in ([0, 0], [400, 0], [400, 300], [0, 300]):
        assert np.abs(slopes - corner).sum(axis=1).min() < 1e-9


@given(st.lists(st.floats(0.1, 10), min_size=3, max_size=12), st.floats(-12, 12))
def test_ring_and_its_complement_share_the_area(radii: list[float], border: float) -> None:
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    ring = np.column_stack([radii * np.cos(angle), radii * np.sin(angle)])
    left, right = clipped_ring(ring, border - ring[:, 0]), clipped_ring(ring, ring[:, 0] - border)
    assert (left[:, 0] <= border + 1e-9).all()
    assert (right[:, 0] >= border - 1e-9).all()
    whole = sum(area(part) for part in (left, right) if len(part))
    assert whole == pytest.approx(area(ring), abs=1e-9)


def first_below(ray: np.ndarray, center: np.ndarray, surface: PointSurface) -> np.ndarray:
    """Return where a ray meets the surface: 32 samples, then 16 halvings, and no shortcut."""
    ray = ray / -ray[2]

    def is_above(depth: float) -> bool:
        return bool(center[2] - depth - surface.heights(center[:2] + depth * ray[:2]) > 0)

    steps = np.linspace(0.0, center[2] - surface.lowest, 32).tolist()
    for above, below in pairwise(steps):
        if is_above(above) and not is_above(below):
            low, high = above, below
            for _ in range(16):
                middle = (low + high) / 2
                low, high = (middle, high) if is_above(middle) else (low, middle)
            return np.asarray(center + high * ray)
    return np.asarray(center + (center[2] - surface.median) * ray)


@pytest.mark.parametrize("height", [7.0, 14.0, 60.0])
def test_rays_end_where_a_plain_search_ends_them(height: float) -> None:
    random = np.random.default_rng(int(height))
    place = random.uniform(-60, 60, (400, 2))
    town = PointSurface(np.column_stack([place, random.choice([0.0, 5.0, 12.0], 400)]))
    rays = random.normal(size=(200, 3)) * [1, 1, 0.5] - [0, 0, 1.5]
    rays, center = rays[rays[:, 2] < -0.3], np.array([4.0, -9.0, height])
    expected = [first_below(ray / np.linalg.norm(ray), center, town) for ray in rays]
    np.testing.assert_allclose(ground_points(rays, center, town), expected, atol=1e-9)
