"""The kernels of the fusion against plain, slow versions of the same sums by numpy."""

import numpy as np
import pytest

from pipelines.surface.fusion_kernels import PixelLimits, chosen_pixels, voxel_means
from pipelines.surface.visibility import DepthViews, Viewpoints, support
from tests.depth_scenes import CAMERA, DOWN, depth_map, looking_down

# Both orders of the sums round differently: by 1e-15 of coordinates of 1000 m.
ROUNDING_M = 1e-11


@pytest.mark.parametrize("farthest_m", [50.0, 1e9])  # farther, the voxels' numbers exceed 64 bits
def test_voxels_hold_the_means_of_their_points(farthest_m: float) -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform(-8, 8, (20_000, 3))
    points[:2] = [[-farthest_m] * 3, [farthest_m] * 3]
    colours = rng.integers(0, 256, (len(points), 3)).astype(np.uint8)
    side_m = 3e-4 if farthest_m > 1e3 else 0.7
    voxel, member = np.unique(np.floor(points / side_m), axis=0, return_inverse=True)
    position, rgb, height = voxel_means(side_m, points, points, colours, points[:, 2])
    for values, found in ((points, position), (colours, rgb), (points[:, 2:], height[:, None])):
        sums = np.zeros((len(voxel), values.shape[1]))
        np.add.at(sums, member.ravel(), values)
        np.testing.assert_allclose(found, sums / np.bincount(member.ravel())[:, None], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("step", "look_px"), [(1, 8), (2, 8), (3, 1)])
def test_pixels_are_those_of_smooth_surfaces_in_the_box(step: int, look_px: int) -> None:
    """Ground and roof of a box from 36 m above: a pixel two off an edge is bent, and so are the image's rims."""
    depth = depth_map(looking_down(8)[3]).astype(np.float32)
    rgb = np.random.default_rng(1).integers(0, 256, (*depth.shape, 3)).astype(np.uint8)
    lens, scale = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]), 2.5
    turn, center, box = scale * DOWN.T, np.array([1000.0, -500.0, 90.0]), np.array([972.0, -527.0, 1027.0, -475.0])
    limits = PixelLimits(2, 0.01, 0.17, np.inf, step, look_px)
    position, normal, colour, pixel_m = chosen_pixels(depth, rgb, lens, turn, center, scale, box, limits)
    z = depth.astype(np.float64)
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]]
    ray = CAMERA.rays(np.stack([column, row], axis=-1) + 0.5)
    point = (z[..., None] * ray) @ turn.T + center
    middle, before, after = slice(2, -2), slice(None, -4), slice(4, None)
    cross = np.cross(point[middle, after] - point[middle, before], point[after, middle] - point[before, middle])
    own, expected = z[middle, middle], np.zeros(depth.shape, dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = own / z[middle, before] + own / z[middle, after] - 2
        down = own / z[before, middle] + own / z[after, middle] - 2
        unit = cross / np.linalg.norm(cross, axis=-1, keepdims=True)
    towards = center - point[middle, middle]
    cosine = np.einsum("hwi,hwi->hw", unit, towards) / np.maximum(np.linalg.norm(towards, axis=-1), 1e-300)
    expected[middle, middle] = (own > 0) & (np.maximum(abs(right), abs(down)) < 0.01) & (abs(cosine) > 0.17)
    expected &= ((point[..., :2] >= box[:2]) & (point[..., :2] < box[2:])).all(axis=-1)
    expected &= (row % step == step // 2) & (column % step == step // 2)
    assert expected.sum() > 50
    np.testing.assert_allclose(position, point[expected], atol=ROUNDING_M)
    np.testing.assert_allclose(normal, (unit * np.sign(cosine)[..., None])[expected[middle, middle]], atol=1e-9)
    assert (colour == rgb[expected]).all()
    np.testing.assert_allclose(pixel_m, scale * z[expected] / CAMERA.fx, rtol=1e-12)


def test_support_does_not_depend_on_which_points_share_a_choice_of_cameras() -> None:
    centers = np.array(looking_down(8))
    maps = np.concatenate([depth_map(center).astype(np.float32).ravel() for center in centers])
    views = DepthViews.of(Viewpoints(np.tile(DOWN, (8, 1, 1)), centers, (CAMERA,) * 8), maps)
    plan = np.random.default_rng(3).uniform(-15, 15, (3000, 2))
    points = np.column_stack([plan, np.zeros(len(plan))])
    up, normals = np.array([0.0, 0.0, 1.0]), np.tile([0.0, 0.0, 1.0], (len(points), 1))
    together = support(points, views, up, 0.01, normals)
    assert together.views.max() >= 3
    for row in range(0, len(points), 100):
        alone = support(points[row : row + 1], views, up, 0.01, normals[:1])
        for name, values in vars(alone).items():
            np.testing.assert_array_equal(values[0], vars(together)[name][row], err_msg=name)
