"""Distances between the model's cloud and the reference in one square of the plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.evaluate.reference.m3c2 import m3c2
from pipelines.evaluate.reference.normals import plane_normals
from pipelines.evaluate.reference.seen import SeenSurface
from pipelines.evaluate.reference.tiles import Square, TiledPoints
from pipelines.geometry.thinning import first_of_voxels

CLASSES = ("other", "ground", "roof", "wall", "vegetation")
SLOPES = ("0–15°", "15–45°", "45–75°", "75–90°")
_SLOPE_LIMITS_DEG = (15.0, 45.0, 75.0)
_WALL_DEG = 60.0  # a steeper part of a building is no roof
_GROUND, _BUILDING, _VEGETATION = (2,), (6,), (3, 4, 5)  # classes of LAS
FARTHEST_M = 2.0  # of the nearest points that are looked for
_REACH_M = 1.0  # of the cylinders
_MOST_POINTS = 2_000_000  # of a cloud in a square, for M3C2: seconds
Box = tuple[FloatArray, FloatArray]
_CORE_SPACINGS = 3.0  # between core points: a cylinder of this radius holds about 28 points of a surface


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings of the comparison, in metres.

    Attributes:
        voxel_m: side of the voxels of which one point of the reference counts.
        core_m: between core points, and radius of the cylinders.
        cover_m: side of the cells of the plan that the reference covers if they hold one of its points.
        cut: corners (3,) of the box outside of which the reference was left out; None: all of it is there.
    """

    voxel_m: float
    core_m: float
    cover_m: float
    cut: Box | None = None

    @classmethod
    def of_spacings(
        cls, reference_m: float, model_m: float, least_threshold_m: float, cut: Box | None
    ) -> ComparisonSettings:
        """Return the settings for clouds with a distance between neighbours, and for a least threshold."""
        spacing_m = max(reference_m, model_m, least_threshold_m / 2)
        return cls(least_threshold_m / 2, _CORE_SPACINGS * spacing_m, max(1.0, 4 * reference_m), cut)

    def uncut(self, place: FloatArray) -> BoolArray:
        """Return at which of places (P, 3) a cylinder is not cut in the plan.

        A cut one holds points of the model alone on its outer side, whose mean height is another on uneven ground.
        """
        if self.cut is None:
            return np.ones(len(place), dtype=bool)
        low, high = self.cut
        inside = (place[:, :2] >= low[:2] + self.core_m) & (place[:, :2] <= high[:2] - self.core_m)
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True)
class Kinds:
    """Class and slope of P points.

    Attributes:
        of_class: (P,) index in `CLASSES`.
        of_slope: (P,) index in `SLOPES`; the number of slopes where the slope is not known.
    """

    of_class: IntArray
    of_slope: IntArray

    def part(self, rows: IntArray | BoolArray) -> Kinds:
        """Return the kinds of some rows."""
        return Kinds(self.of_class[rows], self.of_slope[rows])


@dataclass(frozen=True)
class CorePoints:
    """M3C2 at C places of the reference that photographs saw.

    Attributes:
        position: (C, 3) in geo.
        normal: (C, 3) towards the cameras.
        distance_m: (C,) model minus reference; NaN: not measured.
        noise_m: (C,) σ from the roughness of both clouds.
        kinds: class and slope.
    """

    position: FloatArray
    normal: FloatArray
    distance_m: FloatArray
    noise_m: FloatArray
    kinds: Kinds


@dataclass(frozen=True)
class SquareDistances:
    """Distances in one square, in metres; those beyond `FARTHEST_M` are infinite.

    Attributes:
        to_reference_m: (M,) of the model's points that the reference covers.
        model_kinds: class and slope of the nearest points of the reference.
        to_model_m: (R,) of the reference's points that photographs saw.
        reference_kinds: their class and slope.
        points: number of the reference's points, seen or not.
        cores: M3C2.
    """

    to_reference_m: FloatArray
    model_kinds: Kinds
    to_model_m: FloatArray
    reference_kinds: Kinds
    points: int
    cores: CorePoints


def compare_square(
    square: Square,
    reference: TiledPoints,
    model: TiledPoints,
    seen: SeenSurface,
    settings: ComparisonSettings,
) -> SquareDistances:
    """Return the distances between two clouds in a square."""
    margin_m = FARTHEST_M + 3 * settings.core_m
    rows, own = reference.around(square, margin_m)
    every = _at_random(rows["position"])
    kept = first_of_voxels(rows["position"], settings.voxel_m)
    rows, own = rows[kept], own[kept]
    model_rows, model_own = model.around(square, margin_m)
    place, normal, kinds = rows["position"], *_surface(rows, model_rows, settings)
    is_seen = np.zeros(len(rows), dtype=bool)
    is_seen[own] = seen.sees(place[own])
    to_model, _ = _nearest(place[is_seen], model_rows["position"])
    covered = model_own & _covered(model_rows["position"], place, settings.cover_m)
    to_reference, nearest = _nearest(model_rows["position"][covered], place)
    usable = np.flatnonzero(is_seen & np.isfinite(normal[:, 0]) & settings.uncut(place))
    cores = usable[first_of_voxels(place[usable], settings.core_m)]
    model_every = _at_random(model_rows["position"])
    measured = m3c2(every, model_every, place[cores], normal[cores], radius_m=settings.core_m, reach_m=_REACH_M)
    return SquareDistances(
        to_reference,
        kinds.part(nearest),
        to_model,
        kinds.part(is_seen),
        int(own.sum()),
        CorePoints(place[cores], normal[cores], measured.distance_m, measured.noise_m, kinds.part(cores)),
    )


def kinds_of(classification: NDArray[np.uint8], normal: FloatArray) -> Kinds:
    """Return class and slope of points.

    Args:
        classification: (P,) of LAS.
        normal: (P, 3) unit vectors with an arbitrary sign; NaN: not known.
    """
    slope = np.degrees(np.arccos(np.clip(np.abs(normal[:, 2]), 0, 1)))
    steep = slope > _WALL_DEG
    building = np.isin(classification, _BUILDING)
    index = {name: place for place, name in enumerate(CLASSES)}
    of_class = np.select(
        [
            np.isin(classification, _GROUND),
            building & steep,
            building,
            np.isin(classification, _VEGETATION),
        ],
        [index["ground"], index["wall"], index["roof"], index["vegetation"]],
        index["other"],
    )
    of_slope = np.where(np.isfinite(slope), np.searchsorted(_SLOPE_LIMITS_DEG, slope), len(SLOPES))
    return Kinds(of_class.astype(np.int64), of_slope.astype(np.int64))


def _surface(
    rows: NDArray[np.void], model_rows: NDArray[np.void], settings: ComparisonSettings
) -> tuple[FloatArray, Kinds]:
    """Return normals (P, 3) of the reference on the side of the model's normals, and the kinds of its points."""
    place = rows["position"]
    if not len(place):
        return np.zeros((0, 3)), kinds_of(rows["classification"], np.zeros((0, 3)))
    # Neighbours of a normal are half a core apart: noise would turn the normals of closer ones.
    spacing_m = settings.core_m / 2
    sparse = first_of_voxels(place, spacing_m)
    normal = plane_normals(place[sparse], spacing_m)
    if len(model_rows):
        towards = model_rows["normal"][cKDTree(model_rows["position"]).query(place[sparse])[1]].astype(np.float64)
        against = np.einsum("ni,ni->n", normal, towards) < 0
        normal = np.where(against[:, None], -normal, normal)
    normal = normal[cKDTree(place[sparse]).query(place)[1]]
    return normal, kinds_of(rows["classification"], normal)


def _at_random(position: FloatArray) -> FloatArray:
    """Return points (P, 3), or as many of them as M3C2 takes.

    One point a voxel would not do: where a noisy surface lies near a border of voxels, the few points beyond that
    border would count as much as the many before it, which shifts the mean by up to one σ.
    """
    if len(position) <= _MOST_POINTS:
        return position
    return position[np.sort(np.random.default_rng(0).choice(len(position), _MOST_POINTS, replace=False))]


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
