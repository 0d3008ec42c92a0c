"""Normal equations: their solution, posterior and robustness against plain least squares and what was simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from pipelines.adjust.normal_equations import (
    NormalEquations,
    Observations,
    posterior_weights,
    robust_cost,
    robust_weights,
)
from pipelines.core.errors import DegenerateGeometryError

COUNT = 5


def equations(rng: np.random.Generator, truth: np.ndarray, *, prior: float = 0.0) -> NormalEquations:
    """Observations of one, two and three dimensions with unit noise, at a state that is off by `truth`."""
    observations = {}
    for name, rows, dimension in (("distances", 30, 1), ("pixels", 40, 2), ("positions", 20, 3)):
        jacobian = rng.normal(size=(rows, dimension, COUNT))
        observations[name] = Observations(rng.normal(size=(rows, dimension)) - jacobian @ truth, jacobian)
    return NormalEquations(observations, np.full(COUNT, prior), np.zeros(COUNT))


def ones(normal: NormalEquations) -> dict[str, np.ndarray]:
    return {name: np.ones(len(rows.residual)) for name, rows in normal.observations.items()}


def stacked(normal: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    blocks = normal.observations.values()
    jacobian = np.concatenate([rows.jacobian.reshape(-1, COUNT) for rows in blocks])
    return jacobian, np.concatenate([rows.residual.ravel() for rows in blocks])


def test_solution_is_that_of_least_squares_whatever_the_units() -> None:
    rng = np.random.default_rng(0)
    normal = equations(rng, rng.normal(size=COUNT))
    jacobian, residual = stacked(normal)
    expected, *_ = np.linalg.lstsq(jacobian, -residual)
    scaled = replace(normal, unit=10.0 ** rng.uniform(-4, 4, COUNT))
    for each in (normal, scaled, replace(scaled, open_directions="wide")):
        np.testing.assert_allclose(each.solve(ones(each)), expected, rtol=1e-10)
        np.testing.assert_allclose(each.covariance(ones(each)), np.linalg.inv(jacobian.T @ jacobian), rtol=1e-9)


def test_prior_is_one_more_observation() -> None:
    rng = np.random.default_rng(1)
    normal = equations(rng, rng.normal(size=COUNT), prior=4.0)
    away = rng.normal(size=COUNT)
    with_offset = replace(normal, offset=away)
    as_rows = replace(
        normal,
        precision=np.zeros(COUNT),
        observations={**normal.observations, "prior": Observations(2 * away[:, None], 2 * np.eye(COUNT)[:, None])},
    )
    np.testing.assert_allclose(with_offset.solve(ones(with_offset)), as_rows.solve(ones(as_rows)), rtol=1e-10)


def test_held_parameters_stay_and_the_others_do_their_best() -> None:
    rng = np.random.default_rng(2)
    normal, start = equations(rng, rng.normal(size=COUNT), prior=0.5), rng.normal(size=COUNT)
    free = np.array([True, False, True, True, False])
    solution = normal.minimum(start, free)
    np.testing.assert_array_equal(solution.step[~free], start[~free])

    def cost(values: np.ndarray) -> float:
        step = start.copy()
        step[free] = values
        return robust_cost(normal.residuals(step)) + float(normal.precision @ (step + normal.offset) ** 2)

    best = minimize(cost, start[free], method="BFGS", options={"gtol": 1e-8})
    assert solution.cost == pytest.approx(best.fun, rel=1e-9)
    np.testing.assert_allclose(solution.step[free], best.x, atol=1e-4)
    covariance = normal.covariance(ones(normal), free)
    assert (covariance[~free] == 0).all()


def test_outliers_do_not_move_the_robust_minimum() -> None:
    rng = np.random.default_rng(3)
    truth = rng.normal(size=COUNT)
    normal = equations(rng, truth)
    spoilt = dict(normal.observations)
    for name, rows in normal.observations.items():
        residual = rows.residual.copy()
        residual[::10] += 1000.0
        spoilt[name] = replace(rows, residual=residual)
    clean, hit = (replace(normal, observations=each).minimum().step for each in (normal.observations, spoilt))
    sigma = np.sqrt(np.diag(normal.covariance(ones(normal))))
    # A tenth of the observations is lost: that is 5 % of a σ, and chance.
    assert (np.abs(hit - clean) < sigma).all()
    assert (np.abs(hit - truth) < 4 * sigma).all()


def test_posterior_is_calibrated_under_cauchys_weights() -> None:
    squared = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = rng.normal(size=COUNT)
        normal = equations(rng, truth)
        solution = normal.minimum()
        covariance = normal.covariance(posterior_weights(solution.residuals))
        error = solution.step - truth
        squared.append(error @ np.linalg.solve(covariance, error))
    # The mean of 60 χ²₅ has σ 0.41.
    assert np.mean(squared) == pytest.approx(COUNT, abs=1.2)


def test_weights_go_by_kind_not_by_order() -> None:
    rng = np.random.default_rng(4)
    normal = equations(rng, rng.normal(size=COUNT))
    turned = replace(normal, observations=dict(reversed(normal.observations.items())))
    np.testing.assert_allclose(turned.minimum().step, normal.minimum().step, rtol=1e-9)


def test_open_direction_is_refused_or_wide() -> None:
    rng = np.random.default_rng(5)
    normal = equations(rng, np.zeros(COUNT))
    blind = {
        name: replace(rows, jacobian=rows.jacobian * np.array([1.0, 1, 0, 1, 1]))
        for name, rows in normal.observations.items()
    }
    refusing = replace(normal, observations=blind, advice="look elsewhere")
    with pytest.raises(DegenerateGeometryError, match="look elsewhere"):
        refusing.solve(ones(refusing))
    wide = replace(refusing, open_directions="wide")
    sigma = np.sqrt(np.diag(wide.covariance(ones(wide))))
    assert sigma[2] > 1e4 * np.delete(sigma, 2).max()
    assert wide.condition_number(ones(wide)) == pytest.approx(1e12, rel=1e-6)


def test_nearly_open_direction_keeps_its_digits() -> None:
    """Two unknowns whose sum is known to 1e-9 and whose difference to 1: beyond Cholesky's reach."""
    rows = np.array([[[1e9, 1e9]], [[0.5, -0.5]]])
    normal = NormalEquations({"rows": Observations(np.zeros((2, 1)), rows)}, np.zeros(2), np.zeros(2))
    covariance = normal.covariance({"rows": np.ones(2)})
    np.testing.assert_allclose(covariance, [[1.0, -1.0], [-1.0, 1.0]], rtol=1e-6)


def test_gate_and_weights_agree_on_small_residuals() -> None:
    weights = robust_weights({"a": np.zeros((3, 3)), "b": np.full((2, 1), 1e3)})
    np.testing.assert_array_equal(weights["a"], 1.0)
    assert (weights["b"] < 1e-5).all()
