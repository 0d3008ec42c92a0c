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
from pipelines.core.types import FloatArray
from pipelines.formats.geotiff import sampled_raster
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.survey.change_report import ChangedRegion

_LEAST_POINTS = 3  # in a region, of which one may be wrong
_HALF = 0.5  # of a region's mean change: if the surfaces' own errors are more, it is theirs
_AROUND_CELLS = 2.0  # of a point, where the surface has to be unbroken: a wall's points lie beneath the roof's edge
_MARGIN_M = 2.0  # by which the adjustment may move points


@dataclass(frozen=True)
class _Compared:
    """Tie points of a date: plan (K, 2) in the CRS, surface minus point (K,), and relief (K,) around it, metres."""

    plan: FloatArray
    off_m: FloatArray
    relief_m: FloatArray

    def median_off_m(self, polygon: shapely.Geometry, most_relief_m: float) -> float:
        """Return the median of surface minus point in a polygon; 0: too few points on unbroken ground."""
        inside = shapely.contains_xy(polygon, *self.plan.T) & (self.relief_m <= most_relief_m)
        return float(np.median(self.off_m[inside])) if inside.sum() >= _LEAST_POINTS else 0.0


def contradicted_by_own_points(
    grid: CommonGrid, regions: Sequence[ChangedRegion], polygons: Sequence[shapely.Geometry]
) -> tuple[int, ...]:
    """Return the places of the found regions of which tie points explain more than half, as an error of a surface.

    Polygons are in the plan of the CRS.
    """
    found = [index for index, region in enumerate(regions) if region.name.startswith("R")]
    if not found:
        return ()
    near = shapely.union_all([polygons[index] for index in found]).buffer(_MARGIN_M / grid.unit_m)
    dates = [_compared(*date, grid.crs, near) for date in zip(grid.rasters, grid.epochs, strict=True)]
    contradicted = []
    for index in found:
        mean_m = regions[index].net_m3 / regions[index].area_m2
        relief_m = max(_HALF * abs(mean_m), _AROUND_CELLS * grid.cell_m)
        before, after = (date.median_off_m(polygons[index], relief_m) for date in dates)
        if abs(mean_m - (after - before)) < _HALF * abs(mean_m):
            contradicted.append(index)
    return tuple(contradicted)


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
    return _Compared(
        place[:, :2], rasters.unit_m * (heights[0] - place[:, 2]), rasters.unit_m * np.ptp(heights, axis=0)
    )
