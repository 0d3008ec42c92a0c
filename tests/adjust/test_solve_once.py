"""Cameras solved in sparse equations, against those solved in dense ones, through what the stages call."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from pipelines.adjust.frozen_solution import solution_of
from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.joint import adjust_jointly
from pipelines.adjust.leave_one_out import LeftOut, leave_one_out
from pipelines.adjust.posterior import linearised, minimise, solution_covariances
from pipelines.adjust.prediction import AccuracyPrediction
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.solved_survey import SolvedSurvey, solve_survey
from pipelines.adjust.variance_components import VarianceComponent, variance_components
from pipelines.core.errors import InputError
from pipelines.geometry.correction_basis import predicted_basis_bytes
from pipelines.scene.geographic_options import MOST_JOINT_CAMERAS, GeographicOptions, Solve
from pipelines.scene.marks import mark_rays
from pipelines.scene.scene import initial_scene
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import FrozenSolution, TrainedModel
from pipelines.scene.trained_survey import TrainedSurvey
from tests.adjusted_scenes import adjusted_model, block
from tests.scenes import Measured, Noise, initial, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")
IMAGES = 6
# The dense solver ends at a step of 1e-4 σ, the sparse one at a change of a residual by 1e-6 σ. Weights, and so
# covariances, differ by as much.
NEAR = 1e-3
SURVEYS = {
    "fixes alone": (Noise(pixel_px=0.3, outliers=(2,)), Measured(gcps=False)),
    "biased fixes": (Noise(pixel_px=0.3, bias_m=(0.4, -0.3, 0.5)), Measured(gcps=True)),
}


@dataclass(frozen=True)
class Solution:
    """A survey solved in one kind of equations."""

    survey: Survey
    problem: GeoProblem
    cost: float
    product: FrozenSolution
    solved: SolvedSurvey


@cache
def solution(name: str, solve: Solve) -> Solution:
    noise, measured = SURVEYS[name]
    rng, of = np.random.default_rng(4), block("orbit", IMAGES)
    survey, sparse = survey_of(of.scene, noise, measured, rng), adjusted_model(of, noise, rng)
    if measured.gcps:  # some points check, the others control
        points = survey.control_points
        survey = survey.model_copy(update={"control_points": points[:5], "check_points": points[5:]})
    options, start = GeographicOptions(rel_loss=False, solve=solve), initial()
    scene = initial_scene(sparse, survey, start)
    problem = geo_problem(scene, survey, start, options)
    cost = minimise(problem)
    product = solution_of(problem, scene, start)
    settings = {"max_image_size": 320, "background": (0.0, 0.0, 0.0), "sh_degree": 0, "iterations": 1}
    model = TrainedModel(**dict(product), **settings, gaussians=1, backend="cpu")
    trained = TrainedSurvey(survey, sparse, model, product.poses, gaussians=None)  # type: ignore[arg-type]
    return Solution(survey, problem, cost, product, solve_survey(trained, start, options))


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference of covariances (…, d, d) in units of their σ."""
    sigma = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    return float(np.abs((found - expected) / sigma[..., :, None] / sigma[..., None, :]).max())


@pytest.mark.parametrize("name", SURVEYS)
def test_solutions_agree(name: str) -> None:
    joint, once = solution(name, "joint"), solution(name, "once")
    assert joint.problem.bundle is None
    assert once.problem.bundle is not None
    assert len(once.problem.errors) == len(joint.problem.errors) == (3 if name == "biased fixes" else 0)
    assert once.cost == pytest.approx(joint.cost, abs=1e-3)
    covariance, of_errors = solution_covariances(joint.problem)
    found, found_of_errors = solution_covariances(once.problem)
    assert relative(found, covariance) < NEAR
    if len(of_errors):
        assert relative(found_of_errors, of_errors) < NEAR
        values = [each.problem.errors.vector().detach().numpy() for each in (joint, once)]
        assert np.abs((values[1] - values[0]) / np.sqrt(np.diag(of_errors))).max() < NEAR
    sigma_m = np.sqrt(np.diag(covariance)[4:]).max()
    places = [
        each.problem.similarity.current().apply(each.product.poses.cam_center_in_model) for each in (joint, once)
    ]
    assert np.abs(places[1] - places[0]).max() < NEAR * sigma_m
    assert once.product.gnss_outliers == joint.product.gnss_outliers


@pytest.mark.parametrize("name", SURVEYS)
def test_predictions_agree(name: str) -> None:
    joint, once = solution(name, "joint").solved, solution(name, "once").solved
    dense, sparse = AccuracyPrediction(joint), AccuracyPrediction(once)
    rays = mark_rays(joint.trained.survey.check_points, joint.trained.sparse)
    position = np.array([point.position_in_geo for point in joint.trained.survey.check_points]).reshape(-1, 3)
    if len(position):
        expected = dense.of_marked_points(position, rays)
        assert relative(sparse.of_marked_points(position, rays), expected) < NEAR
        expected = dense.jointly_of_marked_points(position, rays)
        assert relative(sparse.jointly_of_marked_points(position, rays), expected) < NEAR
    assert relative(sparse.of_cameras(), dense.of_cameras()) < NEAR
    of_lens, expected_of_lens = sparse.of_lens(), dense.of_lens()
    assert of_lens is not None
    assert expected_of_lens is not None
    assert relative(of_lens, expected_of_lens) < NEAR
    assert sparse.cautions == dense.cautions == ()


def test_control_points_left_out_agree() -> None:
    found, expected = (leave_one_out(solution("biased fixes", solve).problem) for solve in ("once", "joint"))
    assert isinstance(found, LeftOut)
    sigma = np.sqrt(np.diagonal(expected.cov_in_geo, axis1=1, axis2=2))
    assert np.abs((found.error_in_geo - expected.error_in_geo) / sigma).max() < NEAR
    assert relative(found.cov_in_geo, expected.cov_in_geo) < NEAR


@pytest.mark.parametrize("name", SURVEYS)
def test_tests_of_the_stated_sigma_agree(name: str) -> None:
    found, expected = (
        variance_components(linearised(solution(name, solve).problem)) for solve in ("once", "joint")
    )
    assert found.keys() == expected.keys()
    for kind, component in expected.items():
        assert_same(found[kind], component)


def assert_same(found: VarianceComponent, expected: VarianceComponent) -> None:
    np.testing.assert_array_equal(found.used, expected.used)
    assert found.squares == pytest.approx(expected.squares, rel=NEAR)
    assert found.redundancy == pytest.approx(expected.redundancy, rel=NEAR)


def test_initial_similarities_agree() -> None:
    first = solution("biased fixes", "joint")
    sparse, start = first.solved.trained.sfm, initial()
    joint, once = (adjust_jointly(first.survey, sparse, [start], solve=solve) for solve in ("joint", "once"))
    assert once.cost == pytest.approx(joint.cost, abs=1e-2)
    assert [factor.group for factor in once.factors] == [factor.group for factor in joint.factors]
    for found, expected in zip(once.factors, joint.factors, strict=True):
        assert found.applied == pytest.approx(expected.applied, rel=0.01)
    assert once.bias is not None
    assert joint.bias is not None
    np.testing.assert_allclose(once.bias.value, joint.bias.value, atol=NEAR * max(joint.bias.sigma))


def test_options_that_a_held_solution_contradicts_are_refused() -> None:
    options = GeographicOptions(gcp_mode="depth")
    options.require_trainable(MOST_JOINT_CAMERAS)
    with pytest.raises(InputError, match=r"'depth' changes .* use --gcp-mode camera, --solve joint"):
        options.require_trainable(MOST_JOINT_CAMERAS + 1)
    with pytest.raises(InputError, match="--weighting whitened"):
        GeographicOptions(weighting="paper", solve="once").require_trainable(10)


def test_dense_equations_stay_within_their_memory() -> None:
    assert predicted_basis_bytes(MOST_JOINT_CAMERAS) < 2 * 2**30
    assert GeographicOptions().refined_cameras(MOST_JOINT_CAMERAS) == MOST_JOINT_CAMERAS
    assert GeographicOptions().refined_cameras(MOST_JOINT_CAMERAS + 1) == 0
