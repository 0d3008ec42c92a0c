"""Plane sweeps and agreement on a scene that is known exactly: a step in level ground, seen from a ring."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.cameras import ViewPose
from pipelines.geometry.network import Network
from pipelines.surface.agreement import agreed_depth
from pipelines.surface.matching import MatchSettings, StereoView
from pipelines.surface.sweep import (
    SweepPlanes,
    SweepResult,
    best_neighbours,
    plane_sweep,
    planes_for,
)
from tests.stereo_scenes import (
    CAMERA,
    GROUND_M,
    LEVEL,
    ROOF_M,
    TENTH_PX_M,
    depth_estimate,
    level_normals,
    looking_at_origin,
    painted,
    photographed,
    ring_of_views,
    true_depth,
)


@pytest.fixture(scope="module")
def ring() -> list[StereoView]:
    return ring_of_views()


def test_sweep_finds_ground_and_roof(ring: list[StereoView]) -> None:
    estimate = depth_estimate(ring, 2)
    depth = estimate.depth()
    error = (depth - true_depth(ring[2].camera)) * np.abs(ring[2].camera.rays()[..., 2])
    inner = np.s_[8:-8, 8:-8]
    assert np.median(np.abs(error[inner])) < TENTH_PX_M
    # The strips beside the roof that fewer than three neighbours see are a tenth of the picture.
    assert (np.abs(error[inner]) < 0.5).mean() > 0.85


def test_views_that_agree_leave_few_errors(ring: list[StereoView]) -> None:
    surfaces = [depth_estimate(ring, index) for index in range(len(ring))]
    depth = agreed_depth(surfaces[2], [surfaces[index] for index in (0, 1, 3, 4)])
    known = depth > 0
    height_error = (depth - true_depth(ring[2].camera)) * np.abs(ring[2].camera.rays()[..., 2])
    alone = np.abs(surfaces[2].depth() - true_depth(ring[2].camera)) > 0.5
    assert known.mean() > 0.7
    assert (np.abs(height_error[known]) < 0.5).mean() > 0.97
    # Other views see the errors of one view differently.
    assert (np.abs(height_error[known]) >= 0.5).mean() < 0.5 * alone.mean()


def test_what_no_other_view_confirms_is_left_out(ring: list[StereoView]) -> None:
    own = depth_estimate(ring, 2)
    assert not agreed_depth(own, []).any()


def test_a_place_that_views_look_through_is_no_surface(ring: list[StereoView]) -> None:
    """Two views that err alike, as beside a roof, against two that see the ground behind."""
    raised = (slice(20, 40), slice(20, 40))

    def flat(index: int, height_m: float) -> SweepResult:
        camera = ring[index].camera
        offset = np.zeros((CAMERA.height, CAMERA.width), np.float32)
        offset[raised] = height_m
        ones = np.ones_like(offset)
        return SweepResult(camera, level_normals(), offset, ones, 0.5 * ones, ones)

    own, alike, clear = flat(2, 4.0), [flat(2, 4.0), flat(2, 4.0)], [flat(2, 0.0), flat(2, 0.0)]
    assert (agreed_depth(own, alike)[raised] > 0).all()
    outvoted = agreed_depth(own, alike + clear)
    assert not outvoted[raised].any()
    assert (outvoted[45:] > 0).all()
    # Views that see something nearer have it in their way, which says nothing.
    hidden = agreed_depth(flat(2, 0.0), [*clear, *alike])
    assert (hidden > 0).all()


def test_planes_behind_the_camera_are_never_chosen(ring: list[StereoView]) -> None:
    above = SweepPlanes(np.array([0.0, 0.0, 1.0]), np.array([31.0, 32.0, 33.0, 0.0]))
    sweep = plane_sweep(ring[2], ring[3:5], [above], MatchSettings())
    assert np.nanmin(np.abs(sweep.offset_m - 33.0)) > 1  # all on the only plane in front, or none at all


def test_a_sweep_needs_neighbours_and_planes(ring: list[StereoView]) -> None:
    with pytest.raises(ValueError, match="0 neighbours"):
        plane_sweep(ring[0], [], [LEVEL], MatchSettings())
    with pytest.raises(ValueError, match="2 planes"):
        plane_sweep(ring[0], ring[1:2], [SweepPlanes(LEVEL.normal_in_model, np.array([0.0, 1.0]))], MatchSettings())


def grid_points() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-8, 8, 9))
    high = (np.abs(x) < 4) & (np.abs(y) < 4)
    return np.stack([x, y, np.where(high, ROOF_M, GROUND_M)], axis=-1).reshape(-1, 3)


def test_neighbours_are_those_under_good_angles(ring: list[StereoView]) -> None:
    points = grid_points()
    count = len(points)
    network = Network(
        cameras={},
        camera_id=np.zeros(len(ring), np.int64),
        cam_from_world=np.array([view.camera.cam_from_model for view in ring]),
        cam_center_in_world=np.array([view.camera.center_in_model for view in ring]),
        point_in_world=points,
        obs_point=np.tile(np.arange(count), len(ring)),
        obs_image=np.repeat(np.arange(len(ring)), count),
        obs_xy_px=np.zeros((len(ring) * count, 2)),
    )
    neighbours = best_neighbours(network, 2, np.arange(len(ring)), 2)
    assert set(neighbours) == {1, 3}  # 13° and less from the scene; the next ones are at 26°
    assert 5 not in best_neighbours(network, 2, np.array([0, 1, 3, 4]), 9)


def test_planes_follow_the_view(ring: list[StereoView]) -> None:
    points = grid_points()
    flat, across = planes_for(ring[2].camera, [view.camera for view in ring[3:5]], points)
    np.testing.assert_allclose(flat.normal_in_model, [0, 0, 1])
    assert flat.offset_m.min() < GROUND_M < ROOF_M < flat.offset_m.max()
    ahead = ring[2].camera.cam_from_model[2] * [1, 1, 0]
    np.testing.assert_allclose(across.normal_in_model, ahead / np.linalg.norm(ahead))
    along = points @ across.normal_in_model
    assert across.offset_m.min() < along.min() < along.max() < across.offset_m.max()
    assert across.height_m == pytest.approx((flat.offset_m.min(), flat.offset_m.max()))


def test_a_level_view_needs_planes_across_it_alone() -> None:
    level = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    rotation = np.stack([level[1], -np.array([0.0, 0, 1]), np.cross(level[1], [0.0, 0, -1])])
    facade = ViewPose(CAMERA, rotation, np.array([-40.0, 0.0, 3.0]) * np.sign(rotation[2, 0]))
    side = ViewPose(CAMERA, rotation, facade.center_in_model + np.array([0.0, 6.0, 0.0]))
    (across,) = planes_for(facade, [side], grid_points())
    np.testing.assert_allclose(np.abs(across.normal_in_model), [1, 0, 0], atol=1e-12)
    depth = across.offset_m - across.normal_in_model @ facade.center_in_model
    assert 0 < depth.min() < 32  # the points are 32 to 48 m away
    assert depth.max() > 48


def test_from_straight_above_there_are_level_planes_alone() -> None:
    rotation = np.diag([1.0, -1.0, -1.0])
    above = ViewPose(CAMERA, rotation, np.array([0.0, 0.0, 40.0]))
    side = ViewPose(CAMERA, rotation, np.array([8.0, 0.0, 40.0]))
    (planes,) = planes_for(above, [side], grid_points())
    np.testing.assert_allclose(planes.normal_in_model, [0, 0, 1])


@pytest.fixture(scope="module")
def wall() -> tuple[StereoView, list[StereoView], np.ndarray]:
    """Return a view down on a wall that is turned by 30°, its neighbours, and the true depth (H, W)."""
    normal = np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0.0])
    side = np.cross([0.0, 0.0, 1.0], normal)
    views, depths = [], []
    for azimuth in (-24, -12, 0, 12, 24):
        rotation, center = looking_at_origin(azimuth, 18.0, 34.0)
        camera = ViewPose(CAMERA, rotation, center)
        depths.append(-(center @ normal) / (camera.rays() @ normal))
        place = center + depths[-1][..., None] * camera.rays()
        views.append(photographed(camera, painted(3, place @ side, place[..., 2])))
    return views[2], [*views[:2], *views[3:]], depths[2]


def upright(view: StereoView, height_m: tuple[float, float] = (-np.inf, np.inf)) -> SweepPlanes:
    """Return upright planes across a view."""
    ahead = view.camera.cam_from_model[2] * [1, 1, 0]
    return SweepPlanes(ahead / np.linalg.norm(ahead), np.arange(-10.0, 10.0, 0.5), height_m)


def test_walls_are_found_on_upright_planes(wall: tuple[StereoView, list[StereoView], np.ndarray]) -> None:
    """Level planes cut the wall, and see other texture."""
    reference, others, truth = wall
    flat = SweepPlanes(LEVEL.normal_in_model, np.arange(-12.0, 12.0, 0.5))
    inner = np.s_[10:-10, 10:-10]
    wrong = []
    for sweeps in ([flat], [flat, upright(reference)]):
        estimate = plane_sweep(reference, others, sweeps, MatchSettings())
        wrong.append((np.abs(estimate.depth() - truth)[inner] > 0.5).mean())
    assert wrong[1] < 0.5 * wrong[0]
    assert wrong[1] < 0.15


def test_only_the_rows_that_may_show_the_scene_are_compared(
    wall: tuple[StereoView, list[StereoView], np.ndarray],
) -> None:
    reference, others, truth = wall
    heights = (-4.0, 3.0)
    whole, part = (
        plane_sweep(reference, others, [planes], MatchSettings())
        for planes in (upright(reference), upright(reference, heights))
    )

    def height(depth: np.ndarray) -> np.ndarray:
        return reference.camera.center_in_model[2] + depth * reference.camera.rays()[..., 2]

    height_m = height(part.depth())
    # Nothing beyond; a parabola goes half a step of 0.5 m from a plane, on rays that fall by 18 m in 34 m.
    assert np.nanmin(height_m) > heights[0] - 0.2
    assert np.nanmax(height_m) < heights[1] + 0.2
    # Within, planes before and after it are compared as well, and it is what a sweep of all rows finds.
    inner = (height(truth) > heights[0] + 1) & (height(truth) < heights[1] - 1)
    inner &= np.abs(whole.depth() - truth) < 0.3
    assert inner.mean() > 0.05
    np.testing.assert_allclose(part.offset_m[inner], whole.offset_m[inner], atol=1e-3)
    np.testing.assert_allclose(part.score[inner], whole.score[inner], atol=1e-3)


def test_too_few_points_give_no_planes(ring: list[StereoView]) -> None:
    assert planes_for(ring[2].camera, [view.camera for view in ring[3:5]], grid_points()[:3]) == []
