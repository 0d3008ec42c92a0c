"""The joint posterior: against the marginal that training states, autograd, and solutions without a point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.leave_one_out import leave_one_out
from pipelines.adjust.posterior import equations_of, minimise, posterior, solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import ControlTerm
from pipelines.core.errors import DegenerateGeometryError
from pipelines.robust.kernels import CAUCHY_SCALE2, NOISE_WEIGHT
from tests.georef_scenes import (
    Block,
    Truth,
    draw_truth,
    fixes_of,
    make_block,
    marks_of,
    pivot,
    problem_of,
    problem_with,
    terms,
)

pytestmark = pytest.mark.usefixtures("one_thread")
BLOCK = make_block()
RTK, CONSUMER = np.array([0.02, 0.02, 0.03]), np.array([1.5, 1.5, 3.0])
CONTROL = np.array([[-15.0, -15, 0], [15, -12, 1], [12, 15, 2], [-14, 13, 0.5], [0, 0, 3], [3, -16, 1]])


def solved(
    seed: int, sigma_m: np.ndarray | None, control: np.ndarray | None, block: Block = BLOCK
) -> tuple[Truth, GeoProblem]:
    rng = np.random.default_rng(seed)
    truth = draw_truth(block, rng)
    fixes = None if sigma_m is None else fixes_of(truth, sigma_m, rng)
    problem = problem_of(block, fixes, None if control is None else marks_of(truth, control, 0.02, rng))
    minimise(problem)
    return truth, problem


def without(marks: ControlTerm, left_out: int) -> ControlTerm:
    """The marks of all points but one."""
    keep = marks.point != left_out
    others = torch.arange(len(marks.position_in_geo)) != left_out
    point = marks.point[keep]
    return replace(
        marks,
        point=point - (point > left_out).long(),
        camera=marks.camera[keep],
        bearing_in_cam=marks.bearing_in_cam[keep],
        sigma_rad=marks.sigma_rad[keep],
        position_in_geo=marks.position_in_geo[others],
        root_information=marks.root_information[others],
    )


def by_differences(problem: GeoProblem) -> np.ndarray:
    """Covariance of (y, z) from a normal matrix by central differences: slow, and with nothing left out."""
    y, z = problem.similarity.y, problem.cameras.z
    columns = []
    for parameter in (y, z):
        for direction in torch.eye(len(parameter), dtype=torch.float64):
            rows = []
            for sign in (1, -1):
                with torch.no_grad():
                    parameter.add_(sign * 1e-4 * direction)
                    white = problem.whitened(problem.estimate())
                    parameter.sub_(sign * 1e-4 * direction)
                rows.append(torch.cat(list(white.values())))
            columns.append((rows[0] - rows[1]) / 2e-4)
    jacobian = torch.stack(columns, dim=2).numpy()
    chi2 = torch.cat(list(problem.whitened(problem.estimate()).values())).square().sum(dim=1).detach().numpy()
    weight = 1 / (1 + chi2 / CAUCHY_SCALE2[3]) / NOISE_WEIGHT[3]
    prior = np.diag([0.0] * 7 + [1.0] * len(z))
    return np.linalg.inv(np.einsum("m,mip,miq->pq", weight, jacobian, jacobian) + prior)


@pytest.mark.parametrize("control", [CONTROL, np.tile(CONTROL, (8, 1))], ids=["seen", "all"])
@pytest.mark.parametrize("sigma_m", [RTK, CONSUMER], ids=["rtk", "consumer"])
def test_posterior_is_that_of_the_whole_normal_matrix(sigma_m: np.ndarray, control: np.ndarray) -> None:
    """With fewer residuals than camera corrections, those that no measurement sees are left out of the solution."""
    _, problem = solved(0, sigma_m, control)
    assert (equations_of(problem).seen is None) is (len(control) > 6)
    joint, unit = posterior(problem), np.eye(7 + len(problem.cameras.z))
    unit[:7, :7] = problem.similarity.root.numpy()
    expected = unit @ by_differences(problem) @ unit.T
    scale = np.sqrt(np.diag(expected))
    # Differences of 1e-4 σ are good to eight digits of a correlation.
    np.testing.assert_allclose(
        joint.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )
    np.testing.assert_allclose(solution_covariances(problem)[0], joint.covariance[:7, :7], rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(joint.covariance)[0] > 0
    # The image observations alone know the corrections to one σ: measurements on Earth only add to that.
    assert np.diag(joint.covariance)[7:].max() <= 1 + 1e-9
    np.testing.assert_array_equal(joint.pivot, pivot(BLOCK))


def test_measurements_on_earth_that_leave_the_similarity_open_are_refused() -> None:
    problem = problem_of(BLOCK, None)
    with pytest.raises(DegenerateGeometryError, match="control points"):
        posterior(problem)
    problem.hold_prior = True
    np.testing.assert_allclose(posterior(problem).covariance[:7, :7], problem.similarity.prior_covariance())


@pytest.mark.parametrize(
    ("sigma_m", "count"),
    [(RTK, 6), (CONSUMER, 6), (CONSUMER, 3), (None, 5)],
    ids=["rtk", "consumer", "few", "none"],
)
def test_leaving_out_is_what_solving_again_would_give(sigma_m: np.ndarray | None, count: int) -> None:
    _, problem = solved(1, sigma_m, CONTROL[:count])
    found = leave_one_out(problem)
    assert problem.control is not None
    for j in range(count):
        again = problem_of(BLOCK, problem.fixes, without(problem.control, j))
        minimise(again)
        with torch.no_grad():
            measured = again.similarity(problem.control.intersected(again.estimate()))[j]
        error = (measured - problem.control.position_in_geo[j]).numpy()
        # The weights of the others change a little when it is gone: a fifth of what is expected of the error.
        sigma = np.sqrt(np.diag(found.cov_in_geo[j]))
        np.testing.assert_allclose(found.error_in_geo[j], error, atol=0.2 * sigma.max())


def test_a_blundered_control_point_shows_when_it_is_left_out() -> None:
    rng = np.random.default_rng(2)
    truth = draw_truth(BLOCK, rng)
    marks = marks_of(truth, CONTROL, 0.02, rng)
    spoilt = marks.position_in_geo.clone()
    spoilt[2, 0] += 0.5
    problem = problem_of(BLOCK, fixes_of(truth, CONSUMER, rng), replace(marks, position_in_geo=spoilt))
    minimise(problem)
    found = leave_one_out(problem)
    assert found.error_in_geo[2, 0] == pytest.approx(-0.5, abs=0.1)
    assert np.abs(np.delete(found.error_in_geo, 2, axis=0)).max() < 0.15


def test_expected_error_of_what_is_left_out_is_calibrated() -> None:
    squared = []
    for seed in range(20):
        _, problem = solved(seed, CONSUMER, CONTROL)
        found = leave_one_out(problem)
        squared.append((found.error_in_geo**2 / np.diagonal(found.cov_in_geo, axis1=1, axis2=2)).mean(axis=0))
    # 20 runs of 6 points that share a solution: about 60 independent values an axis, σ of the mean 0.18.
    np.testing.assert_allclose(np.mean(squared, axis=0), 1.0, atol=0.4)


def test_three_points_alone_cannot_spare_one() -> None:
    block = replace(BLOCK, basis=np.zeros((12, 6, 0)))
    rng = np.random.default_rng(0)
    truth = replace(draw_truth(block, rng), poses=block.poses)
    problem = problem_of(block, None, marks_of(truth, CONTROL[:3], 0.02, rng))
    minimise(problem)
    found = leave_one_out(problem)
    assert np.isnan(found.error_in_geo).all()
    assert np.isnan(found.cov_in_geo).all()


def test_cameras_that_are_held_leave_the_similarity() -> None:
    block = replace(BLOCK, basis=np.zeros((12, 6, 0)))
    _, problem = solved(0, RTK, CONTROL, block)
    joint = posterior(problem)
    assert joint.covariance.shape == (7, 7)
    np.testing.assert_allclose(joint.covariance, solution_covariances(problem)[0], rtol=1e-6, atol=1e-12)
    found = joint.at(np.zeros((2, 3)), np.zeros((2, 3, 0)), np.zeros((2, 3, 0)))
    assert found.shape == (2, 3, 3)


def test_without_control_points_there_is_nothing_to_leave_out() -> None:
    _, problem = solved(0, RTK, None)
    assert leave_one_out(problem).error_in_geo.shape == (0, 3)


def test_a_bias_that_is_estimated_is_marginalised_out() -> None:
    rng = np.random.default_rng(4)
    truth = draw_truth(BLOCK, rng)
    fixes = fixes_of(truth, RTK, rng)
    shifted = replace(fixes, position_in_geo=fixes.position_in_geo + torch.tensor([2.0, -1.0, 3.0]))
    measured = terms(shifted, marks_of(truth, CONTROL, 0.02, rng))
    problem = problem_with(BLOCK, measured, SystematicErrors(1))
    minimise(problem)
    np.testing.assert_allclose(problem.errors.vector().detach(), [2.0, -1.0, 3.0], atol=0.05)
    # The position then is the control points' alone: worse than with fixes that are believed.
    believed = problem_of(BLOCK, fixes, problem.control)
    minimise(believed)
    assert (np.diag(posterior(problem).covariance)[4:7] > np.diag(posterior(believed).covariance)[4:7]).all()
    assert posterior(problem).covariance.shape == posterior(believed).covariance.shape
