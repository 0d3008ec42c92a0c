"""RANSAC on a line with outliers, and its limits."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.statistics import RansacOptions, draws_needed, ransac
from tests.refusals import numbers, refused

OPTIONS = RansacOptions(sample_size=2, gate=9.0)


def test_line_is_found_among_forty_percent_outliers() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-10, 10, 100)
    y = 2 * x + 1 + rng.normal(0, 0.1, 100)
    y[:40] = rng.uniform(-30, 30, 40)
    result = ransac(
        100,
        lambda chosen: np.polyfit(x[chosen], y[chosen], 1),
        lambda line: ((y - np.polyval(line, x)) / 0.1) ** 2,
        OPTIONS,
        rng,
    )
    # A line through two points 0.1 off, 10 apart, is good to a few hundredths in slope.
    assert result.model == pytest.approx([2.0, 1.0], abs=0.3)
    assert result.inlier[40:].mean() > 0.7
    assert result.inlier[:40].mean() < 0.1


def test_same_seed_gives_the_same_answer() -> None:
    values = np.random.default_rng(1).normal(size=50)
    answers = [
        ransac(
            50,
            lambda chosen: float(values[chosen].mean()),
            lambda mean: (values - mean) ** 2,
            OPTIONS,
            np.random.default_rng(4),
        ).model
        for _ in range(2)
    ]
    assert answers[0] == answers[1]


def test_too_few_observations_and_samples_that_never_fit_are_refused() -> None:
    def refuse(_: np.ndarray) -> float:
        raise DegenerateGeometryError("points-collinear", "All points lie on one line.")

    def residuals(_: float) -> np.ndarray:
        return np.zeros(5)

    rng = np.random.default_rng(0)
    with refused("too-few-observations", DegenerateGeometryError) as error:
        ransac(1, refuse, residuals, OPTIONS, rng)
    assert numbers(str(error.value)) == [2.0, 1.0]
    with refused("no-model-found", DegenerateGeometryError) as error:
        ransac(5, refuse, residuals, OPTIONS, rng)
    assert numbers(str(error.value)) == [500.0]


def test_number_of_draws_follows_the_inlier_share() -> None:
    # ln(1 − 0.9999) / ln(1 − 0.5²) = 32.0
    assert draws_needed(0.5, OPTIONS) == pytest.approx(32.0, abs=0.1)
    assert draws_needed(1.0, OPTIONS) == 1.0
    assert draws_needed(0.0, OPTIONS) == np.inf
