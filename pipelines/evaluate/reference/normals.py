"""Normals of a cloud from the nearest points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import FloatArray

_NEIGHBOURS = 16
_FARTHEST = 6.0  # spacings: a point whose neighbours lie further off stands alone


def plane_normals(position: FloatArray, spacing_m: float) -> FloatArray:
    """Return unit normals (P, 3), upwards, of planes through the neighbours of points; NaN for lone points.

    Args:
        position: (P, 3) metres, about `spacing_m` apart.
        spacing_m: between the points.
    """
    count = min(_NEIGHBOURS, len(position))
    if count < 4:
        return np.full(position.shape, np.nan)
    distance, row = cKDTree(position).query(position, k=count)
    arm = position[row] - position[row].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", arm, arm))
    normal = axes[:, :, 0] * np.where(axes[:, 2:, 0] < 0, -1.0, 1.0)
    lone = distance[:, count // 2] > _FARTHEST * spacing_m
    return np.where(lone[:, None], np.nan, normal)
