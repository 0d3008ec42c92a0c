"""Derivatives of rotations against differences."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.rotations import exp_so3, log_so3, right_jacobian_inverse_so3


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 0.3, 2.0, 3.0])
def test_right_jacobian_is_the_derivative_of_the_logarithm(angle: float) -> None:
    axis = np.array([0.48, -0.6, 0.64])
    step, base = 1e-6, exp_so3(angle * axis)
    numeric = np.stack(
        [(log_so3(base @ exp_so3(d)) - log_so3(base @ exp_so3(-d))) / (2 * step) for d in step * np.eye(3)], axis=1
    )
    # Central differences of 1e-6 are good to 1e-10 of the curvature, which grows towards π.
    np.testing.assert_allclose(right_jacobian_inverse_so3(angle * axis), numeric, atol=1e-7)


def test_right_jacobian_is_batched_and_even_where_the_series_takes_over() -> None:
    vectors = np.array([[9.9e-5, 0, 0], [1.01e-4, 0, 0], [0, 0, 0]])
    first, second, zero = right_jacobian_inverse_so3(vectors)
    np.testing.assert_allclose(first, second, atol=2e-6)
    np.testing.assert_array_equal(zero, np.eye(3))
