"""Derivatives of intersected points by poses and lens of the cameras that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from pipelines.core.types import FloatArray, IntArray
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

    def by_corrections(self, basis: FloatArray) -> FloatArray:
        """Return the derivatives (N, 3, k) in metres by the k corrections of a basis (n, 6, k)."""
        n, rows, width = basis.shape
        moved = np.asarray(self.by_poses @ basis.reshape(rows * n, width))
        return moved.reshape(len(moved) // 3, 3, width)


def intersection_jacobian(marks: Network, sigma_px: FloatArray) -> IntersectionJacobian:
    """Return the derivatives by poses and lens of the points of a network, each intersected from its own marks.

    The derivatives are taken at the projections of the points; the pixels of the marks do not enter. Marks of
    points behind their camera do not count.

    Args:
        marks: N points, M marks.
        sigma_px: (M,) σ of the marks.
    """
    sigma_px, marks = sigma_px[has_positive_depth(marks)], with_positive_depths(marks)
    lin, count = linearise_bundle(marks), len(marks.point_in_world)
    pull = np.swapaxes(lin.jacobian_point, 1, 2) / (sigma_px**2)[:, None, None]
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, marks.obs_point, pull @ lin.jacobian_point)
    value, vector = np.linalg.eigh(normal)
    value[value[:, 0] <= 1e-9 * value[:, 2]] = np.nan
    cov = (vector / value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    response = -cov[marks.obs_point] @ pull  # (M, 3, 2) metres per pixel
    longest = lin.jacobian_intrinsics.shape[2]
    lens = _blocks(marks, response @ lin.jacobian_intrinsics, lens_slots(marks), longest * len(marks.cameras))
    poses = _blocks(marks, response @ lin.jacobian_pose, marks.obs_image, 6 * len(marks.camera_id))
    return IntersectionJacobian(poses, lens.toarray().reshape(count, 3, -1), cov)


def _blocks(marks: Network, blocks: FloatArray, column_block: IntArray, width: int) -> csr_matrix:
    """Return a sparse matrix (3 N, width) of the marks' blocks (M, 3, w); blocks at one place are added."""
    rows = (3 * marks.obs_point)[:, None, None] + np.arange(3)[:, None]
    columns = (blocks.shape[2] * column_block)[:, None, None] + np.arange(blocks.shape[2])
    rows, columns = np.broadcast_to(rows, blocks.shape), np.broadcast_to(columns, blocks.shape)
    shape = (3 * len(marks.point_in_world), width)
    return csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
