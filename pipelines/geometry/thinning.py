"""Thinning of points on a voxel grid whose voxel size varies from point to point."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, IntArray

_SMALLEST_M = 1e-6


def thin_to_voxels(points: FloatArray, side_m: FloatArray) -> IntArray:
    """Return ascending indices of one point a voxel, the first.

    Args:
        points: (P, 3) metres.
        side_m: (P,) wanted side of each point's voxel; rounded to a power of two, so that equal sides share a grid.
    """
    level = np.round(np.log2(np.maximum(side_m, _SMALLEST_M)))
    voxel = np.floor(points / (2.0**level)[:, None])
    _, first = np.unique(np.column_stack([level, voxel]), axis=0, return_index=True)
    return np.sort(first)
