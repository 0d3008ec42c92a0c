"""Robust kernels of a whitened residual: losses, weights, and their means under plain noise.

The argument is r² (any shape), the squared length of a residual in units of its σ. A weight ρ'(r²) in (0, 1] is the
derivative of its loss ρ, which is r² for small residuals.

Tuning constants by dimension of the residual:

- Huber in one dimension: 95 % efficiency for Gaussian errors (Huber 1964, doi 10.1214/aoms/1177703732).
- Cauchy in two dimensions (image residuals): 95 % efficiency of one coordinate (Holland and Welsch 1977,
  doi 10.1080/03610927708827533), as in COLMAP's adjustments.
- Cauchy in one and in three dimensions (distances, positions, attitudes): the 95 % quantile of χ², COLMAP's scale
  for position priors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray

HUBER_95 = 1.345
CAUCHY_95 = 2.385
# Cauchy's c² by the dimension of the residual.
CAUCHY_SCALE2 = {1: 3.841, 2: CAUCHY_95**2, 3: 7.815}
# E[w χ²] under Gaussian noise of the stated σ, with Cauchy's weight w = 1 / (1 + χ²/c²).
MEAN_WEIGHTED_CHI2 = {1: 0.6208, 2: 1.2604, 3: 1.9279}
# Cauchy's weight also lowers plain noise. Weights divided by this factor give the covariance that the estimator has
# under Gaussian noise of the stated σ: E[w] E[w² χ²/d] / E[∂(w r)/∂r]² for χ² with d degrees of freedom.
NOISE_WEIGHT = {1: 0.9087, 2: 0.8265, 3: 0.7886}


def huber_weight(squared: ArrayLike, scale: float = HUBER_95) -> FloatArray:
    """Return Huber's weight: 1 up to `scale` σ, where the loss is r²; then scale / r, where the loss is linear."""
    r2 = np.asarray(squared, dtype=np.float64)
    return scale / np.sqrt(np.maximum(r2, scale**2))


def cauchy_weight(squared: ArrayLike, dimension: int) -> FloatArray:
    """Return Cauchy's weight 1 / (1 + r²/c²) of residuals of a dimension.

    The weight redescends: the start must be near the solution.
    """
    return np.asarray(1.0 / (1.0 + np.asarray(squared, dtype=np.float64) / CAUCHY_SCALE2[dimension]))


def cauchy_loss(squared: ArrayLike, dimension: int) -> FloatArray:
    """Return Cauchy's loss c² ln(1 + r²/c²) of residuals of a dimension."""
    scale2 = CAUCHY_SCALE2[dimension]
    return np.asarray(scale2 * np.log1p(np.asarray(squared, dtype=np.float64) / scale2))
