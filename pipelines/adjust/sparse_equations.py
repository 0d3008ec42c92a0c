"""Sparse normal equations of similarity, constant errors and many cameras.

`adjust.posterior` takes the corrections of the cameras in a dense, whitened basis, whose memory grows with the
square of the number of cameras. This module takes the corrections x' themselves, with the sparse information of
the bundle as their prior. Both have the same minimum and the same posterior:

1. The basis is free of similarities of the whole: x = x' − M g, with the movements M of a similarity and the mean
   similarity g = F x' of the points that follow the cameras.
2. The lens follows the cameras: ℓ = K x'.
3. F and K are dense, but have few rows. g and ℓ are therefore unknowns of their own, with g = F x' and ℓ = K x' as
   constraints. With Lagrange multipliers λ, the normal equations consist of a sparse matrix of the cameras and a
   dense border of (y, v, g, ℓ, λ):

       | N   Bᵀ | | x'     |
       | B   E  | | border | ,   Schur complement of N: S = E − B N⁻¹ Bᵀ.

4. N is the bundle's information plus that of the measurements plus a weak hold. It is positive definite, because
   the hold also stiffens the similarity of the cameras, which step 1 takes out again. S is small and indefinite.

N is factorised by nested dissection (`geometry.sparse_cholesky`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import block_diag, lu_factor, lu_solve
from scipy.sparse import bsr_matrix, diags

from pipelines.adjust.normal_equations import Weights
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_observations import SparseObservations
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.bundle_information import BundleInformation
from pipelines.geometry.sparse_cholesky import SparseCholesky

_EQUILIBRATIONS = 8
_OPEN = 1e-13  # singular value of the equilibrated Schur complement over the largest
_ADVICE = "fixes and control points leave the similarity open: add control points, at least 3"


class SparseEquations:
    """Factorised normal equations of a problem.

    Args:
        problem: similarity, constant errors and terms. The corrections of its cameras are not used.
        bundle: information of the image observations on the cameras.
        observations: by the name of their kind, linearised about a state.
        weights: of the observations.

    Attributes:
        factor: of N.
        response: (6 n, b) N⁻¹ Bᵀ.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """

    def __init__(
        self,
        problem: GeoProblem,
        bundle: BundleInformation,
        observations: Mapping[str, SparseObservations],
        weights: Weights,
    ) -> None:
        self._observations, self._weights, self._bundle = observations, weights, bundle
        among, matrix = prior_of_border(problem, bundle), prior_of_poses(bundle)
        across = np.zeros((len(among), matrix.shape[0]))
        for kind, rows in observations.items():
            weight = np.repeat(weights[kind], rows.residual.shape[1])
            weighted, by_border = rows.by_poses.T @ diags(weight), _by_border(rows, bundle)
            matrix = matrix + (weighted @ rows.by_poses).tobsr((6, 6))
            across += (weighted @ by_border).T
            among += by_border.T @ (weight[:, None] * by_border)
        follow = followers(bundle)
        select = np.eye(len(among))[:, -len(follow) :]
        corner = np.block([[among, select], [select.T, np.zeros((len(follow), len(follow)))]])
        self._border = np.concatenate([across, -follow])
        self.factor = SparseCholesky(matrix.tobsr((6, 6)), problem.cameras.center.cpu().numpy())
        self.response = self.factor.solve(np.ascontiguousarray(self._border.T))
        self._schur = _EquilibratedLU(corner - self._border @ self.response)

    def solve(self, poses: FloatArray, border: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unknowns (6 n, m) and (b, m) for right sides of the same shapes."""
        inner = self.factor.solve(poses)
        outer = self._schur.solve(border - self._border @ inner)
        return inner - self.response @ outer, outer

    def border_form(self, left: FloatArray) -> FloatArray:
        """Return the products left S⁻¹ leftᵀ (…, m, m) of border vectors (…, m, b)."""
        solved = self._schur.solve(left.reshape(-1, left.shape[-1]).T).T.reshape(left.shape)
        return np.asarray(left @ np.swapaxes(solved, -1, -2))

    def by_border(self, kind: str) -> FloatArray:
        """Return the derivatives (M d, b) of observations of a kind by the border unknowns."""
        rows = _by_border(self._observations[kind], self._bundle)
        return np.pad(rows, ((0, 0), (0, len(self._border) - rows.shape[1])))

    def covariance_of_known(self, count: int) -> FloatArray:
        """Return the covariance (count, count) of the first border unknowns: similarity, then constant errors."""
        return self.border_form(np.eye(count, len(self._border)))

    def response_to(self, kind: str, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the change (6 n, c) and (b, c) of the unknowns by changes (M d, c) of whitened measurements."""
        rows = self._observations[kind]
        weighted = np.repeat(self._weights[kind], rows.residual.shape[1])[:, None] * change
        by_border = _by_border(rows, self._bundle)
        border = np.zeros((len(self._border), change.shape[1]))
        border[: by_border.shape[1]] = by_border.T @ weighted
        return self.solve(np.asarray(rows.by_poses.T @ weighted), border)


def followers(bundle: BundleInformation) -> FloatArray:
    """Return F and K (7 + L, 6 n): how the similarity of the points and the lens follow x'."""
    return np.concatenate([bundle.points_follow, bundle.lens_follows])


def prior_of_poses(bundle: BundleInformation) -> bsr_matrix:
    """Return the information (6 n, 6 n) on x', the lens held, with the hold of weak cameras."""
    hold = diags((bundle.unit * bundle.loosest_sigma_m) ** -2).tobsr((6, 6))
    return (bundle.by_poses + hold).tobsr((6, 6))


def prior_of_border(problem: GeoProblem, bundle: BundleInformation) -> FloatArray:
    """Return the information (q, q) on y, v, g and ℓ.

    That of the lens is negative: with ℓ = K x', it takes out of the poses' information what the unknown lens costs.
    """
    held = float(problem.hold_prior) * problem.similarity.held.cpu().numpy()
    precise = problem.errors.sigma.detach().cpu().numpy() ** -2.0
    return np.asarray(block_diag(np.diag(held), np.diag(precise), np.zeros((7, 7)), -bundle.lens))


def _by_border(rows: SparseObservations, bundle: BundleInformation) -> FloatArray:
    """Return the derivatives (M d, q) of observations by y, v, g and ℓ."""
    by_lens = np.zeros((len(rows.by_parameters), len(bundle.lens)))
    by_lens[:, : rows.by_lens.shape[1]] = rows.by_lens
    by_similarity = -(rows.by_poses @ bundle.similarity_modes)
    return np.concatenate([rows.by_parameters, by_similarity, by_lens], axis=1)


class _EquilibratedLU:
    """LU factors of a symmetric, indefinite matrix, its rows and columns scaled to a largest entry of 1."""

    def __init__(self, matrix: FloatArray) -> None:
        self._scale = np.ones(len(matrix))
        for _ in range(_EQUILIBRATIONS):
            largest = np.abs(matrix * self._scale[:, None] * self._scale).max(axis=1)
            self._scale /= np.sqrt(np.where(largest > 0, largest, 1.0))
        scaled = matrix * self._scale[:, None] * self._scale
        size = np.linalg.svd(scaled, compute_uv=False)
        if size[-1] <= _OPEN * size[0]:
            raise DegenerateGeometryError(_ADVICE)
        self._factors = lu_factor(scaled)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (b, m) for right sides (b, m)."""
        return np.asarray(lu_solve(self._factors, right * self._scale[:, None]) * self._scale[:, None])
