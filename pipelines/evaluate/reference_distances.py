"""Distances between the model's cloud and the reference in one square of the plan, and the figures of all squares.

Figures are exact counts below thresholds, and quantiles to the millimetre.
Distances along the normals of the reference are M3C2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray, joined_rows, rows_of
from pipelines.geometry.footprints import first_of_voxels
from pipelines.geometry.statistics import NORMAL_MAD
from pipelines.surface.m3c2 import CONFIDENCE_95, Square, TiledPoints, at_random, m3c2, oriented_normals
from pipelines.surface.visibility import SeenSurface
from pipelines.survey.reference_comparison import CloudDistances, M3c2Figures, ReferenceGroup, SurfaceScore

CLASSES = ("other", "ground", "roof", "wall", "vegetation")
SLOPES = ("0–15°", "15–45°", "45–75°", "75–90°")
_SLOPE_LIMITS_DEG = (15.0, 45.0, 75.0)
_WALL_DEG = 60.0  # a steeper part of a building is no roof
_GROUND, _BUILDING, _VEGETATION = (2,), (6,), (3, 4, 5)  # classes of LAS
FARTHEST_M = 2.0  # of the nearest points that are looked for
_REACH_M = 1.0  # of the cylinders
Box = tuple[FloatArray, FloatArray]
_CORE_SPACINGS = 3.0  # between core points: a cylinder of this radius holds about 28 points of a surface


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings of the comparison, in metres."""

    voxel_m: float  # side of the voxels of which one point of the reference counts
    core_m: float  # between core points, and radius of the cylinders
    cover_m: float  # side of the cells of the plan that the reference covers if they hold one of its points
    cut: Box | None = None  # outside of which the reference was left out; None: all of it is there

    @classmethod
    def of_spacings(
        cls, reference_m: float, model_m: float, least_threshold_m: float, cut: Box | None
    ) -> ComparisonSettings:
        """Return the settings for clouds with a distance between neighbours, and for a least threshold."""
        spacing_m = max(reference_m, model_m, least_threshold_m / 2)
        return cls(least_threshold_m / 2, _CORE_SPACINGS * spacing_m, max(1.0, 4 * reference_m), cut)

    def uncut(self, position: FloatArray) -> BoolArray:
        """Return at which of places (P, 3) a cylinder is not cut in the plan.

        A cut one holds points of the model alone on its outer side, whose mean height is another on uneven ground.
        """
        if self.cut is None:
            return np.ones(len(position), dtype=bool)
        low, high = self.cut
        inside = (position[:, :2] >= low[:2] + self.core_m) & (position[:, :2] <= high[:2] - self.core_m)
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True)
class Kinds:
    """Class and slope of P points."""

    of_class: IntArray  # (P,) index in `CLASSES`
    of_slope: IntArray  # (P,) index in `SLOPES`; the number of slopes where the slope is not known


@dataclass(frozen=True)
class CorePoints:
    """M3C2 at C places of the reference that photographs saw."""

    position: FloatArray  # (C, 3) in geo
    normal: FloatArray  # (C, 3) towards the cameras
    distance_m: FloatArray  # (C,) model minus reference; NaN: not measured
    noise_m: FloatArray  # (C,) σ from the roughness of both clouds
    kinds: Kinds


@dataclass(frozen=True)
class SquareDistances:
    """Distances in one square, in metres; those beyond `FARTHEST_M` are infinite."""

    to_reference_m: FloatArray  # (M,) of the model's points that the reference covers
    model_kinds: Kinds  # of the nearest points of the reference
    to_model_m: FloatArray  # (R,) of the reference's points that photographs saw
    reference_kinds: Kinds
    points: int  # of the reference, seen or not
    cores: CorePoints


def compare_square(
    square: Square,
    reference: TiledPoints,
    model: TiledPoints,
    seen: SeenSurface,
    settings: ComparisonSettings,
) -> SquareDistances:
    """Return the distances between both clouds in a square of the plan; points around it are neighbours only."""
    margin_m = FARTHEST_M + 3 * settings.core_m
    rows, inside = reference.around(square, margin_m)
    every = at_random(rows["position"])
    kept = first_of_voxels(rows["position"], settings.voxel_m)
    rows, inside = rows[kept], inside[kept]
    model_rows, model_own = model.around(square, margin_m)
    position, normal, kinds = rows["position"], *_surface(rows, model_rows, settings)
    is_seen = np.zeros(len(rows), dtype=bool)
    is_seen[inside] = seen.sees(position[inside])
    to_model, _ = _nearest(position[is_seen], model_rows["position"])
    covered = model_own & _covered(model_rows["position"], position, settings.cover_m)
    to_reference, nearest = _nearest(model_rows["position"][covered], position)
    usable = np.flatnonzero(is_seen & np.isfinite(normal[:, 0]) & settings.uncut(position))
    cores = usable[first_of_voxels(position[usable], settings.core_m)]
    model_every = at_random(model_rows["position"])
    distance_m, noise_m = m3c2(
        every, model_every, position[cores], normal[cores], radius_m=settings.core_m, reach_m=_REACH_M
    )
    return SquareDistances(
        to_reference,
        rows_of(kinds, nearest),
        to_model,
        rows_of(kinds, is_seen),
        int(inside.sum()),
        CorePoints(position[cores], normal[cores], distance_m, noise_m, rows_of(kinds, cores)),
    )


def kinds_of(classification: NDArray[np.uint8], normal: FloatArray) -> Kinds:
    """Return the kinds of points, by classes (P,) of LAS and unit normals (P, 3), NaN where not known."""
    slope = np.degrees(np.arccos(np.clip(np.abs(normal[:, 2]), 0, 1)))
    building = np.isin(classification, _BUILDING)
    masks = {
        "ground": np.isin(classification, _GROUND),
        "wall": building & (slope > _WALL_DEG),
        "roof": building,
        "vegetation": np.isin(classification, _VEGETATION),
    }
    of_class = np.select([*masks.values()], [CLASSES.index(name) for name in masks], CLASSES.index("other"))
    of_slope = np.where(np.isfinite(slope), np.searchsorted(_SLOPE_LIMITS_DEG, slope), len(SLOPES))
    return Kinds(of_class.astype(np.int64), of_slope.astype(np.int64))


def _surface(
    rows: NDArray[np.void], model_rows: NDArray[np.void], settings: ComparisonSettings
) -> tuple[FloatArray, Kinds]:
    """Return normals (P, 3) of the reference on the side of the model's normals, and the kinds of its points."""
    position = rows["position"]
    if not len(position):
        return np.zeros((0, 3)), kinds_of(rows["classification"], np.zeros((0, 3)))
    towards = model_rows["position"], model_rows["normal"].astype(np.float64)
    normal = oriented_normals(position, settings.core_m / 2, *towards)
    return normal, kinds_of(rows["classification"], normal)


def _nearest(position: FloatArray, others: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return distances to the nearest of other points, infinite beyond `FARTHEST_M`, and the rows of these."""
    if not (len(position) and len(others)):
        return np.full(len(position), np.inf), np.zeros(len(position), dtype=np.int64)
    distance, row = cKDTree(others).query(position)
    return np.where(distance <= FARTHEST_M, distance, np.inf), row.astype(np.int64)


def _covered(position: FloatArray, reference: FloatArray, cover_m: float) -> BoolArray:
    """Return whether the reference has a point in the cell of the plan in which points (P, 3) lie."""
    if not (len(position) and len(reference)):
        return np.zeros(len(position), dtype=bool)
    low = np.floor(np.minimum(position.min(axis=0), reference.min(axis=0))[:2] / cover_m).astype(np.int64)
    width = int(max(position[:, 1].max(), reference[:, 1].max()) / cover_m - low[1]) + 2

    def keys(points: FloatArray) -> IntArray:
        cell = np.floor(points[:, :2] / cover_m).astype(np.int64) - low
        return np.asarray(cell[:, 0] * width + cell[:, 1])

    return np.asarray(np.isin(keys(position), np.unique(keys(reference))))


THRESHOLDS_M = (0.05, 0.1, 0.3)
_STEP_M = 1e-3
_BINS = round(FARTHEST_M / _STEP_M) + 2  # 0, then one for each millimetre, then all beyond
_NO_KINDS = Kinds(np.zeros(0, np.int64), np.zeros(0, np.int64))
_NO_CORES = CorePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), _NO_KINDS)


class DistanceTally:
    """Counts of the distances of all squares, by class and slope."""

    def __init__(self) -> None:
        shape = (len(CLASSES), len(SLOPES) + 1, _BINS)
        self._to_reference, self._to_model = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        self._cores: list[CorePoints] = []
        self.points = self.seen = 0  # of the reference: all, and those that photographs saw

    def add(self, square: SquareDistances) -> None:
        _count(self._to_reference, square.to_reference_m, square.model_kinds)
        _count(self._to_model, square.to_model_m, square.reference_kinds)
        self.points += square.points
        self.seen += len(square.to_model_m)
        if len(square.cores.position):
            self._cores.append(square.cores)

    def cores(self) -> CorePoints:
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
                group(name, "class", (index, every), kinds.of_class == index) for index, name in enumerate(CLASSES)
            ]
        groups += [
            group(name, "slope", (every, index), kinds.of_slope == index) for index, name in enumerate(SLOPES)
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
        nmad_m=float(NORMAL_MAD * np.median(np.abs(d - np.median(d)))),
        rmse_m=float(np.sqrt(np.mean(d**2))),
        abs_95_m=float(np.quantile(np.abs(d), 0.95)),
        median_lod_m=float(np.median(lod)),
        significant=float(np.mean(np.abs(d) > lod)),
    )


def m3c2_level_of_detection(noise_m: FloatArray, registration_m: FloatArray) -> FloatArray:
    """Return the level of detection, 95 %, of distances with σ of noise and of the clouds' places, both (C,)."""
    return CONFIDENCE_95 * (noise_m + registration_m)


def _count(counts: IntArray, distance_m: FloatArray, kinds: Kinds) -> None:
    # Bin k holds distances in ((k − 1) mm, k mm]. Rounding first: 0.3 / 0.001 is 299.99… in floats.
    steps = np.ceil(np.round(np.minimum(distance_m, 2 * FARTHEST_M) / _STEP_M, 9))
    bin_number = np.minimum(steps, _BINS - 1).astype(np.int64)
    np.add.at(counts, (kinds.of_class, kinds.of_slope, bin_number), 1)


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
