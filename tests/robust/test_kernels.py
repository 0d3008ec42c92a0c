"""Robust weights: they are the derivatives of the losses that they are named after."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.robust.kernels import cauchy_weight, huber_weight


def huber(squared: float, scale: float) -> float:
    return squared if squared <= scale**2 else 2 * scale * np.sqrt(squared) - scale**2


def cauchy(squared: float, scale: float) -> float:
    return scale**2 * np.log1p(squared / scale**2)


@pytest.mark.parametrize(("rho", "weight"), [(huber, huber_weight), (cauchy, cauchy_weight)])
@given(squared=st.floats(1e-3, 1e4), scale=st.floats(0.5, 5.0))
def test_weight_is_the_derivative_of_the_loss(rho, weight, squared: float, scale: float) -> None:
    step = 1e-5 * squared
    slope = (rho(squared + step, scale) - rho(squared - step, scale)) / (2 * step)
    assert weight(squared, scale) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("weight", [huber_weight, cauchy_weight])
def test_small_residuals_count_in_full_and_large_ones_less(weight) -> None:
    squared = np.array([0.0, 1e-6, 1.0, 100.0, 1e8])
    assert weight(squared)[:2] == pytest.approx(1.0)
    assert (np.diff(weight(squared)) <= 0).all()
    assert weight(squared)[-1] < 1e-3
