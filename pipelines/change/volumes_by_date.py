"""Volumes by date along a chain of tied dates: in each region, since the first date, and since the one before.

The regions are those of the comparison of both ends, and the polygons of the user. Each pair of dates is compared
with its own noise, so that a volume and its σ are those that `georef change` of the pair would state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.change.datum import shared_by
from pipelines.change.detection import Volume, region_volumes
from pipelines.change.grid import CommonGrid, epoch_rasters
from pipelines.change.options import ChangeOptions
from pipelines.change.own_points import noise_of
from pipelines.change.regions import FoundRegions, region_of
from pipelines.change.tied import Tied
from pipelines.core.errors import GeorefError
from pipelines.core.products import Remark
from pipelines.core.progress import Progress
from pipelines.formats.geotiff import cells_inside
from pipelines.geodesy.crs import PointCrs
from pipelines.report.cover import days_of
from pipelines.survey.change_report import ChangedRegion, DateOfChange, RegionAtDate

ALL = "all"  # found regions together


@dataclass(frozen=True)
class Ground:
    """Where dates are compared: area and unchanged ground as polygons in the CRS of the rasters; None: any."""

    crs: PointCrs
    area: Any
    stable: Any


def volumes_by_date(
    tied: Tied, found: FoundRegions, ground: Ground, options: ChangeOptions, progress: Progress
) -> tuple[tuple[DateOfChange, ...], tuple[Remark, ...]]:
    """Return the volumes at each date after the first, and a warning of each date that cannot be compared.

    Without dates between both ends there is no table: it would repeat the regions.
    """
    dates = tied.dates
    if len(dates) < 3 or not found.regions:
        return (), ()
    pairs = _Pairs(tied, found, ground, options, progress)
    middles = np.array([[polygon.centroid.x, polygon.centroid.y] for polygon in found.polygons])
    made: list[DateOfChange] = []
    warnings = []
    previous = 0
    for index in range(1, len(dates)):
        name = dates[index].workspace.root.name
        try:
            volume = pairs.of_found if index == len(dates) - 1 else pairs.between(0, index)
            step = pairs.between(previous, index) if previous > 0 else volume
        except GeorefError as error:
            sentence = f"{name} is not in the table of volumes by date: {error.fault}"
            warnings.append(Remark(code="date-left-out", sentence=sentence, remedy=error.remedy))
            continue
        previous = index
        variance = tied.between(0, index).variance_at(ground.crs, middles)[:, 2]
        regions = tuple(
            RegionAtDate(
                name=one.name,
                net_m3=one.net_m3,
                sigma_m3=one.sigma_m3,
                since_previous_m3=since.net_m3,
                sigma_since_previous_m3=since.sigma_m3,
            )
            for one, since in zip(volume, step, strict=True)
        )
        days = days_of(image.timestamp_s for image in dates[index].epoch.survey.images)
        sigma_v_m = float(np.sqrt(np.median(variance)))
        made.append(DateOfChange(name=name, taken_on=days, sigma_v_m=sigma_v_m, regions=regions))
    return tuple(made) if len(made) > 1 else (), tuple(warnings)


@dataclass(frozen=True)
class _Pairs:
    """Comparisons of pairs of dates in the regions of that of both ends."""

    tied: Tied
    found: FoundRegions
    ground: Ground
    options: ChangeOptions
    progress: Progress

    @property
    def of_found(self) -> list[ChangedRegion]:
        """Regions of both ends, and the sum of those that were found."""
        return [*self.found.regions, self.found.every.model_copy(update={"name": ALL})]

    def between(self, first: int, last: int) -> list[ChangedRegion]:
        """Return the regions with their volumes between two dates, and the sum of those that were found.

        Raises:
            GeorefError: a date has no rasters, or such that cannot be compared.
        """
        options, ends = self.options, (self.tied.dates[first], self.tied.dates[last])
        before, after = (epoch_rasters(one.workspace, options.of) for one in ends)
        epochs = ends[0].epoch, ends[1].epoch
        shared = shared_by(epochs[0].survey, epochs[1].survey, same_base=options.same_base)
        grid = CommonGrid((before, after), epochs, shared, self.ground.area, self.tied.between(first, last))
        noise = noise_of(grid, self.ground.stable, self.progress, with_tilt=options.tilt)
        sums = [Volume() for _ in self.found.polygons]
        for window in grid.windows():
            cells, frame = grid.registered(window, noise, applied=options.is_registered), grid.part(window)
            for index, polygon in enumerate(self.found.polygons):
                sums[index] += region_volumes(cells_inside(polygon, frame).astype(np.int64), cells, 1)[0]
        names = [region.name for region in self.found.regions]
        every = sum((one for one, name in zip(sums, names, strict=True) if name.startswith("R")), Volume())
        named = zip((*names, ALL), (*sums, every), strict=True)
        return [region_of(name, one, noise, grid.cell_m2) for name, one in named]
