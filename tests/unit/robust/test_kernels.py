"""Robust losses: their weights are their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.robust.kernels import cauchy_rho, cauchy_weight, huber_rho, huber_weight

KERNELS = [(huber_rho, huber_weight), (cauchy_rho, cauchy_weight)]


@pytest.mark.parametrize(("rho", "weight"), KERNELS)
@given(squared=st.floats(1e-3, 1e4), scale=st.floats(0.5, 5.0))
def test_weight_is_the_derivative_of_rho(rho, weight, squared: float, scale: float) -> None:
    step = 1e-5 * squared
    slope = (rho(squared + step, scale) - rho(squared - step, scale)) / (2 * step)
    assert weight(squared, scale) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(("rho", "weight"), KERNELS)
def test_small_residuals_count_in_full_and_large_ones_less(rho, weight) -> None:
    squared = np.array([0.0, 1e-6, 1.0, 100.0, 1e8])
    assert rho(squared)[:2] == pytest.approx(squared[:2])
    assert (rho(squared) <= squared).all()
    assert (np.diff(weight(squared)) <= 0).all()
    assert weight(squared)[-1] < 1e-3
