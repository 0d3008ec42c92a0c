"""Robust weights: they are the derivatives of the losses that they are named after."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import chi2

from pipelines.geometry.statistics import (
    CAUCHY_SCALE2,
    MEAN_WEIGHTED_CHI2,
    NOISE_WEIGHT,
    cauchy_loss,
    cauchy_weight,
    huber_weight,
)

DIMENSIONS = (1, 2, 3)


def huber(squared: float, scale: float) -> float:
    return squared if squared <= scale**2 else 2 * scale * np.sqrt(squared) - scale**2


@given(squared=st.floats(1e-3, 1e4), scale=st.floats(0.5, 5.0))
def test_huber_weight_is_the_derivative_of_the_loss(squared: float, scale: float) -> None:
    step = 1e-5 * squared
    slope = (huber(squared + step, scale) - huber(squared - step, scale)) / (2 * step)
    assert huber_weight(squared, scale) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("dimension", DIMENSIONS)
@given(squared=st.floats(1e-3, 1e4))
def test_cauchy_weight_is_the_derivative_of_the_loss(squared: float, dimension: int) -> None:
    step = 1e-5 * squared
    slope = (cauchy_loss(squared + step, dimension) - cauchy_loss(squared - step, dimension)) / (2 * step)
    assert cauchy_weight(squared, dimension) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("weight", [huber_weight, *(partial(cauchy_weight, dimension=d) for d in DIMENSIONS)])
def test_small_residuals_count_in_full_and_large_ones_less(weight) -> None:
    squared = np.array([0.0, 1e-6, 1.0, 100.0, 1e8])
    assert weight(squared)[:2] == pytest.approx(1.0)
    assert (np.diff(weight(squared)) <= 0).all()
    assert weight(squared)[-1] < 1e-3


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_factors_are_those_of_gaussian_residuals(dimension: int) -> None:
    """Both tables against their definitions, by quadrature over χ² with as many degrees of freedom."""
    scale2, density = CAUCHY_SCALE2[dimension], chi2(dimension).pdf

    def mean(of: Callable[[float], float]) -> float:
        return quad(lambda x: of(x) * density(x), 0, 300, limit=200)[0]

    def weight(x: float) -> float:
        return 1 / (1 + x / scale2)

    slope = mean(lambda x: weight(x) - 2 / dimension * x * weight(x) ** 2 / scale2)
    noise = mean(weight) * mean(lambda x: weight(x) ** 2 * x / dimension) / slope**2
    assert noise == pytest.approx(NOISE_WEIGHT[dimension], abs=1e-4)
    assert mean(lambda x: x * weight(x)) == pytest.approx(MEAN_WEIGHTED_CHI2[dimension], abs=1e-4)
