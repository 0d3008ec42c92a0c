"""How points follow the cameras that see them: the derivative of an intersection of rays (GeoRefGS eqs 4–8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from pipelines.geometry.rotations import skew
from pipelines.products import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class SightLines:
    """K rays from cameras to points.

    Attributes:
        point: (K,) index into the points.
        camera: (K,) index into the cameras.
        sigma_rad: (K,) angular σ of the image mark.
    """

    point: IntArray
    camera: IntArray
    sigma_rad: FloatArray


@dataclass(frozen=True)
class Following:
    """What moves J intersected points.

    Attributes:
        by_cameras: (J, 3, k) metres per unit of each of the k corrections.
        cov_of_marks: (J, 3, 3) m², what the marks' own σ leaves.
    """

    by_cameras: FloatArray
    cov_of_marks: FloatArray


def follow(point: FloatArray, lines: SightLines, center: FloatArray, basis: FloatArray) -> Following:
    """How points that are intersected from rays follow corrections of the cameras, to first order.

    A camera that turns by δω about its centre c and moves by δc carries its ray at the point p along, by
    δc + δω × (p − c). The part of it across the ray counts, weighted by the inverse variance of the mark there.

    Args:
        point: (J, 3), where the rays meet; each by two rays that are not parallel, else NaN results.
        lines: the rays.
        center: (n, 3) of the cameras, in the frame of the points.
        basis: (n, 6, k), see `geometry.bundle.CorrectionBasis`.
    """
    count, n = len(point), len(center)
    arm = point[lines.point] - center[lines.camera]
    distance = np.linalg.norm(arm, axis=1)
    direction = arm / distance[:, None]
    weight = 1.0 / (lines.sigma_rad * distance) ** 2
    across = weight[:, None, None] * (np.eye(3) - direction[:, :, None] * direction[:, None, :])
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, lines.point, across)
    value, vector = np.linalg.eigh(normal)
    value[value[:, 0] <= 1e-9 * value[:, 2]] = np.nan
    cov = (vector / value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    share = cov[lines.point] @ across
    blocks = np.concatenate([share @ -skew(arm), share], axis=2)
    columns = np.broadcast_to((6 * lines.camera)[:, None, None] + np.arange(6), blocks.shape)
    rows = np.broadcast_to((3 * lines.point)[:, None, None] + np.arange(3)[:, None], blocks.shape)
    response = csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, 6 * n))
    by_cameras = response @ basis.reshape(6 * n, -1)
    return Following(np.asarray(by_cameras).reshape(count, 3, -1), cov)
