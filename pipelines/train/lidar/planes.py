"""Planes of a LiDAR as observations of the adjustment."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.terms import Planes
from pipelines.geometry.similarity import Similarity
from pipelines.robust.statistics import mad_sigma
from pipelines.train.lidar.registration import Registration

_CLUSTER_M = 5.0
_LEAST_POINTS = 5
_LEAST_SIGMA_M = 1e-3


def planes_of(found: Registration, geo_from_model: Similarity) -> Planes:
    """Return one plane for each cluster of 5 m and each direction that planes face there.

    The errors of neighbouring points are not independent: the median of a cluster is one observation. Its σ is the
    robust spread of these medians about the shift.

    Args:
        found: registration, whose shift is part of the observations again.
        geo_from_model: initial similarity, a pure shift.
    """
    matches = found.matches
    distance = matches.distance_m - found.wall_bias_m * matches.wall
    facing = np.abs(matches.normal_in_model).argmax(axis=1)
    side = np.sign(np.take_along_axis(matches.normal_in_model, facing[:, None], axis=1))[:, 0]
    cell = np.floor(matches.point_in_model / _CLUSTER_M).astype(np.int64)
    key = np.column_stack([cell, facing, side.astype(np.int64)])
    _, cluster, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort((distance, cluster.ravel()))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    middle = order[first + count // 2][count >= _LEAST_POINTS]
    normal, off = matches.normal_in_model[middle], distance[middle]
    measured = matches.point_in_model[middle]
    sigma_m = max(mad_sigma(off), _LEAST_SIGMA_M)
    return Planes(
        point_in_model=measured + off[:, None] * normal,
        position_in_geo=geo_from_model.apply(measured + found.shift_m),
        normal_in_geo=normal,
        root_information=np.full((len(middle), 1, 1), 1.0 / sigma_m),
    )
