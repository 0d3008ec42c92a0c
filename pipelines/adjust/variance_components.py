"""Variance components: does the scatter of each kind of observation agree with its stated σ?

At the minimum of a problem, each kind has a sum of whitened squares q and a redundancy r: the number of its
observations less the part that the unknowns absorb. q/r estimates the factor between true and stated variance, and
q is χ² with r degrees of freedom where the stated σ are right (Förstner 1979; Niemeier,
Ausgleichungsrechnung, 2008, section 9.4).

Outliers take no part if most observations agree with each other, at whatever σ. Where they do not agree, nothing
shows which of them are wrong, and all of them count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.system import Linearised, NormalMatrix, posterior_weights
from pipelines.core.types import BoolArray, FloatArray
from pipelines.robust.statistics import chi2_probability_above, median_chi2, outlier_gate

# Observations agree if so large a part of them is within the gate, and so many degrees of freedom check them.
CONSENSUS, LEAST_REDUNDANCY = 2 / 3, 3.0
_NO_REDUNDANCY = 0.5


@dataclass(frozen=True)
class VarianceComponent:
    """Test of the σ of M observations of one kind.

    Attributes:
        used: (M,) mask of the observations that count.
        agree: whether most agree with each other, so that the others are outliers.
        squares: q, sum of the whitened squares of those that count.
        redundancy: r, degrees of freedom of these.
    """

    used: BoolArray
    agree: bool
    squares: float
    redundancy: float

    @property
    def factor(self) -> float | None:
        """Estimate q/r of the variance factor; None without redundancy."""
        return self.squares / self.redundancy if self.redundancy > _NO_REDUNDANCY else None

    @property
    def cautious_factor(self) -> float:
        """Mean q/(r − 2) of the factor given q: larger where few degrees of freedom show little."""
        return self.squares / max(self.redundancy - 2.0, 1.0)

    def probability(self, scale: float = 1.0) -> float:
        """Return the probability that right σ, `scale` times smaller in variance, give a larger q.

        Without redundancy, the probability is 1.
        """
        if self.redundancy <= _NO_REDUNDANCY:
            return 1.0
        return chi2_probability_above(scale * self.squares, self.redundancy)


def component_of(squared: FloatArray, free: FloatArray, dimension: int) -> VarianceComponent:
    """Return the test of M observations.

    Args:
        squared: (M,) squared whitened residuals.
        free: (M,) redundancy of each observation, 0 to `dimension`.
    """
    free = np.clip(free, 1e-6, dimension)
    # The σ at which half of the observations agree; never smaller than the stated one.
    scale = max(float(np.median(squared / free)) * dimension / median_chi2(dimension), 1.0) if len(squared) else 1.0
    used = squared <= outlier_gate(dimension) * scale
    agree = len(used) > 0 and bool(used.mean() >= CONSENSUS) and float(free[used].sum()) >= LEAST_REDUNDANCY
    if not agree:
        used = np.ones(len(squared), dtype=bool)
    return VarianceComponent(used, agree, float(squared[used].sum()), float(free[used].sum()))


def variance_components(linear: Linearised) -> tuple[dict[str, VarianceComponent], NormalMatrix]:
    """Return the test of each kind of observation of a problem at its minimum, and the posterior's equations."""
    residuals = linear.residuals
    weights = posterior_weights(residuals)
    normal, components = linear.normal(weights), {}
    for kind, rows in residuals.items():
        dimension = rows.shape[1]
        absorbed = np.trace(linear.spread(weights, kind, normal), axis1=1, axis2=2) * weights[kind]
        components[kind] = component_of((rows**2).sum(axis=1), dimension - absorbed, dimension)
    return components, normal
