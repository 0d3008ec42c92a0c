"""Joint posterior of a survey, in dense or in sparse equations: covariances of points, cameras and lens."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.sparse import csr_matrix

from pipelines.adjust.camera_covariance import camera_covariances
from pipelines.adjust.posterior import FreeLens, posterior
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_adjustment import state_of
from pipelines.adjust.sparse_posterior import SparsePosterior
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import Similarity


class SurveyPosterior(Protocol):
    """Covariances of what follows from similarity, cameras and lens."""

    def at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of points (J, 3).

        Args:
            point_in_geo: (J, 3) metres.
            by_poses: (3 J, 6 n) derivative of the points in geo by the corrections (δω, δc) of the cameras.
            by_lens: (J, 3, L) derivative of the points in geo by the lens.
        """

    def jointly_at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points, with the arguments of `at`.

        The second-order error of the similarity is included.
        """

    def of_cameras(self, center_in_geo: FloatArray, geo_from_model: Similarity) -> FloatArray:
        """Return the covariance (n, 6, 6) of (δθ [rad], δc [m]) of all cameras, as `camera_covariances`."""

    def of_lens(self) -> FloatArray:
        """Return the covariance (L, L) of the lens parameters, in the order of `geometry.lens.Lenses`."""


def survey_posterior(problem: GeoProblem, lens: FreeLens | None) -> SurveyPosterior:
    """Return the posterior of a problem at its minimum, in the equations that it was solved with.

    Args:
        problem: at its minimum.
        lens: the part of the lens that does not follow the cameras; None: the lens was held.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    if problem.bundle is None:
        return _DensePosterior(problem, lens)
    return SparsePosterior(problem, problem.bundle, state_of(problem), None if lens is None else lens.by_control)


class _DensePosterior:
    """`adjust.posterior.Posterior` in terms of the cameras' corrections instead of those of their basis."""

    def __init__(self, problem: GeoProblem, lens: FreeLens | None) -> None:
        cameras = problem.cameras
        self._basis, self._lens_basis = cameras.basis.cpu().numpy(), cameras.lens_basis.cpu().numpy()
        self._joint = posterior(problem, lens)

    def at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        return self._joint.at(point_in_geo, *self._derivatives(by_poses, by_lens))

    def jointly_at(self, point_in_geo: FloatArray, by_poses: csr_matrix, by_lens: FloatArray) -> FloatArray:
        return self._joint.jointly_at(point_in_geo, *self._derivatives(by_poses, by_lens))

    def of_cameras(self, center_in_geo: FloatArray, geo_from_model: Similarity) -> FloatArray:
        return camera_covariances(self._joint, center_in_geo, geo_from_model, self._basis)

    def of_lens(self) -> FloatArray:
        rest = np.eye(len(self._lens_basis))
        jacobian = np.concatenate([np.zeros((len(rest), 7)), self._lens_basis, rest], axis=1)
        return np.asarray(jacobian @ self._joint.covariance @ jacobian.T)

    def _derivatives(self, by_poses: csr_matrix, by_lens: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of points by the coordinates of the basis, and by the rest of the lens."""
        rows, width = 6 * len(self._basis), self._basis.shape[2]
        by_cameras = np.asarray(by_poses @ self._basis.reshape(rows, width)).reshape(len(by_lens), 3, width)
        by_lens = by_lens[:, :, : len(self._lens_basis)]
        return by_cameras + by_lens @ self._lens_basis, by_lens
