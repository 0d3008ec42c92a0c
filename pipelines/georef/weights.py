"""Weights of the terms that are learned with everything else, as a variance of each (homoscedastic uncertainty).

Kendall, Gal and Cipolla (doi 10.1109/CVPR.2018.00781, eq. 7): a term of squared residuals becomes e^{−s} χ² + d s
with its log-variance s. Here the robust kernel is applied to e^{−s} χ², so that outliers do not pass for variance,
and the factor d of s is what that kernel leaves of χ² under noise of the stated σ: s = 0 is then its rest.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipelines.georef.losses import Weighting

TERMS = ("absolute", "control", "relative", "attitude")
_DIMENSIONS = {"absolute": 3, "control": 3, "relative": 1, "attitude": 3}
# E[χ² / (1 + χ²/c²)] with the kernels' c² for one and for three degrees of freedom.
MEAN_WEIGHTED_CHI2 = {1: 0.6208, 3: 1.9279}
# A learned variance stays within this factor of the stated one, or of 1 m² where residuals are not whitened.
_BOUND = {"whitened": 100.0, "paper": 1e4}
# How far the stated variances are trusted: σ of the logarithm.
PRIOR_LOG_VARIANCE = 1.0


class TermWeights(torch.nn.Module):
    """Log-variances s = b tanh(u/b) of the terms, so that none can vanish or explode; or s = 0, if not learned."""

    def __init__(self, weighting: Weighting, learned: bool) -> None:
        super().__init__()
        self.weighting, self.learned = weighting, learned
        self.bound = math.log(_BOUND[weighting])
        self.u = torch.nn.Parameter(torch.zeros(len(TERMS) if learned else 0, dtype=torch.float64))

    def log_variance(self, term: str) -> Tensor | None:
        """s of a term; None: not learned."""
        if not self.learned:
            return None
        return self.bound * torch.tanh(self.u[TERMS.index(term)] / self.bound)

    def variance_factors(self) -> dict[str, float]:
        """e^s by term; empty if not learned."""
        found = {term: self.log_variance(term) for term in TERMS}
        return {term: math.exp(float(s.detach())) for term, s in found.items() if s is not None}

    def price(self, term: str) -> float:
        """What s costs a residual, d."""
        dimensions = _DIMENSIONS[term]
        return MEAN_WEIGHTED_CHI2[dimensions] if self.weighting == "whitened" else float(dimensions)

    def prior(self) -> Tensor:
        """What departing from the stated σ costs, a χ²; nothing where there is no stated σ. Scalar."""
        if not self.learned or self.weighting == "paper":
            return self.u.new_zeros(())
        s = self.bound * torch.tanh(self.u / self.bound)
        return (s / PRIOR_LOG_VARIANCE).square().sum()
