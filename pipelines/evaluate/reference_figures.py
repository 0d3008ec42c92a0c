"""Figures of the distances of all squares: exact counts below thresholds, quantiles to the millimetre."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray, joined_rows
from pipelines.evaluate.reference_distances import (
    CLASSES,
    CONFIDENCE_95,
    FARTHEST_M,
    SLOPES,
    CorePoints,
    Kinds,
    SquareDistances,
)
from pipelines.survey.report_parts import CloudDistances, M3c2Figures, ReferenceGroup, SurfaceScore

THRESHOLDS_M = (0.05, 0.1, 0.3)
_STEP_M = 1e-3
_BINS = round(FARTHEST_M / _STEP_M) + 2  # 0, then one for each millimetre, then all beyond
_NMAD = 1.4826
_NO_CORES = CorePoints(
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros(0),
    Kinds(np.zeros(0, np.int64), np.zeros(0, np.int64)),
)


class DistanceTally:
    """Counts of the distances of all squares, by class and slope."""

    def __init__(self) -> None:
        shape = (len(CLASSES), len(SLOPES) + 1, _BINS)
        self._to_reference, self._to_model = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        self._cores: list[CorePoints] = []
        self.points = self.seen = 0  # of the reference: all, and those that photographs saw

    def add(self, found: SquareDistances) -> None:
        """Add a square."""
        _count(self._to_reference, found.to_reference_m, found.model_kinds)
        _count(self._to_model, found.to_model_m, found.reference_kinds)
        self.points += found.points
        self.seen += len(found.to_model_m)
        if len(found.cores.position):
            self._cores.append(found.cores)

    def cores(self) -> CorePoints:
        """Return the core points of all squares."""
        parts = [_NO_CORES, *self._cores]
        return replace(joined_rows(parts), kinds=joined_rows([part.kinds for part in parts]))

    def groups(self, cores: CorePoints, lod_m: FloatArray) -> tuple[ReferenceGroup, ...]:
        """Return the figures of the whole, and of all classes and slopes that have points.

        `lod_m` (C,) are the core points' levels of detection, 95 %, with the σ that both clouds' places have.
        """

        def group(
            name: str,
            kind: Literal["all", "class", "slope"],
            part: tuple[int | slice, int | slice],
            chosen: BoolArray,
        ) -> ReferenceGroup:
            to_reference, to_model = (
                counts[part].reshape(-1, _BINS).sum(axis=0) for counts in (self._to_reference, self._to_model)
            )
            return ReferenceGroup(
                name=name,
                kind=kind,
                seen_points=int(to_model.sum()),
                m3c2=m3c2_figures(cores.distance_m[chosen], lod_m[chosen]),
                c2c=_cloud_distances(to_reference),
                scores=tuple(_score(threshold, to_reference, to_model) for threshold in THRESHOLDS_M),
            )

        kinds, every = cores.kinds, slice(None)
        groups = [group("all", "all", (every, every), kinds.of_class >= 0)]
        if self._to_model[1:].any() or self._to_reference[1:].any():
            groups += [
                group(name, "class", (place, every), kinds.of_class == place) for place, name in enumerate(CLASSES)
            ]
        groups += [
            group(name, "slope", (every, place), kinds.of_slope == place) for place, name in enumerate(SLOPES)
        ]
        return tuple(each for each in groups if each.kind == "all" or each.seen_points or each.c2c.count)


def m3c2_figures(distance_m: FloatArray, lod_m: FloatArray) -> M3c2Figures:
    """Return the figures of distances (C,), NaN where they are not known, with their levels of detection (C,)."""
    known = np.isfinite(distance_m)
    d, lod = distance_m[known], lod_m[known]
    if not len(d):
        names = ("median_m", "mean_m", "nmad_m", "rmse_m", "abs_95_m", "median_lod_m", "significant")
        return M3c2Figures(core_points=len(distance_m), measured=0, **dict.fromkeys(names))
    return M3c2Figures(
        core_points=len(distance_m),
        measured=len(d),
        median_m=float(np.median(d)),
        mean_m=float(d.mean()),
        nmad_m=float(_NMAD * np.median(np.abs(d - np.median(d)))),
        rmse_m=float(np.sqrt(np.mean(d**2))),
        abs_95_m=float(np.quantile(np.abs(d), 0.95)),
        median_lod_m=float(np.median(lod)),
        significant=float(np.mean(np.abs(d) > lod)),
    )


def level_of_detection(noise_m: FloatArray, registration_m: FloatArray) -> FloatArray:
    """Return the level of detection, 95 %, of distances with σ of noise and of the clouds' places, both (C,)."""
    return CONFIDENCE_95 * (noise_m + registration_m)


def _count(counts: IntArray, distance_m: FloatArray, kinds: Kinds) -> None:
    # Bin k holds distances in ((k − 1) mm, k mm]. Rounding first: 0.3 / 0.001 is 299.99… in floats.
    steps = np.ceil(np.round(np.minimum(distance_m, 2 * FARTHEST_M) / _STEP_M, 9))
    place = np.minimum(steps, _BINS - 1).astype(np.int64)
    np.add.at(counts, (kinds.of_class, kinds.of_slope, place), 1)


def _share_within(counts: IntArray, threshold_m: float) -> float | None:
    total = int(counts.sum())
    return float(counts[: round(threshold_m / _STEP_M) + 1].sum()) / total if total else None


def _score(threshold_m: float, to_reference: IntArray, to_model: IntArray) -> SurfaceScore:
    precision, recall = _share_within(to_reference, threshold_m), _share_within(to_model, threshold_m)
    f1 = None
    if precision is not None and recall is not None:
        f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return SurfaceScore(threshold_m=threshold_m, precision=precision, recall=recall, f1=f1)


def _cloud_distances(counts: IntArray) -> CloudDistances:
    total = int(counts.sum())
    if not total:
        return CloudDistances(count=0, median_m=None, mean_m=None, abs_95_m=None)
    middle = np.clip((np.arange(_BINS) - 0.5) * _STEP_M, 0, FARTHEST_M)
    below = np.cumsum(counts)
    median, high = (float(middle[np.searchsorted(below, share * total)]) for share in (0.5, 0.95))
    return CloudDistances(count=total, median_m=median, mean_m=float(middle @ counts / total), abs_95_m=high)
