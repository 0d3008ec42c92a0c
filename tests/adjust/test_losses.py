"""Geographic losses: their values by hand, their gradients by differences, their robustness."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import DistanceTerm, Weighting, cauchy
from pipelines.adjust.weights import rising_weight
from pipelines.robust.kernels import CAUCHY_SCALE2
from tests.georef_scenes import (
    attitudes_of,
    draw_truth,
    fixes_of,
    make_block,
    marks_of,
    pairs_of,
    problem_of,
    problem_with,
    terms,
)

BLOCK = make_block(images=4)
SIGMA_M = np.array([0.5, 0.4, 0.8])
CONTROL = np.array([[5.0, -4.0, 1.0], [-8.0, 6.0, 0.0], [2.0, 9.0, 3.0]])


@pytest.fixture
def problem() -> GeoProblem:
    rng = np.random.default_rng(5)
    truth = draw_truth(BLOCK, rng)
    return problem_of(BLOCK, fixes_of(truth, SIGMA_M, rng), marks_of(truth, CONTROL, 0.05, rng))


def test_weight_rises_as_equation_27() -> None:
    assert rising_weight(0, 0.05, 100.0) == 0.0
    assert rising_weight(100, 0.05, 100.0) == pytest.approx(0.05 * (1 - math.exp(-1)))
    assert rising_weight(100_000, 0.05, 100.0) == pytest.approx(0.05)
    values = [rising_weight(t, 0.05, 100.0) for t in range(300)]
    assert all(a < b for a, b in pairwise(values))


def test_cauchy_is_chi2_when_small_and_flat_when_large() -> None:
    chi2 = torch.tensor([1e-4, 1e6], dtype=torch.float64, requires_grad=True)
    value = cauchy(chi2, 3)
    assert float(value[0].detach()) == pytest.approx(1e-4, rel=1e-4)
    value.sum().backward()
    assert chi2.grad is not None
    assert float(chi2.grad[1]) == pytest.approx(CAUCHY_SCALE2[3] / 1e6, rel=1e-4)


def test_absolute_loss_is_the_mean_of_rho(problem: GeoProblem) -> None:
    fixes = problem.fixes
    assert fixes is not None
    center = problem.similarity.current().apply(problem.cameras.current().cam_center_in_model)
    residual = center - fixes.position_in_geo.numpy()
    chi2 = ((residual / SIGMA_M) ** 2).sum(axis=1)
    found = problem.losses()["absolute"]
    assert found is not None
    assert found.item() == pytest.approx(np.mean(CAUCHY_SCALE2[3] * np.log1p(chi2 / CAUCHY_SCALE2[3])))
    problem.weighting = "paper"
    plain = problem.losses()["absolute"]
    assert plain is not None
    assert plain.item() == pytest.approx((residual**2).sum(axis=1).mean())


def test_full_covariance_whitens(problem: GeoProblem) -> None:
    fixes = problem.fixes
    assert fixes is not None
    half = np.random.default_rng(1).normal(size=(3, 3))
    covariance = half @ half.T + 0.1 * np.eye(3)
    root = torch.from_numpy(np.linalg.inv(np.linalg.cholesky(covariance))).repeat(4, 1, 1)
    center = problem.similarity.current().apply(problem.cameras.current().cam_center_in_model)
    residual = center - fixes.position_in_geo.numpy()
    chi2 = np.einsum("ni,ij,nj->n", residual, np.linalg.inv(covariance), residual)
    problem = problem_of(BLOCK, replace(fixes, root_information=root))
    found = problem.losses()["absolute"]
    assert found is not None
    assert found.item() == pytest.approx(np.mean(CAUCHY_SCALE2[3] * np.log1p(chi2 / CAUCHY_SCALE2[3])))


def test_marks_meet_in_the_point_they_were_made_of() -> None:
    truth = draw_truth(BLOCK, np.random.default_rng(0))
    marks = marks_of(truth, CONTROL, 0.05, np.random.default_rng(0))
    problem = problem_of(replace(BLOCK, poses=truth.poses), None, marks)
    np.testing.assert_allclose(marks.intersected(problem.estimate()).detach(), CONTROL, atol=1e-10)


def test_intersection_weighs_rays_by_angle_and_distance() -> None:
    # Two pairs of parallel-plane rays that disagree: the point lies nearer to the better pair.
    truth = draw_truth(BLOCK, np.random.default_rng(0))
    marks = marks_of(truth, CONTROL[:1], 0.05, np.random.default_rng(0))
    turned = marks.bearing_in_cam.clone()
    turned[0] += torch.tensor([1e-3, 0.0, 0.0], dtype=torch.float64)
    turned[0] /= turned[0].norm()
    shift = []
    for sigma in (1e-3, 1e-5):
        sigmas = torch.full((4,), 1e-4, dtype=torch.float64)
        sigmas[0] = sigma
        spoilt = replace(marks, bearing_in_cam=turned, sigma_rad=sigmas)
        problem = problem_of(replace(BLOCK, poses=truth.poses), None, spoilt)
        found = spoilt.intersected(problem.estimate()).detach().numpy()
        shift.append(np.linalg.norm(found - CONTROL[:1]))
    # 1e-3 rad over 55 m are 5.5 cm across the ray, which a good ray imposes and a bad one does not.
    assert shift[0] < 0.002
    assert shift[1] > 0.03


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
@pytest.mark.parametrize("learned", [False, True])
def test_gradients_are_exact(weighting: Weighting, learned: bool) -> None:
    rng = np.random.default_rng(5)
    truth = draw_truth(BLOCK, rng)
    fixes = replace(fixes_of(truth, SIGMA_M, rng), flight=torch.tensor([0, 1, 1, 0]))
    measured = terms(
        fixes,
        marks_of(truth, CONTROL, 0.05, rng),
        attitudes_of(truth, 0.01, rng),
        pairs_of(truth, CONTROL, 0.1, rng),
    )
    errors = SystematicErrors(2, arm=True, attitude_sigma_rad=0.01)
    problem = problem_with(BLOCK, measured, errors, weighting=weighting, learned_weights=learned)
    names = ("similarity.y", "cameras.z", "errors.x", "weights.u")
    start = problem.state_dict()
    values = tuple((start[name] + 0.1 * torch.from_numpy(rng.normal(size=start[name].shape))) for name in names)

    def losses(*values: torch.Tensor) -> torch.Tensor:
        told = {f"problem.{name}": value for name, value in zip(names, values, strict=True)}
        return torch.func.functional_call(_Losses(problem), told, ())

    assert torch.autograd.gradcheck(
        losses, tuple(each.requires_grad_() for each in values), eps=1e-6, atol=1e-5, rtol=1e-4
    )


def test_pairs_of_cameras_move_with_them() -> None:
    # The distance between two cameras is that of where they are now.
    truth = draw_truth(BLOCK, np.random.default_rng(0))
    center = truth.geo_from_model.apply(truth.poses.cam_center_in_model)
    camera = torch.tensor([[0, 1], [1, 3]])
    distance = torch.from_numpy(np.linalg.norm(center[[0, 1]] - center[[1, 3]], axis=1))
    pairs = DistanceTerm(None, camera, distance, torch.ones(2, dtype=torch.float64), 1.0)
    problem = problem_with(replace(BLOCK, poses=truth.poses), terms(pairs))
    problem.similarity = LearnableSimilarity(truth.geo_from_model, np.eye(7), np.zeros(3))
    np.testing.assert_allclose(pairs.residuals(problem.estimate()).detach(), 0.0, atol=1e-12)
    with torch.no_grad():
        problem.cameras.z += 1.0
    assert float(pairs.residuals(problem.estimate()).detach().abs().max()) > 1e-3


class _Losses(torch.nn.Module):
    """Every term, and the sum."""

    def __init__(self, problem: GeoProblem) -> None:
        super().__init__()
        self.problem = problem

    def forward(self) -> torch.Tensor:
        problem = self.problem
        assert problem.control is not None
        point = problem.control.intersected(problem.estimate())[0]
        return torch.stack([*problem.losses().values(), problem.loss(), *point])
