"""Covariance of the cameras' poses on Earth, from the joint posterior of similarity and cameras."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import Similarity, jacobian_at

_CHUNK = 64  # cameras: with 1200 of them, each has 6 × 7200 derivatives


def camera_covariances(
    posterior: Posterior, center_in_geo: FloatArray, geo_from_model: Similarity, basis: FloatArray
) -> FloatArray:
    """Return the covariance (n, 6, 6) of (δθ [rad], δc [m]) of n cameras, along the axes of `geo`.

    δθ turns a camera about its centre, R_geo_from_cam' = Exp(δθ) R_geo_from_cam, and δc moves its centre. With the
    similarity's error (δ ln s, δω, δt) and the corrections (δω_i, δc_i) of the basis, to first order:
    δθ = δω + R δω_i, and δc = J_sim (δ ln s, δω, δt) + s R δc_i.

    Args:
        posterior: joint covariance.
        center_in_geo: (n, 3) metres.
        geo_from_model: the similarity s, R, t.
        basis: (n, 6, k) rows (δω_i, δc_i) of each camera's correction in `model`, by z.
    """
    turn, scale = geo_from_model.rotation, geo_from_model.scale
    covariances = np.empty((len(basis), 6, 6))
    known = 7 + basis.shape[2]  # the rest of the lens moves no camera
    for first in range(0, len(basis), _CHUNK):
        rows = slice(first, first + _CHUNK)
        jacobian = np.zeros((len(basis[rows]), 6, known))
        jacobian[:, :3, 1:4] = np.eye(3)
        jacobian[:, 3:, :7] = jacobian_at(center_in_geo[rows], posterior.pivot)
        jacobian[:, :3, 7:] = turn @ basis[rows, :3]
        jacobian[:, 3:, 7:] = scale * turn @ basis[rows, 3:]
        by_rows = jacobian.reshape(-1, known) @ posterior.covariance[:known, :known]
        covariances[rows] = by_rows.reshape(jacobian.shape) @ np.swapaxes(jacobian, 1, 2)
    return covariances
