"""The geographic losses as training gets them: they start at the adjustment, and options switch what counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.geometry.bundle import predicted_basis_bytes
from pipelines.geometry.statistics import CAUCHY_SCALE2
from pipelines.survey.adjustment import GeolocatedPoints
from pipelines.survey.scene import adjusted_scene
from pipelines.survey.survey import Survey
from pipelines.train.adjusted_scene import AdjustedScene, with_exposures
from pipelines.train.geographic.problem import GeoProblem, TermWeights, frozen_problem, refining_problem
from pipelines.train.geographic.terms import SURFACE_SIGMA, DistanceTerm, depth_residuals
from pipelines.train.options import MOST_JOINT_CAMERAS, GeographicOptions, TrainOptions
from tests.adjusted_scenes import adjusted_model, block
from tests.refusals import refused
from tests.scenes import Measured, Noise, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")
NOISE = Noise(fix_m=(0.02, 0.02, 0.03), pixel_px=0.3, mark_px=0.3)
# Of a base station on wrong coordinates: what control points show of it is far beyond the σ of its prior.
WRONG_BASE = replace(NOISE, bias_m=(0.6, -0.4, 0.5))


@dataclass(frozen=True)
class Adjusted:
    """A survey after `init-sim3`."""

    scene: AdjustedScene
    posterior: Posterior
    points: GeolocatedPoints

    def problem(self, **options: object) -> GeoProblem:
        config = TrainOptions.model_validate(options)
        measured = self.scene.measured(control_points=config.gcp_loss)
        return refining_problem(self.scene, measured, config, self.points)


@cache
def adjusted(noise: Noise = NOISE, estimate: tuple[str, ...] = ()) -> Adjusted:
    rng, of = np.random.default_rng(4), block("orbit", 8)
    survey, sparse = survey_of(of.scene, noise, Measured(gcps=True), rng), adjusted_model(of, noise, rng)
    return of_survey(survey, sparse, estimate)


def of_survey(survey: Survey, sparse: object, estimate: tuple[str, ...] = ()) -> Adjusted:
    points = geolocate(survey, sparse, GeolocateOptions()).points  # type: ignore[arg-type]
    options = InitSim3Options(accept_inconsistency=True, estimate=estimate)  # type: ignore[arg-type]
    estimated = estimate_similarity(survey, sparse, points, options)  # type: ignore[arg-type]
    weighted, solution = estimated.initial.weighted(survey), estimated.posterior.solution
    scene = adjusted_scene(sparse, weighted, solution)  # type: ignore[arg-type]
    return Adjusted(AdjustedScene(estimated.initial, weighted, scene, solution), estimated.posterior, points)


@pytest.mark.parametrize(
    ("noise", "estimate"),
    [(NOISE, ()), (WRONG_BASE, ()), (NOISE, ("lever-arm", "boresight"))],
    ids=["good", "wrong base", "more errors"],
)
def test_training_starts_at_the_minimum_of_its_own_loss(noise: Noise, estimate: tuple[str, ...]) -> None:
    given = adjusted(noise, estimate)
    problem, solution = given.problem(distance_loss=False), given.posterior.solution
    rotation, center = (each.detach().numpy() for each in problem.cameras.moved())
    np.testing.assert_allclose(rotation, solution.poses.cam_from_model, atol=1e-12)
    np.testing.assert_allclose(center, solution.poses.cam_center_in_model, atol=1e-9)
    lens = given.scene.scene.sparse.lenses.moved(problem.cameras.lens().detach().numpy())
    np.testing.assert_allclose(lens.cameras[1].params, solution.lenses[0].params, rtol=1e-10)
    np.testing.assert_array_equal(problem.similarity.current().translation, solution.similarity.translation)
    assert {"bias"} | set(estimate) == {error.name for error in solution.estimated_errors}

    def slopes() -> dict[str, float]:
        problem.zero_grad()
        problem.loss().backward()
        return {name: float(each.grad.norm()) for name, each in problem.learned().items() if each.grad is not None}

    before = slopes()
    with torch.no_grad():  # half a σ away
        for parameter in problem.learned().values():
            parameter.add_(0.5)
    # The basis holds loose cameras a little more tightly than the sparse equations do.
    assert all(before[name] < 0.01 * slope for name, slope in slopes().items())


def test_state_at_the_start_gives_the_adjustment_again() -> None:
    given = adjusted()
    measured, problem = given.scene.measured(), given.problem()
    again = given.scene.posterior(measured, problem.state())
    expected = given.posterior
    np.testing.assert_allclose(again.camera_cov, expected.camera_cov, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(
        again.solution.geo_from_model.covariance, expected.solution.geo_from_model.covariance, atol=1e-12
    )
    for one, other in zip(again.solution.estimated_errors, expected.solution.estimated_errors, strict=True):
        np.testing.assert_allclose(one.value, other.value, atol=1e-9)
    names = [(each.kind, each.name, each.used) for each in expected.solution.measurements]
    assert [(each.kind, each.name, each.used) for each in again.solution.measurements] == names


def test_measurements_that_leave_the_similarity_open_are_refused_before_the_training() -> None:
    given = adjusted().scene
    images = tuple(
        image.model_copy(update={"fix": None}) if index else image
        for index, image in enumerate(given.survey.images)
    )
    few = replace(given, survey=given.survey.model_copy(update={"images": images}))
    few.require_determined(few.measured())
    with refused("similarity-open", DegenerateGeometryError):
        few.require_determined(few.measured(control_points=False))


def test_frozen_cameras_are_those_of_the_adjustment_and_do_not_move() -> None:
    given = adjusted()
    problem, solution = frozen_problem(given.scene), given.posterior.solution
    _, center = problem.cameras.pose(3)
    np.testing.assert_allclose(center.detach(), solution.poses.cam_center_in_model[3], atol=1e-9)
    lens = given.scene.scene.sparse.lenses.moved(problem.cameras.lens().detach().numpy())
    np.testing.assert_allclose(lens.cameras[1].params, solution.lenses[0].params, rtol=1e-12)
    loss = problem.loss()
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert not any(each.grad is not None and bool(each.grad.any()) for each in problem.learned().values())


def test_exposures_come_back() -> None:
    given = adjusted().scene
    assert given.exposures(torch.device("cpu")) is None
    exposure = np.random.default_rng(0).normal(size=(8, 3, 4))
    shown = replace(given, adjustment=with_exposures(given.adjustment, exposure)).exposures(torch.device("cpu"))
    assert shown is not None
    np.testing.assert_allclose(shown.affine, exposure, rtol=1e-6)


def test_losses_are_means_of_rho_or_plain_squares() -> None:
    given, problem, plain = adjusted(), adjusted().problem(), adjusted().problem(geo_weighting="paper")
    measured = given.scene.measured()
    residual = measured.residuals(given.scene.state(measured.errors))
    for kind, name in (("fixes", "absolute"), ("control points", "control")):
        rho = CAUCHY_SCALE2[3] * np.log1p((residual[kind] ** 2).sum(axis=1) / CAUCHY_SCALE2[3])
        assert float(problem.losses()[name].detach()) == pytest.approx(rho.mean(), rel=1e-6)
    values = plain.losses()
    together = sum(float(values[name].detach()) for name in ("absolute", "control", "relative"))
    assert float(plain.loss().detach()) == pytest.approx(together)
    with torch.no_grad():
        plain.cameras.z.add_(1.0)  # plain squares hold nothing to the photographs: the lens must stay
    np.testing.assert_array_equal(plain.cameras.lens_basis, 0)
    assert problem.cameras.lens_basis.any()


@pytest.mark.parametrize(
    ("options", "gone"), [({"gcp_loss": False}, {"control"}), ({"distance_loss": False}, {"relative"}), ({}, set())]
)
def test_terms_can_be_switched_off(options: dict[str, bool], gone: set[str]) -> None:
    problem = adjusted().problem(**options)
    assert {"absolute", "control", "relative"} - {term.kind for term in problem.terms} == gone


def test_everything_moves_to_a_device_together() -> None:
    problem = adjusted(NOISE, ("lever-arm", "boresight")).problem(variance_factors="learned", gcp_mode="depth")
    assert problem.to("meta").loss().device.type == "meta"


def test_distances_say_of_the_scale_a_tenth_of_what_the_fixes_say() -> None:
    given = adjusted()
    fixes = given.scene.measured().term("fixes")
    pairs = given.problem().term(DistanceTerm)
    assert fixes is not None and pairs is not None and pairs.distance_in_model is not None
    of_pairs = pairs.share * float((pairs.distance_in_geo * pairs.root_information[:, 0, 0]).square().sum())
    place = fixes.position_in_geo  # type: ignore[attr-defined]
    of_fixes = ((fixes.root_information @ (place - place.mean(axis=0))[..., None]) ** 2).sum()
    assert 0 < of_pairs <= 0.1 * of_fixes * (1 + 1e-3)
    # The scene is in true metres: what remains is the error of the forward intersection.
    white = (pairs.distance_in_model - pairs.distance_in_geo) * pairs.root_information[:, 0, 0]
    assert float(white.square().mean()) < 1.5
    lost = replace(given, points=replace(given.points, inlier=np.zeros_like(given.points.inlier)))
    of_cameras = lost.problem().term(DistanceTerm)
    assert of_cameras is not None and of_cameras.camera is not None
    foreign = replace(given, points=replace(given.points, point_id=given.points.point_id + 1))
    with refused("points-of-another-model", InputError):
        foreign.problem()


def test_depth_mode_finds_control_points_by_the_surface() -> None:
    given, found = adjusted(), adjusted().problem(gcp_mode="depth")
    marks, poses = found.control_by_depth, given.posterior.solution.poses
    assert marks is not None
    assert marks.views == 8
    assert float(marks.share.sum()) == pytest.approx(len(given.scene.survey.control_points))
    similarity = given.posterior.solution.similarity
    for camera, rows in marks.rows.items():
        assert set(marks.camera[rows].tolist()) == {camera}
        # At the true depth of each mark lies its control point, to some pixels' worth of millimetres.
        arm = similarity.inverse().apply(marks.position_in_geo[rows].numpy()) - poses.cam_center_in_model[camera]
        depth = torch.from_numpy(arm @ poses.cam_from_model[camera][2])
        ray, surveyed = marks.rays(rows, found.cameras.lens()), marks.position_in_geo[rows]
        missed = depth_residuals(found.cameras.pose(camera), found.similarity(), surveyed, ray, depth)
        assert float(missed.detach().abs().max()) < 0.2
        sigma = 1 / np.linalg.svd(marks.root_information[rows].numpy(), compute_uv=False)
        distance = np.linalg.norm(arm, axis=1)
        np.testing.assert_allclose(sigma, SURFACE_SIGMA * distance[:, None].repeat(3, axis=1), rtol=0.1)


def learned_factor(scale: float) -> float:
    """Variance factor of the fixes that training learns, where their σ are `scale` times too small."""
    problem = adjusted().problem(variance_factors="learned", distance_loss=False)
    (fixes, *others) = problem.terms
    problem.terms = (replace(fixes, root_information=scale * fixes.root_information), *others)  # type: ignore[type-var]
    adam = torch.optim.Adam([problem.weights.u], lr=0.1)
    for _ in range(200):
        adam.zero_grad()
        problem.loss().backward()
        adam.step()
    return problem.weights.variance_factors()["absolute"]


def test_optimistic_sigma_is_noticed_and_a_right_one_left_alone() -> None:
    assert 0.2 < learned_factor(1.0) < 2.5
    assert learned_factor(4.0) > 3.0


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_bounds_hold_whatever_is_learned(weighting: str) -> None:
    weights = TermWeights({"absolute": 3, "relative": 1}, weighting, learned=True)  # type: ignore[arg-type]
    factor = 100.0 if weighting == "whitened" else 1e4
    for far in (-1e6, 1e6):
        with torch.no_grad():
            weights.u.fill_(far)
        for value in weights.variance_factors().values():
            assert value == pytest.approx(math.exp(math.copysign(math.log(factor), far)), rel=1e-9)


def test_options_that_disagree_with_a_frozen_solution_are_refused() -> None:
    options = GeographicOptions(gcp_mode="depth")
    options.require_trainable(MOST_JOINT_CAMERAS)
    with refused("cameras-solved-once", InputError) as error:
        options.require_trainable(MOST_JOINT_CAMERAS + 1)
    assert error.value.field == "--gcp-mode"
    assert "--gcp-mode triangulated, --solve-cameras joint" in str(error.value)
    with refused("cameras-solved-once", InputError) as error:
        GeographicOptions(geo_weighting="paper", solve_cameras="once").require_trainable(10)
    assert error.value.field == "--geo-weighting" and "--geo-weighting whitened" in str(error.value)


def test_cameras_are_refined_only_where_something_holds_them_to_the_earth() -> None:
    assert predicted_basis_bytes(MOST_JOINT_CAMERAS) < 2 * 2**30
    assert GeographicOptions().refined_cameras(MOST_JOINT_CAMERAS) == MOST_JOINT_CAMERAS
    for options in ({"solve_cameras": "once"}, {"geo_loss": False}, {"optimize_cameras": False}):
        assert GeographicOptions.model_validate(options).refined_cameras(10) == 0
    assert GeographicOptions().refined_cameras(MOST_JOINT_CAMERAS + 1) == 0
