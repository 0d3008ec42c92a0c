"""Surfaces against the tie points of their own date: where these contradict a surface, it has not changed.

The photographs of a date know a place twice, by the tie points that the adjusted cameras intersect, and by the
surface. Where few photographs see the ground, as at the rim of a survey, a surface may lie decimetres beside the
points. What it then differs from the other date's is the error of one surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from pipelines.adjust.relative import Solved
from pipelines.change.datum import Epoch
from pipelines.change.grid import CommonGrid, EpochRasters
from pipelines.change.tied import Surfaces, least_of_witness_m
from pipelines.core.types import FloatArray
from pipelines.formats.geotiff import sampled_raster
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.survey.change_report import ChangedRegion

_LEAST_POINTS = 2  # of a date in a region
_HALF = 0.5  # of a change: if a surface's own error is more, the change is its error
_AROUND_CELLS = 2.0  # of a point, where the surface has to be unbroken: a wall's points lie beneath the roof's edge
_MARGIN_M = 2.0  # by which the adjustment may move points


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
    before, after = (_compared(*date, grid.crs, near) for date in zip(grid.rasters, grid.epochs, strict=True))

    def is_contradicted(index: int) -> bool:
        polygon, least_m = polygons[index], least_of_witness_m(regions[index])
        return after.explain(polygon, surfaces, 1.0, least_m) or before.explain(polygon, surfaces, -1.0, least_m)

    return tuple(index for index in found if is_contradicted(index))


def _compared(rasters: EpochRasters, epoch: Epoch, crs: PointCrs, near: shapely.Geometry) -> _Compared:
    """Return the tie points of a date in an area against its raster of heights."""
    solved, origin = Solved(epoch.posterior, epoch.survey.origin_on_earth), epoch.survey.origin_on_earth
    about = crs.xyz_from_lla(lla_from_enu(solved.point_in_geo, origin))
    shapely.prepare(near)
    ids = epoch.posterior.sparse.point_id[shapely.contains_xy(near, about[:, 0], about[:, 1])]
    place = crs.xyz_from_lla(lla_from_enu(solved.tracks(ids)[0], origin))
    step = _AROUND_CELLS * max(rasters.frame.step_x, rasters.frame.step_y)
    around = step * np.stack(np.meshgrid([0.0, -1.0, 1.0], [0.0, -1.0, 1.0]), axis=-1).reshape(-1, 1, 2)
    heights = sampled_raster(rasters.folder / rasters.names[0], (place[:, :2] + around).reshape(-1, 2))
    heights = heights.reshape(len(around), len(place))
    known = np.isfinite(heights).all(axis=0)
    heights, place = heights[:, known], place[known]
    off, relief = heights[0] - place[:, 2], np.ptp(heights, axis=0)
    return _Compared(place[:, :2], rasters.unit_m * off, rasters.unit_m * relief, crs.horizontal_unit * step)
