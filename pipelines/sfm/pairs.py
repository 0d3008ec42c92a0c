"""Choice of the image pairs to match, from camera positions and viewing directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray

# Between views that differ by a larger angle SIFT finds hardly any matches.
_MAX_ANGLE_DEG = 60.0
_SECTORS = 8
_CANDIDATES_PER_NEIGHBOR = 8


@dataclass(frozen=True)
class CameraDirections:
    """Positions and viewing directions of N images.

    Attributes:
        position_in_geo: (N, 3) metres, NaN where unknown.
        axis_in_geo: (N, 3) unit vectors of the optical axes, NaN where unknown.
    """

    position_in_geo: FloatArray
    axis_in_geo: FloatArray


def all_pairs(count: int) -> IntArray:
    """Return every pair (P, 2), i < j, of `count` images."""
    return np.stack(np.triu_indices(count, k=1), axis=1)


def select_pairs(cameras: CameraDirections, max_neighbors: int) -> IntArray:
    """Return the pairs (P, 2), i < j, of images that may show the same place; sorted, unique.

    1. Half of an image's neighbours are the nearest with a similar viewing direction.
    2. The others are the nearest in each of eight directions. With a dense forward overlap, these connect a flight
       line to the lines beside it.
    3. Images without a position are paired with all others, and each image with its successor in the list.

    Args:
        cameras: of N images.
        max_neighbors: limit of the neighbours in steps 1 and 2.
    """
    position = cameras.position_in_geo
    count = len(position)
    located = np.flatnonzero(np.isfinite(position).all(axis=1))
    chosen = {(i, i + 1) for i in range(count - 1)}
    for i in map(int, np.flatnonzero(~np.isfinite(position).all(axis=1))):
        chosen.update((min(i, j), max(i, j)) for j in range(count) if j != i)
    if len(located) > 1:
        tree = cKDTree(position[located])
        reach = min(len(located), max_neighbors * _CANDIDATES_PER_NEIGHBOR + 1)
        for i in map(int, located):
            near = located[tree.query(position[i], k=reach)[1]]
            near = near[(near != i) & _look_alike(cameras.axis_in_geo, i, near)]
            for j in _spread(position[near] - position[i], max_neighbors):
                chosen.add((min(i, int(near[j])), max(i, int(near[j]))))
    return np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)


def _look_alike(axis: FloatArray, i: int, others: IntArray) -> BoolArray:
    cosine = axis[others] @ axis[i]
    return np.asarray(~(cosine < np.cos(np.radians(_MAX_ANGLE_DEG))))  # unknown (NaN) passes


def _spread(offset: FloatArray, limit: int) -> list[int]:
    """Return up to `limit` candidates, sorted by distance: the nearest half, then the nearest of each sector."""
    order = list(range(min(len(offset), limit // 2)))
    sector = (np.arctan2(offset[:, 1], offset[:, 0]) // (2 * np.pi / _SECTORS)).astype(int)
    rank = np.zeros(len(offset), dtype=int)
    for value in np.unique(sector):
        members = np.flatnonzero(sector == value)
        rank[members] = np.arange(len(members))
    rest = [int(j) for j in np.lexsort((np.arange(len(offset)), rank)) if j >= len(order)]
    return order + rest[: limit - len(order)]
