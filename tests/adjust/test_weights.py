"""Learned weights: a variance factor for each term, right where σ are wrong, and within its bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.posterior import solution_covariances
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.weights import TermWeights
from tests.georef_scenes import descend, draw_truth, fixes_of, make_block, marks_of, pivot, problem_with, terms

pytestmark = pytest.mark.usefixtures("one_thread")
DIMENSIONS = {"absolute": 3, "control": 3, "relative": 1}
BLOCK = replace(make_block(images=16), basis=np.zeros((16, 6, 0)))
CONTROL = np.array([[-15.0, -15, 0], [15, -12, 1], [12, 15, 2], [-14, 13, 0.5], [0, 0, 3], [5, -9, 0]])


def learned(true_sigma_m: float, stated_m: float, outliers: int = 0) -> dict[str, float]:
    """Variance factors after training on fixes of one σ that state another, and right control points."""
    rng = np.random.default_rng(3)
    truth = replace(draw_truth(BLOCK, rng), poses=BLOCK.poses)
    fixes = fixes_of(truth, np.full(3, true_sigma_m), rng)
    position = fixes.position_in_geo.clone()
    position[:outliers] += 20.0
    root = torch.eye(3, dtype=torch.float64).repeat(16, 1, 1) / stated_m
    measured = terms(
        replace(fixes, position_in_geo=position, root_information=root), marks_of(truth, CONTROL, 0.02, rng)
    )
    problem = problem_with(BLOCK, measured, learned_weights=True)
    problem.similarity = LearnableSimilarity(truth.geo_from_model, 1e-4 * np.eye(7), pivot(BLOCK))
    descend(problem, 400, variance_rate=0.1)  # ten times the training's, which is as much longer
    return problem.weights.variance_factors()


def test_optimistic_sigma_is_noticed() -> None:
    found = learned(0.2, 0.05)
    # Variances 16 times the stated, drawn back by the prior of σ 1 of the logarithm; 48 coordinates.
    assert 5 < found["absolute"] < 25
    assert 0.3 < found["control"] < 2


def test_right_sigma_is_left_alone_also_among_outliers() -> None:
    assert 0.5 < learned(0.05, 0.05)["absolute"] < 1.7
    assert 0.7 < learned(0.05, 0.05, outliers=2)["absolute"] < 2.5


@pytest.mark.parametrize("weighting", ["whitened", "paper"])
def test_bounds_hold_whatever_is_learned(weighting: str) -> None:
    weights = TermWeights(DIMENSIONS, weighting, learned=True)  # type: ignore[arg-type]
    factor = 100.0 if weighting == "whitened" else 1e4
    for far in (-1e6, 1e6):
        with torch.no_grad():
            weights.u.fill_(far)
        for value in weights.variance_factors().values():
            assert value == pytest.approx(math.exp(math.copysign(math.log(factor), far)), rel=1e-9)


def test_fixed_weights_learn_nothing() -> None:
    weights = TermWeights(DIMENSIONS, "whitened", learned=False)
    assert weights.variance_factors() == {}
    assert len(weights.u) == 0
    assert float(weights.prior()) == 0.0


def test_variance_enters_the_covariance() -> None:
    truth = draw_truth(BLOCK, np.random.default_rng(0))
    fixes = fixes_of(truth, np.array([0.02, 0.02, 0.03]), np.random.default_rng(0))
    problem = problem_with(replace(BLOCK, poses=truth.poses), terms(fixes), learned_weights=True)
    descend(problem, 300)
    before, s = solution_covariances(problem)[0], problem.weights.log_variance("absolute")
    assert s is not None
    with torch.no_grad():
        problem.weights.u += 0.01
    after = problem.weights.log_variance("absolute")
    assert after is not None
    # Cauchy's weights rise a little as residuals shrink.
    ratio = np.trace(solution_covariances(problem)[0][4:, 4:]) / np.trace(before[4:, 4:])
    assert 1.0 < ratio <= math.exp(float((after - s).detach())) + 1e-9
