"""Measuring on a hill whose surface is known: points, lengths, areas and volumes against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import MissingProductError
from pipelines.core.products import NOT_CHECKED, Remark
from pipelines.core.workspace import Workspace
from pipelines.surface.picking import NoSurface, Sight, SurfacePoint, depth_around, points_on_surface
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.marks import mark_rays
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.view.measuring import ESTIMATE, Fineness, MeasuringModel, WantedBase, pointing_covariance
from pipelines.view.pictures import ViewerCamera, frame_of
from pipelines.view.quantities import along_line, distances
from tests.splat_scenes import ground_height
from tests.view_scenes import renderer_of

pytestmark = pytest.mark.usefixtures("one_thread")

# The photographs are 96 px wide: a pixel is 0.5 m of the ground, and depth is linear within one.
PIXEL_M = 0.5


def sight(start: list[float], target: np.ndarray) -> Sight:
    line = target - np.array(start)
    return Sight(np.array(start), line / np.linalg.norm(line), 1 / 600)


def on_ground(east: float, north: float) -> np.ndarray:
    return np.array([east, north, float(ground_height(np.array(east), np.array(north)))])


@pytest.mark.parametrize("start", [[0.0, 0.0, 60.0], [45.0, -10.0, 25.0], [-20.0, 38.0, 30.0]])
def test_points_under_lines_of_sight_lie_on_the_hill(model: MeasuringModel, start: list[float]) -> None:
    # From places where no photograph was taken, steep and slanting.
    errors, sigmas = [], []
    for east, north in np.random.default_rng(3).uniform(-12, 12, (12, 2)):
        point = model.reader.under(sight(start, on_ground(east, north)))
        assert isinstance(point, SurfacePoint)
        place = point.position_in_geo
        line = np.array(start) - on_ground(east, north)
        across = np.cross(place - on_ground(east, north), line / np.linalg.norm(line))
        assert np.linalg.norm(across) < 1e-6  # it lies on the line
        errors.append(float(place[2] - ground_height(place[0], place[1])))
        sigmas.append(float(np.sqrt(point.cov_of_surface[2, 2])))
    # Blurred to a pixel, the discs before a disc on a slope hide a part of it: the surface stands a little high.
    assert 0 < np.median(errors) < 0.25 * PIXEL_M
    scatter = np.array(errors) - np.median(errors)
    assert np.max(np.abs(scatter)) < 0.15 * PIXEL_M
    assert np.sqrt(np.mean((scatter / sigmas) ** 2)) < 1.5
    assert np.median(sigmas) < 0.3 * PIXEL_M


def test_surveyed_points_are_measured_as_by_evaluate(model: MeasuringModel) -> None:
    survey, renderer = model.survey, model.reader.renderer
    rays = mark_rays(survey.check_points, renderer.sparse)
    maps = [depth_around(renderer, int(camera), xy) for camera, xy in zip(rays.camera, rays.xy, strict=True)]
    expected = points_on_surface(model.solution, rays, maps)
    for row, point in enumerate(survey.check_points):
        measured = model.reader.behind_marks(mark_rays((point,), renderer.sparse))
        assert isinstance(measured, SurfacePoint)
        np.testing.assert_allclose(measured.position_in_geo, expected[row], atol=1e-9)


def test_nothing_is_measured_where_nothing_is(model: MeasuringModel) -> None:
    up = model.reader.under(Sight(np.array([0.0, 0.0, 40.0]), np.array([0.0, 0.0, 1.0]), 1 / 600))
    assert isinstance(up, NoSurface)
    assert "nothing of the model" in up.reason


def test_what_photographs_look_through_is_no_surface(viewed, model: MeasuringModel) -> None:
    # A disc in the air that the model has and no training view agrees on: from above, it hides the hill.
    renderer = renderer_of(viewed)
    gaussians = renderer.gaussians
    row = int(np.argmin(np.linalg.norm(gaussians.means.numpy()[:, :2] - [4.0, 4.0], axis=1)))
    gaussians.means[row, 2] = 24.0
    gaussians.log_scales[row] = np.log(0.15)
    shown = MeasuringModel(viewed, load_survey(viewed), renderer, CrsOptions())
    place = gaussians.means[row].double().numpy()
    point = shown.reader.under(sight([place[0], place[1], 60.0], place))
    assert not isinstance(point, SurfacePoint) or abs(point.position_in_geo[2] - 24.0) > 10


def corners(model: MeasuringModel, half: float) -> list[SurfacePoint]:
    places = [(-half, -half), (half, -half), (half, half), (-half, half)]
    points = [model.reader.under(sight([0.0, 0.0, 80.0], on_ground(*place))) for place in places]
    assert all(isinstance(point, SurfacePoint) for point in points)
    return [point for point in points if isinstance(point, SurfacePoint)]


def test_areas_volumes_and_a_profile_of_the_hill(model: MeasuringModel) -> None:
    square = corners(model, 10.0)
    plan, surface, coverage = model.area(square, Fineness())
    # The corners lie on lines of sight from the middle: an error of the height moves them out by a part of it.
    assert plan.value == pytest.approx(400.0, rel=0.01)
    axis = np.linspace(-10, 10, 201)
    east, north = np.meshgrid(axis, axis)
    height = ground_height(east, north)
    by_north, by_east = np.gradient(height, axis, axis)
    stretch = float(np.sqrt(1 + by_east**2 + by_north**2).mean())
    # The samples are 2 m apart, and the hill bends within that.
    assert surface.value / plan.value == pytest.approx(stretch, rel=0.02)
    assert coverage.value == pytest.approx(100.0, abs=3)
    corner = float(ground_height(np.array(10.0), np.array(10.0)))
    level = model.target.xyz_from_geo(np.array([[10.0, 10.0, corner]]))[0, 2]
    expected = float((height - corner).mean()) * 400.0
    # A tenth of a pixel of 0.5 m over the area is 5 % of the volume; the corners are such measurements, too.
    bases = (WantedBase("plane"), WantedBase("mean"), WantedBase("height", height=level))
    for base, fineness, off in [*((base, Fineness(), 0.04) for base in bases), (bases[0], ESTIMATE, 0.08)]:
        above, _, volume, _ = model.volume(square, base, fineness)
        assert volume.value == pytest.approx(expected, rel=off)
        assert above.value == pytest.approx(expected, rel=off)
        assert volume.sigma is not None
        assert 0.002 * expected < volume.sigma and abs(volume.value - expected) < 3 * volume.sigma
    line = model.profile(square[:3], Fineness())
    places, along_m = along_line(np.array([corner.position_in_geo[:2] for corner in square[:3]]), line.along_m[1])
    np.testing.assert_allclose(line.along_m, along_m)
    known = np.isfinite(line.height)
    assert known.mean() > 0.98
    truth = np.column_stack([places, ground_height(*places.T)])
    error = (line.height - model.target.xyz_from_geo(truth)[:, 2])[known]
    assert np.max(np.abs(error)) < 0.5 * PIXEL_M
    assert 0.1 < np.sqrt(np.mean((error / line.sigma_m[known]) ** 2)) < 2  # a model without errors


def test_shared_errors_cancel_in_distances(model: MeasuringModel) -> None:
    near = [model.reader.under(sight([0.0, 0.0, 60.0], on_ground(east, 2.0))) for east in (1.0, 3.0)]
    points = [point for point in near if isinstance(point, SurfacePoint)]
    _, sigma_m = model.coordinates(points[0])
    distance, plan, rise = distances(model.jointly(points))
    assert sigma_m is not None
    assert distance.sigma is not None and plan.sigma is not None and rise.sigma is not None
    of_surface = np.sqrt(sum(point.cov_of_surface[2, 2] for point in points))
    # Two metres apart, similarity and cameras move both alike: what is left is the surface's own.
    assert rise.sigma == pytest.approx(of_surface, rel=0.2)
    assert plan.sigma < 0.7 * np.hypot(*sigma_m[:2]) * np.sqrt(2)
    assert distance.value == pytest.approx(2.0, abs=0.2)


def test_no_sigma_is_stated_that_nothing_checks(viewed: Workspace, model: MeasuringModel, tmp_path: Path) -> None:
    """And the viewer solves nothing: without a stored posterior there is none."""
    renderer = model.reader.renderer
    unchecked = (Remark(code=NOT_CHECKED, sentence="Nothing checks the positions."),)
    silent = renderer.model.model_copy(update={"cautions": unchecked})
    other = ModelRenderer(silent, renderer.sfm, renderer.gaussians, renderer.images, renderer.backend)
    fresh = MeasuringModel(viewed, model.survey, other, CrsOptions())
    assert fresh.posterior is None and "nothing checks" in fresh.without_sigma
    with pytest.raises(MissingProductError, match=r"train/adjustment\.npz"):
        MeasuringModel(Workspace(tmp_path), model.survey, renderer, CrsOptions())


@pytest.mark.slow
@pytest.mark.parametrize("spread", ["normal", "whole pixels"])
def test_sigma_of_a_click_is_that_of_a_persons_pixel(model: MeasuringModel, spread: str) -> None:
    """Thirty distances, clicked a pixel beside the place: their error over the σ of pointing alone."""
    rng, frame = np.random.default_rng(11), frame_of(model.solution, model.reader.renderer.sfm)
    position = np.array([18.0, -42.0, 30.0])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera = ViewerCamera(rotation, position, 0.9, 640, 400)

    def clicked(pixel: np.ndarray) -> np.ndarray:
        found = model.reader.under(frame.sight(camera, *pixel))
        assert isinstance(found, SurfacePoint)
        return found.position_in_geo

    ratios = []
    for _ in range(30):
        places = [on_ground(*rng.uniform(-11, 11, 2)) for _ in range(2)]
        pixels = [camera.pinhole().project(rotation @ (frame.from_geo(place) - position)) for place in places]
        off = rng.normal(size=(2, 2)) if spread == "normal" else rng.integers(-1, 2, (2, 2))
        true = [clicked(np.array(pixel)) for pixel in pixels]
        wrong = [clicked(np.array(pixel) + by) for pixel, by in zip(pixels, off, strict=True)]
        along = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
        variance = sum(
            along @ pointing_covariance(model.reader, frame, camera, tuple(pixel)) @ along for pixel in pixels
        )
        error = np.linalg.norm(wrong[1] - wrong[0]) - np.linalg.norm(true[1] - true[0])
        ratios.append(error / np.sqrt(variance))
    assert 0.7 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.4
