"""Robust weights of a whitened residual, for iteratively reweighted least squares.

Each takes r² (any shape), the squared residual in units of its σ, and gives the weight ρ'(r²) in (0, 1], the
derivative of its loss ρ, which is r² for small residuals. The tuning constants give 95 % efficiency for Gaussian
errors in one dimension.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray

HUBER_95 = 1.345
CAUCHY_95 = 2.385


def huber_weight(squared: ArrayLike, scale: float = HUBER_95) -> FloatArray:
    """Huber's, whose loss is r² up to `scale` σ, then linear in r: 1, then scale / r."""
    r2 = np.asarray(squared, dtype=np.float64)
    return scale / np.sqrt(np.maximum(r2, scale**2))


def cauchy_weight(squared: ArrayLike, scale: float = CAUCHY_95) -> FloatArray:
    """Cauchy's, whose loss is c² ln(1 + r²/c²): 1 / (1 + r²/c²). Redescending: needs a start nearly right."""
    return np.asarray(1.0 / (1.0 + np.asarray(squared, dtype=np.float64) / scale**2))
