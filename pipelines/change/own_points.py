"""Surfaces against the tie points of their own date, which say by how much a surface errs, and where it is wrong.

The photographs of a date know a place twice, by the tie points that the adjusted cameras intersect, and by the
surface. Where few photographs see the ground, as at the rim of a survey, a surface may lie decimetres beside the
points. What it then differs from the other date's is the error of one surface.

On level ground a surface follows the points, with errors that vary slowly. Two dates whose photographs and ground
are alike share much of these, and where the ground has changed they share nothing: unchanged ground does not show
what a volume errs by, but the points of each date do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from pipelines.adjust.relative import Solved
from pipelines.change.datum import Epoch
from pipelines.change.detection import Noise, slow_error_m, unchanged_ground
from pipelines.change.grid import CommonGrid, EpochRasters
from pipelines.change.tied import Surfaces, least_of_witness_m
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.geotiff import sampled_raster
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.survey.change_report import ChangedRegion

_LEAST_POINTS = 2  # of a date in a region
_HALF = 0.5  # of a change: if a surface's own error is more, the change is its error
_AROUND_CELLS = 2.0  # of a point, where the surface has to be unbroken: a wall's points lie beneath the roof's edge
_MARGIN_M = 2.0  # by which the adjustment may move points
_MOST_POINTS = 20_000  # of a date, by which the errors of its surface are measured
_IN_BLOCK = 60  # of them on average: their median is known to a sixth of what single ones scatter


@dataclass(frozen=True)
class _Compared:
    """Tie points of a date: plan (K, 2) in the CRS, surface minus point (K,), and relief (K,) around it, metres."""

    plan: FloatArray
    off_m: FloatArray
    relief_m: FloatArray
    step_m: float  # how far around it

    def explain(self, polygon: shapely.Geometry, surfaces: Surfaces, sign: float, least_m: float) -> bool:
        """Return whether most points on changed, unbroken ground of a polygon say that this surface is wrong there.

        The surfaces differ by `least_m` on changed ground. `sign` is 1 of the later date, −1 of the earlier.
        """
        inside = shapely.contains_xy(polygon, *self.plan.T)
        differs_m, off_m, relief_m = surfaces.risen_m(self.plan[inside]), self.off_m[inside], self.relief_m[inside]
        witness = (np.abs(differs_m) >= least_m) & (relief_m <= np.maximum(np.abs(differs_m) / 2, self.step_m))
        explained = witness & (sign * off_m * np.sign(differs_m) >= _HALF * np.abs(differs_m))
        return bool(explained.sum() >= _LEAST_POINTS and 2 * explained.sum() > witness.sum())


def contradicted_by_own_points(
    grid: CommonGrid, regions: Sequence[ChangedRegion], polygons: Sequence[shapely.Geometry], surfaces: Surfaces
) -> tuple[int, ...]:
    """Return the places of the found regions that tie points of a date explain, as an error of its surface.

    A point is a witness where the surfaces differ by half of the region's mean change at least: not at its rim.

    Polygons are in the plan of the CRS.
    """
    found = [index for index, region in enumerate(regions) if region.name.startswith("R")]
    if not found:
        return ()
    near = shapely.union_all([polygons[index] for index in found]).buffer(_MARGIN_M / grid.unit_m)
    shapely.prepare(near)
    before, after = (
        _compared(rasters, epoch, grid.crs, shapely.contains_xy(near, _about(epoch, grid.crs)))
        for rasters, epoch in zip(grid.rasters, grid.epochs, strict=True)
    )

    def is_contradicted(index: int) -> bool:
        polygon, least_m = polygons[index], least_of_witness_m(regions[index])
        return after.explain(polygon, surfaces, 1.0, least_m) or before.explain(polygon, surfaces, -1.0, least_m)

    return tuple(index for index in found if is_contradicted(index))


def noise_of(grid: CommonGrid, stable: shapely.Geometry | None, progress: Progress, *, with_tilt: bool) -> Noise:
    """Return the errors of the difference of two epochs, by their unchanged ground and by their own tie points.

    `stable` is a polygon in the CRS of the ground that counts; None: all does. Errors as of `unchanged_ground`.
    """
    slow_m = 0.0
    if grid.rasters[0].of == "surface":
        before, after = (_slow_error_m(*date, grid.crs) for date in zip(grid.rasters, grid.epochs, strict=True))
        slow_m = float(np.hypot(before, after))
    samples = grid.samples(stable, progress)
    return unchanged_ground(samples, grid.cell_m, grid.datum_h_m, with_tilt=with_tilt, slow_m=slow_m)


def _slow_error_m(rasters: EpochRasters, epoch: Epoch, crs: PointCrs) -> float:
    """Return the σ of what a surface errs by over whole blocks of level ground, by its date's tie points."""
    count = len(epoch.posterior.sparse.point_id)
    chosen = np.zeros(count, dtype=bool)
    chosen[:: max(-(-count // _MOST_POINTS), 1)] = True
    points = _compared(rasters, epoch, crs, chosen)
    level = points.relief_m <= points.step_m
    place_m = crs.horizontal_unit * points.plan[level]
    if len(place_m) < _IN_BLOCK:
        return 0.0
    area_m2 = float(np.prod(np.ptp(place_m, axis=0)))
    side_m = np.sqrt(area_m2 * _IN_BLOCK / len(place_m))
    return slow_error_m(place_m, points.off_m[level], np.full(2, side_m))


def _about(epoch: Epoch, crs: PointCrs) -> FloatArray:
    """Return the places (K, 2) of all tie points of a date before their intersection, to centimetres."""
    solved, origin = Solved(epoch.posterior, epoch.survey.origin_on_earth), epoch.survey.origin_on_earth
    return np.asarray(crs.xyz_from_lla(lla_from_enu(solved.point_in_geo, origin))[:, :2])


def _compared(rasters: EpochRasters, epoch: Epoch, crs: PointCrs, chosen: BoolArray) -> _Compared:
    """Return the `chosen` (K,) tie points of a date against its raster of heights, where it is known."""
    solved, origin = Solved(epoch.posterior, epoch.survey.origin_on_earth), epoch.survey.origin_on_earth
    place = crs.xyz_from_lla(lla_from_enu(solved.tracks(epoch.posterior.sparse.point_id[chosen])[0], origin))
    step = _AROUND_CELLS * max(rasters.frame.step_x, rasters.frame.step_y)
    around = step * np.stack(np.meshgrid([0.0, -1.0, 1.0], [0.0, -1.0, 1.0]), axis=-1).reshape(-1, 1, 2)
    heights = sampled_raster(rasters.folder / rasters.names[0], (place[:, :2] + around).reshape(-1, 2))
    heights = heights.reshape(len(around), len(place))
    known = np.isfinite(heights).all(axis=0)
    heights, place = heights[:, known], place[known]
    off, relief = heights[0] - place[:, 2], np.ptp(heights, axis=0)
    return _Compared(place[:, :2], rasters.unit_m * off, rasters.unit_m * relief, crs.horizontal_unit * step)
