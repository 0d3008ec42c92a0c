"""Space that the beams of a LiDAR have crossed, and in which nothing stands."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.beam_crossings import crossings
from pipelines.splat.free_space import FreeSpace
from pipelines.train.lidar.cloud import LidarCloud

_CELL_M, _CELL_SPACINGS = 1.0, 3.0  # least sides of a cell
_MOST_CELLS = 40_000_000
_GROWTH = 1.3
_LEAST_BEAMS = 3


def free_space(cloud: LidarCloud, gone: BoolArray, shown: FloatArray) -> FreeSpace | None:
    """Return the cells that beams have crossed and in which nothing is seen; None: no beam is known.

    Args:
        cloud: with the scanner's places.
        gone: (P,) points that contradict the photographs: their beams do not count.
        shown: (S, 3) surface that the photographs show; what stands there now is not free.
    """
    if cloud.scanner_in_model is None:
        return None
    beams = np.flatnonzero(np.isfinite(cloud.scanner_in_model[:, 0]) & ~gone)
    if not len(beams):
        return None
    end = cloud.position_in_model
    low, high = end[beams].min(axis=0), end[beams].max(axis=0)
    cell_m = max(_CELL_M, _CELL_SPACINGS * cloud.voxel_m)
    while np.prod(np.ceil((high - low) / cell_m) + 1) > _MOST_CELLS:
        cell_m *= _GROWTH
    shape = (np.ceil((high - low) / cell_m) + 1).astype(np.int64)
    count = crossings(end[beams], cloud.scanner_in_model[beams], low, cell_m, shape)
    taken = np.zeros(shape, dtype=bool)
    for points in (end, shown):
        cell = np.floor((points - low) / cell_m).astype(np.int64)
        cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
        taken[tuple(cell.T)] = True
    taken = ndimage.binary_dilation(taken, np.ones((3, 3, 3)))
    return FreeSpace(low, cell_m, (count >= _LEAST_BEAMS) & ~taken)
