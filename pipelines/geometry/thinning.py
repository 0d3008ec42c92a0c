"""Points thinned to a grid whose cubes are as large as the points stand for."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, IntArray

_SMALLEST_M = 1e-6


def one_a_cube(points: FloatArray, side_m: FloatArray) -> IntArray:
    """Ascending indices of the first of the points (P, 3) in each cube of about its side (P,), a power of two."""
    level = np.round(np.log2(np.maximum(side_m, _SMALLEST_M)))
    cube = np.floor(points / (2.0**level)[:, None])
    _, first = np.unique(np.column_stack([level, cube]), axis=0, return_index=True)
    return np.sort(first)
