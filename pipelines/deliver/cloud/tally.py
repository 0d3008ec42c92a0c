"""Figures of a cloud that is written in parts: count, bounds, and medians of σ."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.cloud_points import CloudPoints
from pipelines.formats.georef_sidecar import SceneSigma

# Classes of the σ, 1 % wide, from 0.1 mm to 2 km: medians are known to 1 % without keeping all values.
_LEAST_M, _RATIO, _CLASSES = 1e-4, 1.01, 1700


class Tally:
    """Figures of the points so far."""

    def __init__(self) -> None:
        self.count = 0
        self.bounds = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._horizontal, self._vertical = (np.zeros(_CLASSES, dtype=np.int64) for _ in range(2))
        self._largest = np.zeros(2)

    def add(self, points: CloudPoints) -> None:
        """Add points."""
        if not len(points):
            return
        self.count += len(points)
        self.bounds[0] = np.minimum(self.bounds[0], points.position.min(axis=0))
        self.bounds[1] = np.maximum(self.bounds[1], points.position.max(axis=0))
        self._horizontal += _classes(points.sigma_h_m)
        self._vertical += _classes(points.sigma_v_m)
        self._largest = np.fmax(self._largest, [np.fmax.reduce(points.sigma_h_m), np.fmax.reduce(points.sigma_v_m)])

    def sigma(self, counts: str) -> SceneSigma | None:
        """Return medians and largest of the known σ; None: none is known.

        Args:
            counts: errors that they hold.
        """
        if not self._vertical.any():
            return None
        horizontal, vertical = self._largest.tolist()
        return SceneSigma(
            counts=counts,
            median_sigma_h_m=_median(self._horizontal),
            median_sigma_v_m=_median(self._vertical),
            largest_sigma_h_m=horizontal,
            largest_sigma_v_m=vertical,
        )


def _classes(sigma_m: FloatArray | np.ndarray) -> IntArray:
    known = np.maximum(sigma_m[np.isfinite(sigma_m)], _LEAST_M)
    place = np.round(np.log(known / _LEAST_M) / np.log(_RATIO)).astype(np.int64)
    return np.bincount(np.minimum(place, _CLASSES - 1), minlength=_CLASSES)


def _median(classes: IntArray) -> float:
    place = int(np.searchsorted(np.cumsum(classes), (classes.sum() + 1) // 2))
    return float(_LEAST_M * _RATIO**place)
