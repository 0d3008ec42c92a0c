"""A problem near its present state, as tests of its measurements need it, whatever equations solve it."""

from __future__ import annotations

from typing import Protocol

from pipelines.adjust.normal_equations import Residuals, Weights
from pipelines.core.types import FloatArray


class Linearisation(Protocol):
    """Residuals of a problem, and the covariances that its normal equations give with chosen weights.

    Raises:
        DegenerateGeometryError: (every method but `residuals`) the measurements leave the similarity open.
    """

    def residuals(self) -> Residuals:
        """Return the whitened residuals (M, d) by kind."""

    def spread(self, weights: Weights, kind: str) -> FloatArray:
        """Return the covariances (M, d, d) that the unknowns cause in the whitened observations of a kind."""

    def covariance_of_known(self, weights: Weights) -> FloatArray:
        """Return the covariance (7 + p, 7 + p) of the similarity's coordinates y and the constant errors v."""
