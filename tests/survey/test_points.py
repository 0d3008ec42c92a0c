"""Surveyed points found again, with exact cameras, marks and depths: both ways must give the point itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from pipelines.geometry.cameras import CameraPoses, Pinhole
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.surface.picking import DepthMap, points_on_surface
from pipelines.survey.marks import MarkRays, mark_rays, triangulated_points
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey, SurveyedPoint
from tests.scenes import (
    GEO_FROM_LOCAL,
    Measured,
    Noise,
    make_scene,
    sparse_model,
    survey_of,
    trained_cameras,
    trained_model,
)

pytestmark = pytest.mark.usefixtures("one_thread")

EXACT = Noise(mark_px=1e-7, gcp_m=1e-9)
MODEL_FROM_GEO = Similarity(1.0, exp_so3([0.01, 0.02, -0.03]), np.array([-10.0, 20.0, -5.0]))
PINHOLE = Pinhole(320, 240, 270.0, 270.0, 160.0, 120.0)


class Solved(NamedTuple):
    """Survey, its solution, and the SfM model, of which the solution leaves the lenses as they are."""

    survey: Survey
    solution: Solution
    sparse: SparseModel


@pytest.fixture
def solved() -> Solved:
    """Exact cameras in a frame `model` that is turned against `geo`."""
    truth, rng = make_scene(images=8, points=20), np.random.default_rng(0)
    geo_from_model = MODEL_FROM_GEO.inverse()
    rotation = np.swapaxes(truth.geo_from_cam, 1, 2) @ geo_from_model.rotation
    poses = CameraPoses(rotation, MODEL_FROM_GEO.apply(truth.center_in_geo))
    cameras = trained_cameras(truth.names, poses)
    survey, sparse = survey_of(truth, EXACT, Measured(gcps=True), rng), sparse_model(truth, EXACT, rng)
    return Solved(survey, trained_model(geo_from_model, MODEL_FROM_GEO @ GEO_FROM_LOCAL, cameras=cameras), sparse)


def surveyed(points: tuple[SurveyedPoint, ...]) -> np.ndarray:
    return np.array([point.position_in_geo for point in points])


def planes(solved: Solved, height_m: float) -> dict[int, np.ndarray]:
    """Depth maps (along z) of a level plane in geo, by camera."""
    v, u = np.mgrid[0 : PINHOLE.height, 0 : PINHOLE.width] + 0.5
    ray = np.stack([(u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy, np.ones_like(u)], axis=-1)
    depth, poses, geo_from_model = {}, solved.solution.poses, solved.solution.similarity
    for index, rotation in enumerate(poses.cam_from_model):
        direction = ray @ (geo_from_model.rotation @ rotation.T).T
        center = geo_from_model.apply(poses.cam_center_in_model[index])
        along = (height_m - center[2]) / np.minimum(direction[..., 2], -1e-9)
        depth[index] = np.where(direction[..., 2] < -0.05, along, 0.0)
    return depth


def maps(rays: MarkRays, depth_m: dict[int, np.ndarray]) -> list[DepthMap]:
    return [DepthMap(PINHOLE, depth_m[int(camera)]) for camera in rays.camera]


def measured(solved: Solved, points: tuple[SurveyedPoint, ...], depth_m: dict[int, np.ndarray]) -> np.ndarray:
    rays = mark_rays(points, solved.sparse)
    return points_on_surface(solved.solution, rays, maps(rays, depth_m))


def test_rays_meet_in_the_surveyed_point(solved: Solved) -> None:
    points = solved.survey.control_points
    found = triangulated_points(solved.solution, mark_rays(points, solved.sparse))
    np.testing.assert_allclose(found, surveyed(points), atol=1e-6)


def test_depth_gives_the_surveyed_point(solved: Solved) -> None:
    # The surface is a plane at the point's height: inverse depth is linear, so that interpolation is exact.
    points = solved.survey.control_points[:1]
    rays = mark_rays(points, solved.sparse)
    depth = planes(solved, points[0].position_in_geo[2])
    found = points_on_surface(solved.solution, rays, maps(rays, depth))
    np.testing.assert_allclose(found, surveyed(points), atol=1e-5)


def test_windows_around_the_marks_are_enough(solved: Solved) -> None:
    points, rng = solved.survey.control_points[:1], np.random.default_rng(6)
    rays = mark_rays(points, solved.sparse)
    depth = planes(solved, points[0].position_in_geo[2])
    rough = {i: each * (1 + 0.002 * rng.standard_normal(each.shape)) for i, each in depth.items()}
    windows = []
    for camera, xy in zip(rays.camera.tolist(), rays.xy, strict=True):
        column, row = (int(value) for value in PINHOLE.fx * xy + [PINHOLE.cx, PINHOLE.cy])
        left, top = max(column - 1, 0), max(row - 1, 0)
        windows.append(DepthMap(PINHOLE, rough[camera][top : row + 2, left : column + 2], left, top))
    np.testing.assert_array_equal(
        points_on_surface(solved.solution, rays, windows),
        points_on_surface(solved.solution, rays, maps(rays, rough)),
    )


def test_surface_at_another_height_is_measured_as_such(solved: Solved) -> None:
    points = solved.survey.control_points[:1]
    depth = planes(solved, points[0].position_in_geo[2] - 1.0)
    found = measured(solved, points, depth)
    assert found[0, 2] - points[0].position_in_geo[2] == pytest.approx(-1.0, abs=0.05)


def test_roughness_of_the_surface_is_evened_out(solved: Solved) -> None:
    # 25 pixels of independent noise leave a fifth of it in the middle of their plane.
    points, rng = solved.survey.control_points[:1], np.random.default_rng(5)
    rays = mark_rays(points, solved.sparse)
    depth = planes(solved, points[0].position_in_geo[2])
    roughness = 0.002
    rough = {i: each * (1 + roughness * rng.standard_normal(each.shape)) for i, each in depth.items()}
    found = points_on_surface(solved.solution, rays, maps(rays, rough))
    centers = solved.solution.center_in_geo[rays.camera]
    distance = float(np.linalg.norm(centers - surveyed(points), axis=1).max())
    sigma_of_view = roughness * distance / 5
    assert np.linalg.norm(found - surveyed(points)) < 3 * sigma_of_view * 1.25 / np.sqrt(len(rays.point))


def test_wrong_surface_in_few_views_is_outvoted(solved: Solved) -> None:
    points = solved.survey.control_points[:1]
    rays = mark_rays(points, solved.sparse)
    depth = planes(solved, points[0].position_in_geo[2])
    views = sorted({int(i) for i in rays.camera})
    depth[views[0]] = depth[views[0]] * 0.3  # a floater before the camera
    depth[views[1]] = depth[views[1]] * 0.0  # nothing there
    found = points_on_surface(solved.solution, rays, maps(rays, depth))
    assert np.linalg.norm(found - surveyed(points)) < 0.01


def test_points_with_too_few_views_are_not_measured(solved: Solved) -> None:
    first = solved.survey.control_points[0]
    lonely = (first.model_copy(update={"marks": first.marks[:1]}), first.model_copy(update={"marks": ()}))
    rays = mark_rays(lonely, solved.sparse)
    depth = planes(solved, 0.0)
    assert np.isnan(triangulated_points(solved.solution, rays)).all()
    assert np.isnan(points_on_surface(solved.solution, rays, maps(rays, depth))).all()


def test_marks_outside_of_the_map_or_lens_are_no_hits(solved: Solved) -> None:
    first = solved.survey.control_points[0]
    away = first.model_copy(update={"marks": tuple(m.model_copy(update={"x_px": -500.0}) for m in first.marks)})
    depth = planes(solved, 0.0)
    found = measured(solved, (away,), depth)
    assert np.isnan(found).all()


def test_no_points_at_all(solved: Solved) -> None:
    rays = mark_rays((), solved.sparse)
    assert rays.xy.shape == (0, 2)
    assert triangulated_points(solved.solution, rays).shape == (0, 3)
    assert points_on_surface(solved.solution, rays, []).shape == (0, 3)
