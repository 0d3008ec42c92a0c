"""Numba kernel of Adam over rows of the Gaussians' tensors: all tensors of a row in one visit.

A single view sees few of the Gaussians. Visiting only the rows that it sees saves the memory traffic that dominates
Adam, and leaves the moments of the other rows alone.
"""

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange


@njit(parallel=True, fastmath={"contract", "nsz"}, cache=True)
def adam_rows(
    rows: Any,
    parameters: Any,
    gradients: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    rates: Any,
    corrections: Any,
    betas: Any,
    eps: Any,
) -> None:
    """Take one step of Adam (doi 10.48550/arXiv.1412.6980, alg. 1) on some rows, in place.

    Args:
        rows: (V,) rows to update, each at most once.
        parameters: tuple of (N, Dᵢ) arrays, float32.
        gradients: tuple of (N, Dᵢ) arrays, float32.
        exp_avg: (N, D) first moments, D = Σ Dᵢ.
        exp_avg_sq: (N, D) second moments.
        steps: (N,) int32, number of updates of each row so far.
        rates: (D,) learning rates.
        corrections: (T, 2), 1 / (1 − β₁ᵗ) and 1 / √(1 − β₂ᵗ); the last row serves all later steps.
        betas: (4,) β₁, 1 − β₁, β₂, 1 − β₂.
        eps: added to the denominator, of the parameters' type.
    """
    last = corrections.shape[0] - 1
    beta1, complement1, beta2, complement2 = betas[0], betas[1], betas[2], betas[3]
    for i in prange(rows.shape[0]):
        row = rows[i]
        steps[row] += 1
        step = min(steps[row], last)
        unbias1, unbias2 = corrections[step, 0], corrections[step, 1]
        first = 0
        for group in range(len(parameters)):
            parameter, gradient = parameters[group][row], gradients[group][row]
            width = parameter.shape[0]
            average, square = exp_avg[row, first : first + width], exp_avg_sq[row, first : first + width]
            rate = rates[first : first + width]
            for k in range(width):
                g = gradient[k]
                m = beta1 * average[k] + complement1 * g
                v = beta2 * square[k] + complement2 * g * g
                average[k], square[k] = m, v
                parameter[k] -= rate[k] * (m * unbias1) / (np.sqrt(v) * unbias2 + eps)
            first += width
