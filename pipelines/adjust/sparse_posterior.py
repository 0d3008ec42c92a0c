"""Covariances of many cameras, of the similarity, and of points, by selected parts of a sparse posterior.

The joint covariance of `adjust.posterior.Posterior` is dense. Here each covariance is computed where it is asked
for, from the factor of the normal equations. With derivatives q of a wanted quantity by the cameras' x' and c by
the border unknowns (`adjust.sparse_equations`), the covariance is

    q N⁻¹ qᵀ + (c − q N⁻¹ Bᵀ) S⁻¹ (c − q N⁻¹ Bᵀ)ᵀ.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from pipelines.adjust.normal_equations import posterior_weights
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_equations import SparseEquations
from pipelines.adjust.sparse_observations import State, colours_of_cameras, observed
from pipelines.core.types import FloatArray
from pipelines.geometry.bundle_information import BundleInformation
from pipelines.geometry.similarity import Similarity, jacobian_at, second_moment_at

_CHUNK = 32  # points whose covariances are computed together


class SparsePosterior:
    """Covariances of all unknowns of a problem at its minimum.

    Args:
        problem: the measurements.
        bundle: information of the image observations on the cameras.
        state: the minimum, of `minimise_sparse`.
        control_by_lens: (J, 3, L) derivative of the intersected control points in geo by the lens, metres,
            as in `adjust.posterior.FreeLens`; None: there are no control points, or the lens is exact.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """

    def __init__(
        self,
        problem: GeoProblem,
        bundle: BundleInformation,
        state: State,
        control_by_lens: FloatArray | None = None,
    ) -> None:
        rows = observed(problem, state, colours_of_cameras(problem))
        weights = posterior_weights({kind: block.residual for kind, block in rows.items()})
        self._equations = SparseEquations(problem, bundle, rows, weights)
        self._bundle, self._errors = bundle, len(problem.errors)
        self._root = problem.similarity.root.cpu().numpy()
        self._pivot = problem.similarity.pivot_in_geo
        self._pull: tuple[FloatArray, FloatArray] | None = None
        if control_by_lens is not None and problem.control is not None:
            moved = problem.control.root_information.cpu().numpy() @ control_by_lens
            self._pull = self._equations.response_to(problem.control.kind, moved.reshape(-1, moved.shape[2]))

    def of_similarity(self) -> FloatArray:
        """Return the covariance (7, 7) of (δ ln s, δω, δt) about the pivot, as in `SimilarityRecord`."""
        by_border = np.zeros((7, self._equations.response.shape[1]))
        by_border[:, :7] = self._root
        covariance = self._equations.border_form(by_border)
        if self._pull is not None:
            pulled = by_border @ self._pull[1]
            covariance = covariance + pulled @ self._bundle.lens_cov @ pulled.T
        return covariance

    def at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of points (J, 3).

        Args:
            point_in_geo: (J, 3) metres.
            by_poses: (3 J, 6 n) derivative of the points in geo by the corrections (δω, δc) of the cameras.
            by_lens: (J, 3, L) derivative of the points in geo by the lens.
        """
        covariance = np.empty((len(point_in_geo), 3, 3))
        for first in range(0, len(point_in_geo), _CHUNK):
            rows = slice(first, first + _CHUNK)
            joint = self._to_first_order(
                point_in_geo[rows], by_poses[3 * first : 3 * first + 3 * _CHUNK], by_lens[rows]
            )
            among = np.arange(len(joint) // 3)
            covariance[rows] = joint.reshape(len(among), 3, -1, 3)[among, :, among]
        return covariance

    def jointly_at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points; the arguments are those of `at`.

        The second-order error of the similarity is included, as in `adjust.posterior.Posterior`.
        """
        of_similarity = second_moment_at(point_in_geo, self.of_similarity(), self._pivot)
        return self._to_first_order(point_in_geo, by_poses, by_lens) + of_similarity

    def of_lens(self) -> FloatArray:
        """Return the covariance (L, L) of the lens parameters, in the order of `geometry.lens.Lenses`."""
        lens = np.eye(len(self._bundle.lens))
        by_border = self._by_border(np.zeros((len(lens), 7)), np.zeros((len(lens), 7)), lens)
        rest = lens if self._pull is None else lens - by_border @ self._pull[1]
        return np.asarray(self._equations.border_form(by_border) + rest @ self._bundle.lens_cov @ rest.T)

    def _to_first_order(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        by_poses, lens = csr_matrix(by_poses), by_lens.reshape(-1, by_lens.shape[2])
        by_similarity = np.concatenate(jacobian_at(point_in_geo, self._pivot))
        by_border = self._by_border(by_similarity, by_poses @ self._bundle.similarity_modes, lens)
        within = self._equations.factor.inverse_form(by_poses.T.tocsc())
        joint = within + self._equations.border_form(by_border - by_poses @ self._equations.response)
        rest = lens
        if self._pull is not None:
            rest = lens - by_poses @ self._pull[0] - by_border @ self._pull[1]
        return np.asarray(joint + rest @ self._bundle.lens_cov @ rest.T)

    def of_cameras(self, center_in_geo: FloatArray, geo_from_model: Similarity) -> FloatArray:
        """Return the covariance (n, 6, 6) of (δθ [rad], δc [m]) of all cameras, as `camera_covariances` does.

        Args:
            center_in_geo: (n, 3) metres.
            geo_from_model: the similarity s, R, t.
        """
        n, turn, scale = len(center_in_geo), geo_from_model.rotation, geo_from_model.scale
        turned = np.zeros((6, 6))
        turned[:3, :3], turned[3:, 3:] = turn, scale * turn
        by_similarity = np.zeros((n, 6, 7))
        by_similarity[:, :3, 1:4] = np.eye(3)
        by_similarity[:, 3:] = jacobian_at(center_in_geo, self._pivot)
        modes = turned @ self._bundle.similarity_modes.reshape(n, 6, 7)
        no_lens = np.zeros((6 * n, len(self._bundle.lens)))
        by_border = self._by_border(by_similarity.reshape(-1, 7), modes.reshape(-1, 7), no_lens).reshape(n, 6, -1)
        within = turned @ self._equations.factor.inverse_diagonal() @ turned.T
        across = turned @ self._equations.response.reshape(n, 6, -1)
        covariance = within + self._equations.border_form(by_border - across)
        if self._pull is not None:
            rest = turned @ self._pull[0].reshape(n, 6, -1) + by_border @ self._pull[1]
            covariance = covariance + rest @ self._bundle.lens_cov @ np.swapaxes(rest, 1, 2)
        return np.asarray(covariance)

    def _by_border(self, by_similarity: FloatArray, by_modes: FloatArray, by_lens: FloatArray) -> FloatArray:
        """Return the derivatives (m, b) by (y, v, g, ℓ, λ), from those by similarity, modes and lens."""
        rows, lenses = by_lens.shape
        parts = [by_similarity @ self._root, np.zeros((rows, self._errors)), -by_modes, by_lens]
        return np.concatenate([*parts, np.zeros((rows, 7 + lenses))], axis=1)
