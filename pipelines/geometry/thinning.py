"""Thinning of points on a grid of voxels of one size, or of a size that varies from point to point."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, IntArray

_SMALLEST_M = 1e-6
_LARGEST_NUMBER = 2**62


def voxel_keys(points: FloatArray, side_m: float) -> IntArray:
    """Return a number (P,) for the voxel of each point, the same for points of one voxel.

    Args:
        points: (P, 3) metres, P ≥ 1.
        side_m: side of the voxels.
    """
    return _row_numbers(np.floor(points / side_m).astype(np.int64))


def first_of_voxels(points: FloatArray, side_m: float) -> IntArray:
    """Return ascending rows of the first point in each voxel; arguments as for `voxel_keys`, or no points."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    return np.sort(np.unique(voxel_keys(points, side_m), return_index=True)[1])


def thin_to_voxels(points: FloatArray, side_m: FloatArray) -> IntArray:
    """Return ascending indices of one point a voxel, the first.

    Args:
        points: (P, 3) metres.
        side_m: (P,) wanted side of each point's voxel; rounded to a power of two, so that equal sides share a grid.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    level = np.round(np.log2(np.maximum(side_m, _SMALLEST_M)))
    voxel = np.floor(points / (2.0**level)[:, None])
    _, first = np.unique(_row_numbers(np.column_stack([level, voxel]).astype(np.int64)), return_index=True)
    return np.sort(first)


def _row_numbers(rows: IntArray) -> IntArray:
    """Return a number (P,) for each of P ≥ 1 rows, the same for equal rows; numbers sort ten times as fast."""
    number = np.zeros(len(rows), dtype=np.int64)
    for column in (rows - rows.min(axis=0)).T:
        extent = int(column.max()) + 1
        if int(number.max()) >= _LARGEST_NUMBER // extent:
            _, number = np.unique(number, return_inverse=True)
        number = number * extent + column
    return number
