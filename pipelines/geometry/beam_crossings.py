"""Crossings of the cells of a grid by beams."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.core.types import FloatArray, IntArray

_MOST = 255
_STEP = 0.25  # of a cell's side


def crossings(
    end: FloatArray, start: FloatArray, low: FloatArray, cell_m: float, shape: IntArray
) -> NDArray[np.uint8]:
    """Return how many beams cross each cell, 255 at most.

    Beams are sampled at a quarter of a cell's side, from their ends until they leave the grid: corners of cells may
    be missed.

    Args:
        end: (P, 3) ends of the beams, in the grid.
        start: (P, 3) their starts, elsewhere than the ends.
        low: (3,) low corner of the grid.
        cell_m: side of the cells.
        shape: (3,) number of cells.
    """
    count = np.zeros(tuple(shape.tolist()), dtype=np.uint8)
    _cross(end, start, low, cell_m, count)
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _cross(end: Any, start: Any, low: Any, cell_m: float, count: Any) -> None:
    for p in range(len(end)):
        dx, dy, dz = start[p, 0] - end[p, 0], start[p, 1] - end[p, 1], start[p, 2] - end[p, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        steps = int(length / (_STEP * cell_m))
        last = -1
        for step in range(steps + 1):
            part = step * _STEP * cell_m / length
            i = int(np.floor((end[p, 0] + part * dx - low[0]) / cell_m))
            j = int(np.floor((end[p, 1] + part * dy - low[1]) / cell_m))
            k = int(np.floor((end[p, 2] + part * dz - low[2]) / cell_m))
            if i < 0 or j < 0 or k < 0 or i >= count.shape[0] or j >= count.shape[1] or k >= count.shape[2]:
                break
            place = (i * count.shape[1] + j) * count.shape[2] + k
            if place != last and count[i, j, k] < _MOST:
                count[i, j, k] += 1
            last = place
