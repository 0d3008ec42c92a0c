"""Patterns of differences between positions: one shift, two shifts, blunders among good ones, or noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from pipelines.core.types import BoolArray, FloatArray
from pipelines.robust.statistics import median_chi2, outlier_gate

LEAST_GROUP = 3  # members of a group, of which one would be a blunder
_LEAST_SHARE = 0.15  # of all, below which the smaller group counts as blunders
_APART = 5.0  # least distance of the groups' middles, in units of the scatter within the wider group
_STEPS = 20  # of k-means


@dataclass(frozen=True)
class TwoGroups:
    """Two groups of offsets (n, d), in the unit of the offsets."""

    second: BoolArray  # (n,) the smaller group
    apart: FloatArray  # (d,) middle of the smaller group minus that of the larger


def scatter_about_median(offsets: ArrayLike) -> float:
    """Return the robust σ per axis of offsets (n, d) about the median of each axis, up to half of them blunders."""
    array = np.asarray(offsets, dtype=np.float64)
    squared = ((array - np.median(array, axis=0)) ** 2).sum(axis=1)
    return float(np.sqrt(np.median(squared) / median_chi2(array.shape[1])))


def median_spacing(places: ArrayLike) -> float:
    """Return the median distance of n ≥ 2 places (n, d) from the nearest other one."""
    array = np.asarray(places, dtype=np.float64)
    return float(np.median(KDTree(array).query(array, k=2)[0][:, 1]))


def two_groups(offsets: ArrayLike) -> TwoGroups | None:
    """Return the two groups into which offsets (n, d) fall, or None if they do not.

    The best split along the axis of the largest extent is refined by k-means. One normal distribution, cut in two,
    is no such mixture: its halves lie 2.7 of their own σ apart.
    """
    array = np.asarray(offsets, dtype=np.float64)
    least = max(LEAST_GROUP, int(np.ceil(_LEAST_SHARE * len(array))))
    if len(array) < 2 * least:
        return None
    axis = np.linalg.svd(array - np.median(array, axis=0), full_matrices=False)[2][0]
    along = array @ axis
    order = np.argsort(along, kind="stable")
    ranked = along[order]
    count = np.arange(least, len(array) - least + 1)
    total, squares = np.cumsum(ranked), np.cumsum(ranked**2)
    left = squares[count - 1] - total[count - 1] ** 2 / count
    right = (squares[-1] - squares[count - 1]) - (total[-1] - total[count - 1]) ** 2 / (len(array) - count)
    second = np.ones(len(array), dtype=bool)
    second[order[: count[np.argmin(left + right)]]] = False
    for _ in range(_STEPS):
        middles = [np.median(array[mask], axis=0) for mask in (~second, second)]
        distance = [np.linalg.norm(array - middle, axis=1) for middle in middles]
        nearer = distance[1] < distance[0]
        if min(nearer.sum(), (~nearer).sum()) < least:
            return None
        if np.array_equal(nearer, second):
            break
        second = nearer
    if second.sum() > len(array) / 2:
        second, middles = ~second, middles[::-1]
    apart = middles[1] - middles[0]
    within = max(scatter_about_median(array[mask]) for mask in (~second, second))
    if np.linalg.norm(apart) < _APART * within:
        return None
    return TwoGroups(second, apart)


def blunders_among(offsets: ArrayLike, sigma: float) -> BoolArray | None:
    """Return the mask (n,) of the blunders among n ≥ 1 offsets (n, d) whose majority agrees; None: none stands out.

    `sigma` is that of a good offset per axis; the robust scatter of the offsets replaces it if it is larger.
    """
    array = np.asarray(offsets, dtype=np.float64)
    scale = max(scatter_about_median(array), sigma)
    squared = ((array - np.median(array, axis=0)) ** 2).sum(axis=1)
    bad = squared > 4.0 * outlier_gate(array.shape[1]) * scale**2
    return bad if bad.any() else None
