"""Robust loss functions of a whitened residual.

Each takes r² (any shape), the squared residual in units of its σ, and gives ρ(r²), which is r² for small
residuals, or the weight ρ'(r²) in (0, 1] for iteratively reweighted least squares. The tuning constants give
95 % efficiency for Gaussian errors in one dimension.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pipelines.products import FloatArray

HUBER_95 = 1.345
CAUCHY_95 = 2.385


def huber_rho(squared: ArrayLike, scale: float = HUBER_95) -> FloatArray:
    """Huber's loss: r² up to `scale` σ, then linear in r."""
    r2 = np.asarray(squared, dtype=np.float64)
    return np.where(r2 <= scale**2, r2, 2 * scale * np.sqrt(r2) - scale**2)


def huber_weight(squared: ArrayLike, scale: float = HUBER_95) -> FloatArray:
    """Derivative of Huber's loss by r²: 1, then scale / r."""
    r2 = np.asarray(squared, dtype=np.float64)
    return scale / np.sqrt(np.maximum(r2, scale**2))


def cauchy_rho(squared: ArrayLike, scale: float = CAUCHY_95) -> FloatArray:
    """Cauchy's loss: c² ln(1 + r²/c²)."""
    return np.asarray(scale**2 * np.log1p(np.asarray(squared, dtype=np.float64) / scale**2))


def cauchy_weight(squared: ArrayLike, scale: float = CAUCHY_95) -> FloatArray:
    """Derivative of Cauchy's loss by r²: 1 / (1 + r²/c²). Redescending: needs a start that is nearly right."""
    return np.asarray(1.0 / (1.0 + np.asarray(squared, dtype=np.float64) / scale**2))
