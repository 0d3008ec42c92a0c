"""Weights of the geographic losses: their rise during training, and learned variances.

Kendall, Gal and Cipolla (doi 10.1109/CVPR.2018.00781, eq. 7): a term of squared residuals becomes e^{−s} χ² + d s
with its log-variance s. In this module the robust kernel is applied to e^{−s} χ², so that outliers do not raise
the variance. The factor d is the mean of the kernel's weighted χ² under noise of the stated σ: the loss is then
stationary at s = 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from pipelines.adjust.terms import Weighting
from pipelines.robust.kernels import MEAN_WEIGHTED_CHI2

WeightSchedule = Literal["rising", "constant"]

# A learned variance stays within this factor of the stated one, or of 1 m² if residuals are not whitened.
_BOUND = {"whitened": 100.0, "paper": 1e4}
# Uncertainty of the stated variances: σ of the logarithm.
PRIOR_LOG_VARIANCE = 1.0


def rising_weight(iteration: int, w_max: float, tau: float) -> float:
    """Return w(t) = w_max (1 − exp(−t/τ)), GeoRefGS eq. 27."""
    return w_max * (1.0 - math.exp(-iteration / tau))


class TermWeights(torch.nn.Module):
    """Log-variances s = b tanh(u/b) of the terms, bounded by b so that no term vanishes or explodes; else s = 0.

    Args:
        dimensions: of the residuals, by the kind of the term.
        weighting: of the residuals.
        learned: learn the variances; otherwise s = 0.
    """

    def __init__(self, dimensions: Mapping[str, int], weighting: Weighting, learned: bool) -> None:
        super().__init__()
        self.weighting, self.learned = weighting, learned
        self.bound = math.log(_BOUND[weighting])
        self._dimensions = dict(dimensions)
        self.u = torch.nn.Parameter(torch.zeros(len(dimensions) if learned else 0, dtype=torch.float64))

    def log_variance(self, kind: str) -> Tensor | None:
        """Return s of a term; None if the variances are not learned."""
        if not self.learned:
            return None
        return self.bound * torch.tanh(self.u[list(self._dimensions).index(kind)] / self.bound)

    def variance_factors(self) -> dict[str, float]:
        """Return e^s by term; empty if the variances are not learned."""
        log_variances = {kind: self.log_variance(kind) for kind in self._dimensions}
        return {kind: math.exp(float(s.detach())) for kind, s in log_variances.items() if s is not None}

    def price(self, kind: str) -> float:
        """Return d, the factor of s in the loss of one residual of a term."""
        dimension = self._dimensions[kind]
        return MEAN_WEIGHTED_CHI2[dimension] if self.weighting == "whitened" else float(dimension)

    def prior(self) -> Tensor:
        """Return the prior of the variances, a χ² of s; zero if none is stated or none learned. Scalar."""
        if not self.learned or self.weighting == "paper":
            return self.u.new_zeros(())
        s = self.bound * torch.tanh(self.u / self.bound)
        return (s / PRIOR_LOG_VARIANCE).square().sum()
