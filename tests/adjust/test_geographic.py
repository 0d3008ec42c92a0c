"""The geographic half as training gets it: the truth fits its own measurements, and options switch what counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.control_by_depth import depth_residuals
from pipelines.adjust.frozen_solution import solution_of
from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.measurements import SURFACE_SIGMA
from pipelines.adjust.posterior import solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.terms import AttitudeTerm
from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Camera
from pipelines.geometry.lens import bearings
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.initial_similarity import AttitudeRecord
from pipelines.scene.scene import initial_scene
from pipelines.scene.survey import Mark, Survey
from pipelines.train.options import TrainOptions
from tests.scenes import NOISELESS, initial, material, without_fixes

pytestmark = pytest.mark.usefixtures("one_thread")

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = TrainOptions()


def test_truth_fits_exact_measurements() -> None:
    _, sparse, survey = material(NOISELESS)
    problem = geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), CONFIG)
    assert problem.fixes is not None
    assert problem.control is not None
    assert len(problem.fixes.camera) == 8
    assert len(problem.control.position_in_geo) == 6
    losses = problem.losses()
    # 1e-9 m and 1e-9 px of noise, whitened by as much, and rounding of 1e-13 of 100 m.
    assert float(losses["absolute"].detach()) < 10.0
    assert float(losses["control"].detach()) < 10.0
    assert float(losses["cameras"].detach()) == 0.0


def test_test_cameras_measure_nothing() -> None:
    _, sparse, survey = material()
    images = tuple(
        image.model_copy(update={"split": "test" if i < 3 else "train"}) for i, image in enumerate(survey.images)
    )
    split = survey.model_copy(update={"images": images})
    problem = geo_problem(initial_scene(sparse, split, initial()), split, initial(), CONFIG)
    assert problem.fixes is not None
    assert problem.control is not None
    assert problem.fixes.camera.tolist() == [3, 4, 5, 6, 7]
    assert set(problem.control.camera.tolist()) <= {3, 4, 5, 6, 7}


def test_unusable_marks_are_left_out() -> None:
    _, sparse, survey = material()
    first, second, *rest = survey.control_points
    alone = first.model_copy(update={"marks": first.marks[:1]})
    # 3 000 px from the centre the lens has long turned back: no ray leads there.
    outside = Mark(image=second.marks[0].image, x_px=-3000.0, y_px=447.0, sigma_px=0.3)
    partly = second.model_copy(update={"marks": (outside, *second.marks[1:])})
    spoilt = survey.model_copy(update={"control_points": (alone, partly, *rest)})
    folding = Camera("OPENCV", 1200, 900, np.array([1020.0, 1018.0, 603.0, 447.0, -0.2, 0.0, 3e-4, -2e-4]))
    problem = geo_problem(
        initial_scene(replace(sparse, cameras={1: folding}), spoilt, initial()), spoilt, initial(), CONFIG
    )
    assert problem.control is not None
    assert len(problem.control.position_in_geo) == 5
    assert (problem.control.point == 0).sum() == len(second.marks) - 1
    assert np.isfinite(float(problem.loss().detach()))


@pytest.mark.parametrize(("points", "held"), [(0, True), (2, True), (3, False), (6, False)])
def test_start_is_held_where_the_measurements_leave_it_open(points: int, held: bool) -> None:
    scene, sparse, survey = material()
    blind = without_fixes(survey, scene.names).model_copy(update={"control_points": survey.control_points[:points]})
    problem = geo_problem(initial_scene(sparse, blind, initial()), blind, initial(), CONFIG)
    assert problem.fixes is None
    assert problem.hold_prior is held
    if points:
        assert np.linalg.eigvalsh(solution_covariances(problem)[0]).min() > 0


def test_line_holds_its_start() -> None:
    _, sparse, survey = material()
    assert geo_problem(initial_scene(sparse, survey, initial()), survey, initial("line"), CONFIG).hold_prior
    assert not geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), CONFIG).hold_prior
    # With a boresight to estimate, the attitudes are observations themselves, and must not count twice.
    observed = TrainOptions(estimate="boresight")
    assert not geo_problem(initial_scene(sparse, survey, initial()), survey, initial("line"), observed).hold_prior


def test_line_holds_only_what_attitude_said() -> None:
    _, sparse, survey = material()
    start = initial("line")
    x, y, z, w = start.geo_from_local.quat_xyzw
    attitude = AttitudeRecord(quat_xyzw=(x, y, z, w), cov_rad2=((4e-4, 0, 0), (0, 4e-4, 0), (0, 0, 4e-4)))
    known = start.model_copy(update={"attitude": attitude})
    similarity = geo_problem(initial_scene(sparse, survey, known), survey, known, CONFIG).similarity
    # The start states σ 0.01 rad about every axis, the attitude 0.02: a quarter of what is known of the rotation.
    np.testing.assert_allclose(similarity.held, [0, 0, 0, 0, 0.25, 0.25, 0.25], atol=0.01)
    np.testing.assert_allclose(similarity.y.detach(), 0.0, atol=1e-9)


def test_covariance_of_the_start_is_about_the_cameras() -> None:
    _, sparse, survey = material()
    scene = initial_scene(sparse, survey, initial())
    problem = geo_problem(scene, survey, initial(), CONFIG)
    pivot = problem.similarity.pivot_in_geo
    np.testing.assert_allclose(
        pivot, (scene.poses.cam_center_in_model + scene.geo_from_model.translation).mean(axis=0)
    )
    arm = pivot - np.array([5.0, -3.0, 60.0])
    # σ 0.01 m of shift, 0.01 of scale and turn over the arm between the pivots.
    expected = 1e-4 * ((arm @ arm + 1) * np.eye(3))
    np.testing.assert_allclose(problem.similarity.prior_covariance()[4:, 4:], expected, rtol=1e-6, atol=1e-9)


def test_nothing_to_optimise_when_switched_off() -> None:
    _, sparse, survey = material()
    config = TrainOptions(geo_loss=False, optimize_cameras=False)
    problem = geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), config)
    assert problem.fixes is None
    assert problem.control is None
    assert len(problem.cameras.z) == 0


def test_what_init_sim3_has_rejected_stays_out_and_nothing_else_is_blamed() -> None:
    _, sparse, survey = material()
    start = initial().model_copy(update={"gnss_outliers": ("image_003.jpg",), "control_outliers": ("gcp0", "gcp4")})
    scene = initial_scene(sparse, survey, start)
    problem = geo_problem(scene, survey, start, CONFIG)
    assert problem.fixes is not None
    assert problem.control is not None
    assert 3 not in problem.fixes.camera.tolist()
    assert problem.control.point_id == ("gcp1", "gcp2", "gcp3", "gcp5")
    # A training that ends far from the minimum, as a short one does, contradicts every good measurement.
    with torch.no_grad():
        problem.similarity.y.add_(3.0)
    solution = solution_of(problem, scene, start)
    assert solution.gnss_outliers == ("image_003.jpg",)
    assert solution.control_outliers == ("gcp0", "gcp4")


def test_a_bias_that_only_rejected_control_points_show_is_none() -> None:
    _, sparse, survey = material()
    moved = tuple(
        point.model_copy(update={"position_in_geo": (point.position_in_geo[0] + 28.0, *point.position_in_geo[1:])})
        for point in survey.control_points
    )
    wrong = survey.model_copy(update={"control_points": moved})
    names = tuple(point.name for point in moved)
    rejecting = initial().model_copy(update={"control_outliers": names})
    for solve in ("joint", "once"):
        config = TrainOptions(solve=solve)
        assert geo_problem(initial_scene(sparse, wrong, initial()), wrong, initial(), config).errors.flights == 1
        assert geo_problem(initial_scene(sparse, wrong, rejecting), wrong, rejecting, config).errors.flights == 0


def biased(survey: Survey, offset_m: tuple[float, float, float]) -> Survey:
    """The survey with all positions moved by as much."""
    images = []
    for image in survey.images:
        assert image.fix is not None
        place = tuple(a + b for a, b in zip(image.fix.position_in_geo, offset_m, strict=True))
        images.append(image.model_copy(update={"fix": image.fix.model_copy(update={"position_in_geo": place})}))
    return survey.model_copy(update={"images": tuple(images)})


def problem_of(survey: Survey, sparse: SparseModel, **options: object) -> GeoProblem:
    config = TrainOptions.model_validate(options)
    return geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), config)


def test_bias_is_freed_where_control_points_show_it() -> None:
    _, sparse, survey = material()
    offset = (0.8, -0.5, 1.5)
    assert len(problem_of(survey, sparse).errors) == 0
    found = problem_of(biased(survey, offset), sparse)
    assert [part.name for part in found.errors.blocks] == ["bias"]
    # 2 to 3 cm over √8 fixes, 2 cm over √6 control points, and what 60 SfM points leave of the cameras.
    np.testing.assert_allclose(found.errors.vector().detach(), offset, atol=0.15)
    few = biased(survey, offset).model_copy(update={"control_points": survey.control_points[:2]})
    assert len(problem_of(few, sparse).errors) == 0
    assert len(problem_of(biased(survey, offset), sparse, estimate="none").errors) == 0
    assert len(problem_of(biased(survey, offset), sparse, gcp_loss=False).errors) == 0
    assert len(problem_of(biased(survey, offset), sparse, weighting="paper").errors) == 0


def test_errors_that_are_asked_for_are_there() -> None:
    _, sparse, survey = material()
    found = problem_of(survey, sparse, estimate="boresight,bias,lever-arm")
    assert [part.name for part in found.errors.blocks] == ["bias", "lever-arm", "boresight", "common"]
    attitudes = found.term(AttitudeTerm)
    assert attitudes is not None
    assert len(attitudes) == 8
    assert problem_of(survey, sparse).term(AttitudeTerm) is None
    value = found.errors.vector().detach().numpy()
    # None of them is there: noise of centimetres, and of half a degree over √8.
    assert np.abs(value[:6]).max() < 0.5
    assert np.abs(value[6:]).max() < np.radians(1.5)


@pytest.mark.parametrize("what", ["bias", "lever-arm", "boresight"])
def test_errors_of_nothing_are_refused(what: str) -> None:
    _, sparse, survey = material()
    images = tuple(image.model_copy(update={"fix": None, "attitude": None}) for image in survey.images)
    with pytest.raises(InputError, match=f"--estimate.*{what} cannot be estimated"):
        problem_of(survey.model_copy(update={"images": images}), sparse, estimate=what)


@pytest.mark.parametrize(
    ("options", "gone"),
    [
        ({"gcp_loss": False}, {"control"}),
        ({"rel_loss": False}, {"relative"}),
        ({"geo_loss": False}, {"absolute", "control", "relative"}),
        ({}, set()),
    ],
)
def test_terms_can_be_switched_off(options: dict[str, bool], gone: set[str]) -> None:
    _, sparse, survey = material()
    problem = problem_of(survey, sparse, **options)
    assert {"absolute", "control", "relative"} - {term.kind for term in problem.terms} == gone
    assert problem.control_by_depth is None


def test_depth_mode_finds_control_points_by_the_surface() -> None:
    truth, sparse, survey = material(NOISELESS)
    found = problem_of(survey, sparse, gcp_mode="depth")
    marks, control = found.control_by_depth, found.control
    assert marks is not None
    assert control is not None
    assert marks.views == 8
    assert float(marks.share.sum()) == pytest.approx(6.0)
    for camera, rows in marks.rows.items():
        assert set(marks.camera[rows].tolist()) == {camera}
        # At the true depth of each mark lies its control point.
        pose = found.cameras.pose(camera)
        position = marks.position_in_geo[rows].numpy() - truth.center_in_geo[camera]
        depth = torch.from_numpy(position @ truth.geo_from_cam[camera][:, 2])
        ray, surveyed = marks.rays(rows, found.cameras.lens()), marks.position_in_geo[rows]
        missed = depth_residuals(pose, found.estimate().geo_from_model, surveyed, ray, depth)
        np.testing.assert_allclose(missed.detach(), 0.0, atol=1e-6)
        sigma = 1 / np.linalg.svd(marks.root_information[rows].numpy(), compute_uv=False)
        distance = np.linalg.norm(position, axis=1)
        np.testing.assert_allclose(sigma, SURFACE_SIGMA * distance[:, None].repeat(3, axis=1), rtol=1e-6)
    # The intersected points stand for them in the covariance, with the same σ.
    sigma = 1 / np.linalg.svd(control.root_information.numpy(), compute_uv=False)
    assert (sigma > 0.5 * SURFACE_SIGMA * 100).all()


def test_marks_follow_the_lens_as_the_lens_itself_would_have_them() -> None:
    _, sparse, survey = material(NOISELESS)
    found = problem_of(survey, sparse, gcp_mode="depth")
    marks, by_depth = found.control, found.control_by_depth
    lenses = sparse.lenses
    assert marks is not None
    assert by_depth is not None
    change = np.zeros(found.cameras.lens_basis.shape[0])
    change[:3] = 0.5, -0.4, 0.3  # pixels
    index, moved = sparse.image_index(), lenses.moved(change)
    wanted = [
        bearings(moved.of(index[mark.image]), np.array([[mark.x_px, mark.y_px]]))[0]
        for point in survey.control_points
        for mark in point.marks
    ]
    told = marks.bearings(torch.from_numpy(change)).numpy()
    # Second order: half a pixel over a focal length of a thousand, squared.
    np.testing.assert_allclose(told, np.array(wanted), atol=1e-6)
    assert np.abs(told - marks.bearing_in_cam.numpy()).max() > 2e-4
    order = np.argsort(marks.camera.numpy(), kind="stable")
    slope = by_depth.rays(slice(None), torch.from_numpy(change)).numpy()
    np.testing.assert_allclose(slope, told[order, :2] / told[order, 2:], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "follows"), [({}, True), ({"weighting": "paper"}, False), ({"optimize_cameras": False}, False)]
)
def test_lens_follows_where_something_holds_it(options: dict[str, object], follows: bool) -> None:
    _, sparse, survey = material()
    cameras = problem_of(survey, sparse, **options).cameras
    assert len(cameras.lens()) == follows * len(sparse.cameras[1].params)
    assert len(cameras.z) == (0 if "optimize_cameras" in options else 6 * 8 - 7)
