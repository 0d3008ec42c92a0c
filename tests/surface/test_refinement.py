"""Refinement on finer pixels of the surface that a sweep gives on coarse ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.core.types import Float32Array
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.surface import depth_maps
from pipelines.surface.agreement import (
    LEAST_SCORE,
    SurfacePrior,
    agreed_depth,
    refine,
    surface_prior,
)
from pipelines.surface.matching import UNSEEN, MatchSettings, StereoView
from pipelines.surface.sweep import NormalMap, SweepResult, plane_sweep
from tests.stereo_scenes import (
    CAMERA,
    GROUND_M,
    LEVEL,
    TENTH_PX_M,
    depth_estimate,
    level_normals,
    looking_at_origin,
    neighbours_of,
    painted,
    photographed,
    ring_of_views,
    true_depth,
)

FINE = Pinhole(240, 180, 220.0, 220.0, 120.0, 90.0)  # pixels of half the width
INNER = np.s_[16:-16, 16:-16]
STEP_M, STEPS = 0.25, depth_maps.FINE.steps


@pytest.fixture(scope="module")
def fine() -> list[StereoView]:
    return ring_of_views(FINE)


@pytest.fixture(scope="module")
def coarse() -> list[SweepResult]:
    ring = ring_of_views()
    return [depth_estimate(ring, index) for index in range(5)]


def height_error(camera: ViewPose, offset_m: Float32Array) -> np.ndarray:
    return np.asarray(offset_m - level_normals(FINE).offset(camera, true_depth(camera).astype(np.float32)))


def shifted_truth(camera: ViewPose, off_m: float) -> SurfacePrior:
    """Return the true surface, raised by `off_m`."""
    offset = level_normals(FINE).offset(camera, true_depth(camera).astype(np.float32)) + off_m
    return SurfacePrior(level_normals(FINE), offset.astype(np.float32), np.full(offset.shape, STEP_M, np.float32))


def test_offsets_are_the_inverse_of_depths(fine: list[StereoView]) -> None:
    camera = fine[1].camera
    offset = np.random.default_rng(0).uniform(-3, 9, (FINE.height, FINE.width)).astype(np.float32)
    index = np.random.default_rng(1).integers(0, 2, offset.shape).astype(np.uint8)
    normals = NormalMap(np.array([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0]]), index)
    depth = normals.depth(camera, offset).astype(np.float32)
    steep = np.abs(normals.offset_per_metre(camera)) > 0.1
    # Depths of 30 m and, of rays along the planes, hundreds, in single precision.
    np.testing.assert_allclose(normals.offset(camera, depth)[steep], offset[steep], atol=1e-4)


@pytest.mark.parametrize("off_m", [0.0, 0.6, -0.6])
def test_a_guess_within_reach_is_corrected(fine: list[StereoView], off_m: float) -> None:
    refined = refine(fine[2], neighbours_of(fine, 2), shifted_truth(fine[2].camera, off_m), MatchSettings())
    error = height_error(fine[2].camera, refined.offset_m)[INNER]
    trusted = refined.score[INNER] > LEAST_SCORE
    assert trusted.mean() > 0.9
    assert np.median(np.abs(error[trusted])) < TENTH_PX_M / 2  # pixels are half as wide
    np.testing.assert_array_equal(refined.step_m, STEP_M)


def test_a_guess_out_of_reach_has_no_score(fine: list[StereoView]) -> None:
    refined = refine(fine[2], neighbours_of(fine, 2), shifted_truth(fine[2].camera, 3.0), MatchSettings())
    # By chance some texture fits itself elsewhere: less than half, and not well.
    assert (refined.score[INNER] > LEAST_SCORE).mean() < 0.25
    assert (refined.score[INNER] == UNSEEN).any()


def test_the_ground_beside_a_roof_is_not_taken_for_roof(fine: list[StereoView], coarse: list[SweepResult]) -> None:
    """A sweep of planes on the same fine pixels takes the ground for roof."""
    camera = fine[2].camera
    depth = true_depth(camera)
    height = level_normals(FINE).offset(camera, depth.astype(np.float32))
    roof = (height > GROUND_M + 3).astype(np.uint8)
    beside = (cv2.dilate(roof, np.ones((9, 9), np.uint8)) > roof)[INNER]
    agreed = agreed_depth(coarse[2], [coarse[index] for index in (0, 1, 3, 4)])
    refined = refine(
        fine[2], neighbours_of(fine, 2), surface_prior(coarse[2], agreed, camera, STEPS), MatchSettings()
    )
    planes = plane_sweep(fine[2], neighbours_of(fine, 2), [LEVEL], MatchSettings())
    trusted = LEAST_SCORE
    wrong = [
        ((np.abs(height_error(camera, result.offset_m)) > 0.5) & (result.score > trusted))[INNER]
        for result in (refined, planes)
    ]
    assert wrong[0][beside].mean() < 0.5 * wrong[1][beside].mean()
    assert wrong[0].mean() < 0.1


WALL = np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0.0])  # through the origin, turned from the views


def _foot_of_a_wall(azimuth_deg: float) -> tuple[StereoView, np.ndarray, np.ndarray]:
    """Return a view, its true depth, and the mask of the wall, below which the ground begins."""
    rotation, center = looking_at_origin(azimuth_deg, 22.0, 30.0)
    camera = ViewPose(FINE, rotation, center)
    rays = camera.rays()
    wall, ground = -(center @ WALL) / (rays @ WALL), -center[2] / rays[..., 2]
    upright = wall < ground
    depth = np.where(upright, wall, ground)
    place = center + depth[..., None] * rays
    side = np.cross([0.0, 0.0, 1.0], WALL)
    grey = np.where(upright, painted(3, place @ side, place[..., 2]), painted(4, place[..., 0], place[..., 1]))
    return photographed(camera, grey), depth, upright


def test_small_windows_leave_the_foot_of_a_wall_where_it_is() -> None:
    """A wide window lays the surface across the corner, within a reach of a few pixels."""
    (view, depth, upright), *others = [_foot_of_a_wall(azimuth) for azimuth in (0, -24, -12, 12, 24)]
    normals = NormalMap(np.stack([LEVEL.normal_in_model, WALL]), upright.astype(np.uint8))
    offset = normals.offset(view.camera, (depth + 0.3).astype(np.float32)).astype(np.float32)
    prior = SurfacePrior(normals, offset, np.full(offset.shape, STEP_M, np.float32))
    edge = cv2.morphologyEx(upright.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((9, 9), np.uint8)) > 0
    wrong = []
    for settings in (depth_maps.FINE.settings, depth_maps.MIDDLE.settings):
        refined = refine(view, [other[0] for other in others], prior, settings)
        error = np.abs(normals.depth(view.camera, refined.offset_m) - depth)
        wrong.append(np.median(error[INNER][edge[INNER]]))
    assert wrong[0] < TENTH_PX_M
    assert wrong[0] < 0.8 * wrong[1]


def test_guesses_are_what_views_agree_on(fine: list[StereoView], coarse: list[SweepResult]) -> None:
    own = coarse[2]
    agreed = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    agreed[10:20, 10:20] = level_normals().depth(own.camera, np.full(agreed.shape, 7.0, np.float32))[10:20, 10:20]
    prior = surface_prior(own, agreed, fine[2].camera, STEPS)
    assert prior.offset_m.shape == (FINE.height, FINE.width)
    np.testing.assert_allclose(prior.offset_m[20:40, 20:40], 7.0, atol=1e-4)
    # Elsewhere it is the view's own.
    elsewhere = np.s_[60:120, 60:180]
    own_error = height_error(fine[2].camera, prior.offset_m)[elsewhere]
    assert np.median(np.abs(own_error)) < 2 * TENTH_PX_M  # and half a coarse pixel of slope
    np.testing.assert_allclose(prior.step_m, 0.5 / 3, rtol=1e-6)  # a third of that of the sweep


def test_pixels_that_nothing_fits_find_nothing(fine: list[StereoView], coarse: list[SweepResult]) -> None:
    empty = plane_sweep(*_nothing_to_see(), [LEVEL], MatchSettings())
    assert np.isnan(empty.offset_m).all()
    prior = surface_prior(empty, np.zeros((CAMERA.height, CAMERA.width), np.float32), fine[2].camera, STEPS)
    assert np.isfinite(prior.offset_m).all()
    refined = refine(fine[2], neighbours_of(fine, 2), prior, MatchSettings())
    assert (refined.score[INNER] > LEAST_SCORE).mean() < 0.05


def _nothing_to_see() -> tuple[StereoView, list[StereoView]]:
    ring = ring_of_views()
    return ring[2], [StereoView(ring[3].camera, np.zeros_like(ring[3].grey))]


def test_refinement_needs_neighbours(fine: list[StereoView]) -> None:
    with pytest.raises(ValueError, match="no neighbours"):
        refine(fine[2], [], shifted_truth(fine[2].camera, 0.0), MatchSettings())
