"""Regions that have changed: connected cells, their test, their volumes and their outlines.

A region is found by its core, the cells that change significantly. Its volume includes a rim, in which a change
fades below the level of detection, and the uncertain cells of walls and of interpolated parts. It is real if the
net volume of its core exceeds its σ by more than chance gives among as many places as the scene has independent
errors, and that of the whole exceeds 1.96 σ. Beside unmeasured ground surfaces err by more than their σ says, over
the area in which errors are one: cells so near to it do not tell whether a region is real.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, find_objects, label
from scipy.special import erfc

from pipelines.change.detection import QUANTILE_95, Cells, Noise, Volume, region_volumes
from pipelines.change.grid import CommonGrid, GridWindow
from pipelines.core.types import AnyArray, BoolArray, FloatArray, IntArray
from pipelines.formats.geotiff import cells_inside, outlines, read_cells, write_part
from pipelines.survey.change_report import ChangedRegion, DoubtfulRegion
from pipelines.survey.measured_ground import distance_to_others

CELLS = ("difference", "datum", "variance", "step")  # parts that volumes are made of
_LEAST_REACH, _MOST_REACH = 2, 10  # cells
_CHANCE = 0.05  # that noise alone makes a region anywhere
_LEAST_KNOWN = 0.25  # of a given polygon: what is known of less lies along walls that no date shows whole


@dataclass(frozen=True)
class RasterParts:
    """Parts of the rasters, one a window, in a scratch folder."""

    folder: Path
    grid: CommonGrid

    def path(self, name: str, window: GridWindow) -> Path:
        return self.folder / f"{name}_{window.row}_{window.column}.tif"

    def write(self, name: str, window: GridWindow, values: AnyArray) -> None:
        write_part(self.path(name, window), values[None], self.grid.part(window))

    def cells(self, window: GridWindow) -> Cells:
        """Return the cells of a window after the registration, as volumes need them."""
        difference, datum, variance, step = (
            read_cells(self.path(name, window))[0].astype(np.float64) for name in CELLS
        )
        return Cells(difference, variance, datum, np.zeros(0), step, self.measured(window))

    def measured(self, window: GridWindow) -> BoolArray:
        """Return which cells of a window both epochs have measured."""
        return np.asarray(read_cells(self.path("measured", window))[0] > 0)


@dataclass(frozen=True)
class FoundRegions:
    """Regions with their polygons in the CRS, those of the user first, and the sign (H, W) of cells in cores.

    `lowered`, `raised` and `every` are the sums of those that were found. `number` (H, W) is the place in
    `regions`, counted from 1, of the region in whose core a cell lies; 0: in none. `unmeasured` has the
    known share by the name of given polygons that are no regions, as hardly any of them is known.
    """

    regions: tuple[ChangedRegion, ...]
    lowered: ChangedRegion
    raised: ChangedRegion
    every: ChangedRegion
    polygons: list[Any]
    sign: NDArray[np.int8]
    number: NDArray[np.int32]
    volumes: tuple[Volume, ...]
    unmeasured: Mapping[str, float]


@dataclass(frozen=True)
class DoubtfulRegions:
    """Found regions that count as no change, with their polygons, and whether a cell (H, W) is in one's core."""

    regions: tuple[DoubtfulRegion, ...]
    polygons: list[Any]
    inside: BoolArray


def reach_of(grid: CommonGrid, noise: Noise) -> int:
    """Return how far in cells neighbours of a cell lie."""
    return int(np.clip(round(noise.length_m / grid.cell_m), _LEAST_REACH, _MOST_REACH))


def _rim_of(grid: CommonGrid, noise: Noise) -> float:
    """Return the distance in cells from unmeasured ground up to which the errors are those of its rim."""
    return float(np.sqrt(noise.correlated_m2 / np.pi) / grid.cell_m)


def candidates(
    sign: NDArray[np.int8], measured: BoolArray, cell_m2: float, reach: int, min_area_m2: float
) -> NDArray[np.int32]:
    """Return the number of the region of each cell, 0 for none: connected, of one sign, not too small, with a rim.

    The rim is `reach` cells wide where both epochs have measured (H, W), and two where one has interpolated.
    """
    every = np.zeros(sign.shape, dtype=np.int32)
    count = 0
    for direction in (-1, 1):
        number, parts = label(sign == direction, structure=np.ones((3, 3)), output=np.int32)
        size = np.bincount(number.ravel(), minlength=parts + 1)
        kept = size * cell_m2 >= min_area_m2
        kept[0] = False
        others = sign != -direction
        core = binary_dilation(kept[number], iterations=_LEAST_REACH, mask=others)
        wide = binary_dilation(core, iterations=reach - _LEAST_REACH + 1, mask=(others & measured) | core)
        wide, parts = label(wide, output=np.int32)
        free = (every == 0) & (wide > 0)
        every[free] = wide[free] + count
        count += parts
    return every


def is_real(net_m3: FloatArray, sigma_m3: FloatArray, places: float) -> BoolArray:
    """Return which of the net volumes (R,) are no chance: in 95 % of scenes with so many places, none is false."""
    beyond = np.abs(net_m3) / np.maximum(sigma_m3, 1e-12)
    return np.asarray(erfc(beyond / np.sqrt(2)) * max(places, 1.0) <= _CHANCE)


def find_regions(
    parts: RasterParts,
    sign: NDArray[np.int8],
    noise: Noise,
    given: tuple[shapely.Geometry, ...],
    min_area_m2: float,
) -> FoundRegions:
    """Return the regions of the given polygons, then those found in significant cells of `sign` (H, W)."""
    grid = parts.grid
    measured = np.zeros(sign.shape, dtype=bool)
    for window in grid.windows():
        measured[window.slices] = parts.measured(window)
    number = candidates(sign, measured, grid.cell_m2, reach_of(grid, noise), min_area_m2)
    count = int(number.max(initial=0))
    whole, cores, of_given = ([Volume() for _ in range(size)] for size in (count, count, len(given)))
    # Ground beyond the rasters is not measured.
    telling = (sign != 0) & (distance_to_others(np.pad(measured, 1))[1:-1, 1:-1] > _rim_of(grid, noise))
    for window in grid.windows():
        cells = parts.cells(window)
        inside = number[window.slices]
        core = np.where(telling[window.slices], inside, 0)
        of_window = region_volumes(inside, cells, count), region_volumes(core, cells, count)
        whole, cores = (
            [one + two for one, two in zip(sums, more, strict=True)]
            for sums, more in zip((whole, cores), of_window, strict=True)
        )
        for rank, polygon in enumerate(given):
            of_polygon = cells_inside(polygon, grid.part(window)).astype(np.int64)
            of_given[rank] += region_volumes(of_polygon, cells, 1)[0]
    of_given = [
        replace(one, missing=max(round(polygon.area / grid.frame.step_x / grid.frame.step_y) - one.cells, 0))
        for one, polygon in zip(of_given, given, strict=True)
    ]
    share = {f"P{rank}": one.known_share for rank, one in enumerate(of_given, start=1)}
    is_region = [known >= _LEAST_KNOWN for known in share.values()]
    names, polygons = list(compress(share, is_region)), list(compress(given, is_region))
    net, sigma, net_of_core, sigma_of_core = (
        np.array(values)
        for sums in (whole, cores)
        for values in (
            [(one.fill - one.cut) * grid.cell_m2 for one in sums],
            [one.sigma_m3(noise, grid.cell_m2, to_detect=True) for one in sums],
        )
    )
    # A region is as large as its errors at least, so that more of them are no further chance.
    errors = float(measured.sum()) * grid.cell_m2 / max(noise.correlated_m2, min_area_m2)
    kept = np.flatnonzero(is_real(net_of_core, sigma_of_core, errors) & (np.abs(net) > QUANTILE_95 * sigma))
    kept = kept[np.argsort(-np.abs(net[kept]), kind="stable")]
    places = find_objects(number)
    for index in kept.tolist():
        polygons.append(_outline(number, index + 1, places[index], grid))
    of_place = np.zeros(count + 1, dtype=np.int32)
    of_place[kept + 1] = len(names) + 1 + np.arange(len(kept))
    in_cores = np.where(sign != 0, of_place[number], 0).astype(np.int32)
    return _named(
        (*compress(of_given, is_region), *(whole[index] for index in kept.tolist())),
        polygons,
        given=names,
        sign=np.where(in_cores > 0, sign, 0),
        number=in_cores,
        noise=noise,
        cell_m2=grid.cell_m2,
        unmeasured={name: known for name, known in share.items() if known < _LEAST_KNOWN},
    )


def without_doubtful(
    found: FoundRegions, doubtful: Mapping[int, str], noise: Noise, cell_m2: float
) -> tuple[FoundRegions, DoubtfulRegions]:
    """Return the regions that count, and those at some places of `found`, which do not, each for a reason."""
    out = sorted(doubtful)
    kept = [index for index in range(len(found.regions)) if index not in doubtful]
    moved = np.zeros(len(found.regions) + 1, dtype=np.int32)
    moved[np.array(kept, dtype=np.int64) + 1] = 1 + np.arange(len(kept))
    number, inside = moved[found.number], np.isin(found.number, np.array(out, dtype=np.int64) + 1)
    remaining = _named(
        tuple(found.volumes[index] for index in kept),
        [found.polygons[index] for index in kept],
        given=[found.regions[index].name for index in kept if found.regions[index].name.startswith("P")],
        sign=np.where(number > 0, found.sign, 0),
        number=number,
        noise=noise,
        cell_m2=cell_m2,
        unmeasured=found.unmeasured,
    )
    regions = tuple(
        DoubtfulRegion(**found.regions[index].model_dump() | {"name": f"D{rank}"}, reason=doubtful[index])
        for rank, index in enumerate(out, start=1)
    )
    return remaining, DoubtfulRegions(regions, [found.polygons[index] for index in out], inside)


def _named(
    every: tuple[Volume, ...],
    polygons: list[shapely.Geometry],
    *,
    given: Sequence[str],
    sign: IntArray | NDArray[np.int8],
    number: NDArray[np.int32],
    noise: Noise,
    cell_m2: float,
    unmeasured: Mapping[str, float],
) -> FoundRegions:
    """Return regions by their volumes, of which the first are those of `given` polygons, with the others' sums."""
    of_found = every[len(given) :]
    names = [*given, *(f"R{index + 1}" for index in range(len(of_found)))]
    sums = {
        "lowered": [one for one in of_found if one.fill < one.cut],
        "raised": [one for one in of_found if one.fill > one.cut],
        "every": list(of_found),
    }
    lowered, raised, total = (region_of(name, sum(parts, Volume()), noise, cell_m2) for name, parts in sums.items())
    regions = tuple(region_of(name, one, noise, cell_m2) for name, one in zip(names, every, strict=True))
    return FoundRegions(regions, lowered, raised, total, polygons, sign.astype(np.int8), number, every, unmeasured)


def _outline(number: IntArray | NDArray[np.int32], which: int, box: tuple[slice, slice], grid: CommonGrid) -> Any:
    rows, columns = box
    cells = number[rows, columns] == which
    frame = grid.frame.part(columns.start, rows.start, cells.shape[1], cells.shape[0])
    return shapely.union_all(outlines(cells, frame))


def region_of(name: str, volume: Volume, noise: Noise, cell_m2: float) -> ChangedRegion:
    """Return the record of a region from the sums of its cells."""
    return ChangedRegion(
        name=name,
        area_m2=volume.cells * cell_m2,
        cut_m3=volume.cut * cell_m2,
        fill_m3=volume.fill * cell_m2,
        net_m3=(volume.fill - volume.cut) * cell_m2,
        sigma_m3=volume.sigma_m3(noise, cell_m2),
        lowest_m=volume.lowest,
        highest_m=volume.highest,
        known_share=volume.known_share,
    )
