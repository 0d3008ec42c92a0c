"""Support by depth maps of a plane with a box: counts are exact, residuals are the noise that was put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.cameras import Pinhole
from pipelines.surface.visibility import DepthViews, support
from tests.depth_scenes import BOX_M, CAMERA, UP, depth_views, looking_down

TOLERANCE = 0.01


@pytest.fixture(scope="module")
def views() -> DepthViews:
    return depth_views(looking_down(7))


def ground_and_roof(rng: np.random.Generator, count: int = 400) -> np.ndarray:
    """Places on the ground and the roof, two and a half pixels or more from the box's walls."""
    xy = rng.uniform(-14, 14, (count, 2))
    edge = np.abs(np.abs(xy).max(axis=1) - BOX_M)
    xy = xy[edge > 1.5]
    on_roof = np.abs(xy).max(axis=1) < BOX_M
    return np.column_stack([xy, np.where(on_roof, BOX_M, 0.0)])


def plain_support(points: np.ndarray, views: DepthViews) -> tuple[np.ndarray, ...]:
    """Counts and RMS along the cameras' axes, one point and one view after the other, by the nearest pixel."""
    count, through, square = (np.zeros(len(points)) for _ in range(3))
    for i, point in enumerate(points):
        for v, (width, height) in enumerate(views.size_px):
            x, y, z = views.cam_from_world[v] @ (point - views.center_in_world[v])
            fx, fy, cx, cy = views.intrinsics_px[v]
            u, w = fx * x / z + cx, fy * y / z + cy
            if z <= 0 or not (0 <= u < width and 0 <= w < height):
                continue
            depth = views.depth_m[views.start[v] + int(w) * width + int(u)]
            if depth > 0:
                through[i] += depth - z > TOLERANCE * z
                count[i] += abs(depth - z) <= TOLERANCE * z
                square[i] += (depth - z) ** 2 * (abs(depth - z) <= TOLERANCE * z)
    return count, through, np.sqrt(square / np.maximum(count, 1))


def test_counts_are_those_of_a_loop_over_points_and_views(views: DepthViews) -> None:
    rng = np.random.default_rng(0)
    surface = ground_and_roof(rng)
    above = surface + np.array([0.0, 0.0, 2.0])  # seen through, unless hidden
    points = np.concatenate([surface, above, [[500.0, 0.0, 0.0]], [[0.0, 0.0, 300.0]]])
    result = support(points, views, UP, TOLERANCE)
    count, through, _ = plain_support(points, views)
    np.testing.assert_array_equal(result.views, count)
    np.testing.assert_array_equal(result.seen_through, through)
    known = slice(0, len(surface))
    assert result.views[known].min() >= 3
    assert result.seen_through[known].max() == 0
    assert result.views[len(surface) :].max() == 0
    assert result.seen_through[len(surface) : -2].min() >= 3
    assert (result.seen_through[-2:] == 0).all()


def test_order_of_the_points_does_not_matter(views: DepthViews) -> None:
    rng = np.random.default_rng(1)
    points = ground_and_roof(rng, 3000)
    order = rng.permutation(len(points))
    before, after = support(points, views, UP, TOLERANCE), support(points[order], views, UP, TOLERANCE)
    for name, value in vars(before).items():
        np.testing.assert_array_equal(getattr(after, name), value[order])


def test_true_points_have_no_residual(views: DepthViews) -> None:
    """Inverse depth is linear on the image of a plane; float32 rounds depths of 40 m to 2e-6 m."""
    result = support(ground_and_roof(np.random.default_rng(2)), views, UP, TOLERANCE)
    assert max(result.rms_up_m.max(), result.rms_horizontal_m.max(), result.rms_depth_m.max()) < 2e-5


def test_residuals_are_those_of_a_raised_point(views: DepthViews) -> None:
    """A point 5 cm above level ground: every view's surface lies 5 cm below it, whatever the slant of the ray."""
    points = ground_and_roof(np.random.default_rng(3)) + np.array([0.0, 0.0, 0.05])
    result = support(points, views, UP, TOLERANCE, np.tile(-UP, (len(points), 1)))
    np.testing.assert_allclose(result.mean_up_m, -0.05, atol=2e-5)
    np.testing.assert_allclose(result.rms_up_m, 0.05, atol=2e-5)
    np.testing.assert_allclose(result.mean_normal_m, 0.05, atol=2e-5)
    np.testing.assert_allclose(result.rms_normal_m, result.rms_up_m, rtol=1e-9)
    twice = result.scaled(2.0)
    np.testing.assert_array_equal(twice.rms_up_m, 2 * result.rms_up_m)
    np.testing.assert_array_equal(twice.views, result.views)


def test_rms_is_the_noise_of_the_views(views: DepthViews) -> None:
    """Each map is off by its own constant: the RMS of a point is that of the maps that see it."""
    offset = np.random.default_rng(4).normal(0, 0.05, len(views.start))
    pixels = np.diff([*views.start, len(views.depth_m)])
    noisy = replace(views, depth_m=(views.depth_m + np.repeat(offset, pixels)).astype(np.float32))
    points = ground_and_roof(np.random.default_rng(5))
    result = support(points, noisy, UP, TOLERANCE)
    _, _, rms = plain_support(points, noisy)
    sees = support(points, views, UP, TOLERANCE).views
    assert (result.views == sees).all()
    # Four pixels interpolate the level ground under level cameras; the nearest pixel is as good.
    np.testing.assert_allclose(result.rms_depth_m, rms, atol=1e-4)
    seen_by_all = sees == len(views.start)
    np.testing.assert_allclose(result.rms_depth_m[seen_by_all], np.sqrt(np.mean(offset**2)), atol=1e-4)


def test_spread_is_the_angle_between_the_rays() -> None:
    """Two cameras 20 m apart, 20 m above the middle between them: their rays are 26.57° off their mean."""
    pair = depth_views([np.array([x, 0.0, 20.0]) for x in (-10.0, 10.0)], box=False)
    spread = support(np.zeros((1, 3)), pair, UP, TOLERANCE).spread_rad
    # Of two rays at ± a: |mean| = cos a, and the RMS angle √(2 (1 − cos a)) is a to second order.
    np.testing.assert_allclose(spread, np.sqrt(2 * (1 - np.cos(np.arctan(0.5)))), rtol=1e-6)
    alone = depth_views([np.array([0.0, 0.0, 20.0])], box=False)
    assert support(np.zeros((1, 3)), alone, UP, TOLERANCE).spread_rad[0] < 1e-6


def test_nothing_comes_of_nothing(views: DepthViews) -> None:
    empty = support(np.zeros((0, 3)), views, UP, TOLERANCE)
    assert len(empty.views) == 0
    blank = replace(views, depth_m=np.zeros_like(views.depth_m))
    unseen = support(np.zeros((1, 3)), blank, UP, TOLERANCE)
    assert (unseen.views[0], unseen.seen_through[0]) == (0, 0)
    assert np.isnan([unseen.rms_up_m[0], unseen.spread_rad[0]]).all()


def test_single_row_of_pixels_is_read_by_pixel() -> None:
    line = depth_views(
        [np.array([0.0, 0.0, 20.0])], camera=Pinhole(CAMERA.width, 1, 60.0, 60.0, 48.0, 0.5), box=False
    )
    assert support(np.zeros((1, 3)), line, UP, TOLERANCE).views[0] == 1
