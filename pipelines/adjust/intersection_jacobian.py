"""Derivatives of intersected points by poses and lens of the cameras that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from pipelines.core.types import FloatArray
from pipelines.geometry.bundle import (
    Network,
    has_positive_depth,
    lens_slots,
    linearise_bundle,
    with_positive_depths,
)


@dataclass(frozen=True)
class IntersectionJacobian:
    """Effect of poses, lens and marks on N intersected points, to first order.

    Attributes:
        by_poses: (3 N, 6 n) sparse, metres by (δω, δc) of each camera as in
            `geometry.correction_basis.CorrectionBasis`.
        by_lens: (N, 3, L) metres by the lens parameters, in the order of `CorrectionBasis`.
        cov_of_marks: (N, 3, 3) m², from the σ of the marks; NaN for a point that its rays do not determine.
    """

    by_poses: csr_matrix
    by_lens: FloatArray
    cov_of_marks: FloatArray


def intersection_jacobian(
    marks: Network, sigma_px: FloatArray, surveyed: FloatArray | None = None
) -> IntersectionJacobian:
    """Return the derivatives by poses and lens of the points of a network, each intersected from its own marks.

    The derivatives are taken at the projections of the points; the pixels of the marks do not enter. Marks of
    points behind their camera do not count.

    Args:
        marks: N points, M marks.
        sigma_px: (M,) σ of the marks.
        surveyed: (N, 3, 3) information on the points beyond their marks, 1/m²; None: there is none.
    """
    sigma_px, marks = sigma_px[has_positive_depth(marks)], with_positive_depths(marks)
    lin, count = linearise_bundle(marks), len(marks.point_in_world)
    pull = np.swapaxes(lin.jacobian_point, 1, 2) / (sigma_px**2)[:, None, None]
    normal = np.zeros((count, 3, 3)) if surveyed is None else surveyed.copy()
    np.add.at(normal, marks.obs_point, pull @ lin.jacobian_point)
    value, vector = np.linalg.eigh(normal)
    value[value[:, 0] <= 1e-9 * value[:, 2]] = np.nan
    cov = (vector / value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    response = -cov[marks.obs_point] @ pull  # (M, 3, 2) metres per pixel
    lens = np.zeros((count, len(marks.cameras), 3, lin.jacobian_intrinsics.shape[2]))
    np.add.at(lens, (marks.obs_point, lens_slots(marks)), response @ lin.jacobian_intrinsics)
    order = np.argsort(marks.obs_point, kind="stable")
    first = np.searchsorted(marks.obs_point[order], np.arange(count + 1))
    blocks = ((response @ lin.jacobian_pose)[order], marks.obs_image[order], first)
    poses = bsr_matrix(blocks, shape=(3 * count, 6 * len(marks.camera_id)))
    return IntersectionJacobian(csr_matrix(poses), np.swapaxes(lens, 1, 2).reshape(count, 3, -1), cov)
