"""Linearisation of a problem with many cameras, in sparse normal equations."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.normal_equations import Residuals, Weights
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_adjustment import state_of
from pipelines.adjust.sparse_equations import SparseEquations
from pipelines.adjust.sparse_observations import SparseObservations, colours_of_cameras, observed
from pipelines.core.types import FloatArray
from pipelines.geometry.bundle_information import BundleInformation

_CHUNK = 32  # observations whose covariances are computed together


class SparseLinearisation:
    """Residuals and covariances of a problem about its present state (`adjust.linearisation.Linearisation`).

    Args:
        problem: the measurements.
        bundle: information of the image observations on the cameras.
    """

    def __init__(self, problem: GeoProblem, bundle: BundleInformation) -> None:
        self._problem, self._bundle = problem, bundle
        self._rows = observed(problem, state_of(problem), colours_of_cameras(problem))
        self._last: tuple[Weights, SparseEquations] | None = None

    def residuals(self) -> Residuals:
        """Return the whitened residuals (M, d) by kind."""
        return {kind: rows.residual for kind, rows in self._rows.items()}

    def covariance_of_known(self, weights: Weights) -> FloatArray:
        """Return the covariance (7 + p, 7 + p) of the similarity's coordinates y and the constant errors v."""
        known = 7 + len(self._problem.errors)
        return self._equations(weights).covariance_of_known(known)

    def spread(self, weights: Weights, kind: str) -> FloatArray:
        """Return the covariances (M, d, d) that the unknowns cause in the whitened observations of a kind."""
        equations, rows = self._equations(weights), self._rows[kind]
        count, dimension = rows.residual.shape
        across = equations.by_border(kind) - rows.by_poses @ equations.response
        of_border = equations.border_form(across.reshape(count, dimension, -1))
        return of_border + self._within(equations, rows)

    def _within(self, equations: SparseEquations, rows: SparseObservations) -> FloatArray:
        """Return the part (M, d, d) of the covariances under a known border."""
        count, dimension = rows.residual.shape
        spread = np.empty((count, dimension, dimension))
        blocks = rows.by_poses.tobsr((dimension, 6))
        if (np.diff(blocks.indptr) == 1).all():  # each observation belongs to one camera
            of_camera = equations.factor.inverse_diagonal()[blocks.indices]
            return np.asarray(blocks.data @ of_camera @ np.swapaxes(blocks.data, 1, 2))
        for first in range(0, count, _CHUNK):
            part = rows.by_poses[dimension * first : dimension * (first + _CHUNK)]
            joint = equations.factor.inverse_form(part.T.tocsc())
            among = np.arange(len(joint) // dimension)
            spread[first : first + _CHUNK] = joint.reshape(len(among), dimension, -1, dimension)[among, :, among]
        return spread

    def _equations(self, weights: Weights) -> SparseEquations:
        if self._last is None or any(not np.array_equal(self._last[0][kind], weights[kind]) for kind in weights):
            self._last = (weights, SparseEquations(self._problem, self._bundle, self._rows, weights))
        return self._last[1]
