"""Weights of the geographic losses: their rise while training, and variances learned with everything else.

Kendall, Gal and Cipolla (doi 10.1109/CVPR.2018.00781, eq. 7): a term of squared residuals becomes e^{−s} χ² + d s
with its log-variance s. Here the robust kernel is applied to e^{−s} χ², so that outliers do not pass for variance,
and the factor d of s is what that kernel leaves of χ² under noise of the stated σ: s = 0 is then its rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from pipelines.georef.terms import Weighting
from pipelines.robust.kernels import MEAN_WEIGHTED_CHI2

WeightSchedule = Literal["rising", "constant"]

# A learned variance stays within this factor of the stated one, or of 1 m² where residuals are not whitened.
_BOUND = {"whitened": 100.0, "paper": 1e4}
# How far the stated variances are trusted: σ of the logarithm.
PRIOR_LOG_VARIANCE = 1.0


def rising_weight(iteration: int, w_max: float, tau: float) -> float:
    """Return w(t) = w_max (1 − exp(−t/τ)), GeoRefGS eq. 27."""
    return w_max * (1.0 - math.exp(-iteration / tau))


class TermWeights(torch.nn.Module):
    """Log-variances s = b tanh(u/b) of the terms, so that none can vanish or explode; or s = 0, if not learned.

    Args:
        dimensions: of the residuals, by the kind of the term.
        weighting: of the residuals.
        learned: whether the variances are learned.
    """

    def __init__(self, dimensions: Mapping[str, int], weighting: Weighting, learned: bool) -> None:
        super().__init__()
        self.weighting, self.learned = weighting, learned
        self.bound = math.log(_BOUND[weighting])
        self._dimensions = dict(dimensions)
        self.u = torch.nn.Parameter(torch.zeros(len(dimensions) if learned else 0, dtype=torch.float64))

    def log_variance(self, kind: str) -> Tensor | None:
        """Return s of a term; None: not learned."""
        if not self.learned:
            return None
        return self.bound * torch.tanh(self.u[list(self._dimensions).index(kind)] / self.bound)

    def variance_factors(self) -> dict[str, float]:
        """Return e^s by term; empty if not learned."""
        log_variances = {kind: self.log_variance(kind) for kind in self._dimensions}
        return {kind: math.exp(float(s.detach())) for kind, s in log_variances.items() if s is not None}

    def price(self, kind: str) -> float:
        """Return what s costs a residual, d."""
        dimension = self._dimensions[kind]
        return MEAN_WEIGHTED_CHI2[dimension] if self.weighting == "whitened" else float(dimension)

    def prior(self) -> Tensor:
        """Return the cost of departing from the stated σ, a χ²; zero where there is no stated σ. Scalar."""
        if not self.learned or self.weighting == "paper":
            return self.u.new_zeros(())
        s = self.bound * torch.tanh(self.u / self.bound)
        return (s / PRIOR_LOG_VARIANCE).square().sum()
