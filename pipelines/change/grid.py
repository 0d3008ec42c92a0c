"""Rasters of both epochs on one grid, in windows: difference, its variance, and the σ of the datum.

The height of a cell beside a wall is that of either side, by a small error in the plan. Its error is therefore as
large as the relief of its neighbourhood, and so is that of a cell whose height is interpolated between a roof and
the ground. Such cells have a variance of their own (`step_variance`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.ndimage import binary_erosion, map_coordinates, maximum_filter, minimum_filter

from pipelines.change.datum import Epoch, Shared
from pipelines.change.detection import LAGS, STEEPEST, Cells, Noise, Samples
from pipelines.change.tied import Tied
from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.formats.geotiff import RasterFrame, cells_inside, is_same_crs, raster_frame, read_onto
from pipelines.geodesy.crs import PointCrs, parse_crs

if TYPE_CHECKING:
    import shapely

WINDOW_PX = 1024
MEASURED = 255  # in measured.tif
UNCHANGED, LOWERED, RAISED, DOUBTFUL = 1, 2, 3, 4  # in significant.tif; 0: not measured in both
_NODE_PX = 64
_SAMPLES = 400_000
_PAIRS = 40_000  # of each distance
_FINER = 1.5  # cells of the other raster in one of the grid, from which they are averaged
_SEED = 20260101
_MARGIN = 24  # cells around a window, in which an interpolated part is seen whole
_MOST_REACH = 4  # cells, of an error in the plan
_RIM = 2  # cells beside ground that a date has not measured, which may lie on either side of a wall that none shows
_NOISE_RANGE = 6.0  # σ between the highest and the lowest of a neighbourhood of level cells, at most


@dataclass(frozen=True)
class EpochRasters:
    """Rasters of one epoch: heights, their σ, and what is measured; heights times `unit_m` are metres."""

    folder: Path
    of: Literal["surface", "terrain"]
    frame: RasterFrame
    sidecar: CrsSidecar
    unit_m: float

    @property
    def names(self) -> tuple[str, str]:
        return ("dsm.tif", "sigma_v.tif") if self.of == "surface" else ("dtm.tif", "sigma_dtm.tif")


def epoch_rasters(workspace: Workspace, of: Literal["surface", "terrain"]) -> EpochRasters:
    """Return the rasters of a workspace; a MissingProductError names the command that makes them."""
    folder = workspace.root / "raster"
    name = "dsm.tif" if of == "surface" else "dtm.tif"
    path = folder / name
    if not path.exists():
        command = f"georef export-raster {workspace.root}" + (" --terrain" if of == "terrain" else "")
        raise MissingProductError(f"raster/{name}", command)
    sidecar = load_json(CrsSidecar, sidecar_path(path))
    if not sidecar.crs_wkt:
        message = "is in a local metric frame, without a place on Earth that two epochs could share."
        raise InputError("not-on-earth", message, path=path)
    crs = parse_crs(sidecar.crs_wkt, path=path)
    if crs.is_geographic:
        message = "has cells in degrees, in which no volume can be stated."
        remedy = "Export both with --crs of a map projection."
        raise InputError("change-needs-projected-crs", message, path=path, remedy=remedy)
    return EpochRasters(folder, of, raster_frame(path), sidecar, crs.height_unit_m)


@dataclass(frozen=True)
class GridWindow:
    """Window of the grid by first column and row, with its cells."""

    column: int
    row: int
    columns: int
    rows: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the grid."""
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)


class CommonGrid:
    """Cells that both epochs cover, as large as the larger ones of both.

    Args:
        rasters, epochs: the earlier, then the later.
        inside: polygon in the CRS outside which nothing counts; None: everything does.
        tied: the points in common that tie both; None: nothing does.

    Raises:
        InputError: the rasters have different CRS or datums of heights, or do not overlap.
    """

    def __init__(
        self,
        rasters: tuple[EpochRasters, EpochRasters],
        epochs: tuple[Epoch, Epoch],
        shared: Shared,
        inside: shapely.Geometry | None = None,
        tied: Tied | None = None,
    ) -> None:
        self.rasters, self.epochs, self._shared, self._inside = rasters, epochs, shared, inside
        self._tied = tied
        self.frame = _common_frame(*rasters)
        self.crs: PointCrs = parse_crs(rasters[1].sidecar.crs_wkt)
        self.unit_m = self.crs.horizontal_unit
        rows, columns = (
            np.linspace(0, size, size // _NODE_PX + 2) for size in (self.frame.rows, self.frame.columns)
        )
        row, column = np.meshgrid(rows, columns, indexing="ij")
        plan = np.column_stack(
            [
                self.frame.west + column.ravel() * self.frame.step_x,
                self.frame.north - row.ravel() * self.frame.step_y,
            ]
        )
        self._steps = rows[1] - rows[0], columns[1] - columns[0]
        *of_epochs, joint = self.datum_variances(plan)
        self._node_variance = [one[:, 2].reshape(row.shape) for one in of_epochs]
        self._node_datum = np.sqrt(joint[:, 2]).reshape(row.shape)
        self._node_h = joint[:, :2].mean(axis=1).reshape(row.shape)
        self.datum_v_m = float(np.sqrt(np.median(joint[:, 2])))
        self.datum_h_m = float(np.sqrt(np.median(joint[:, :2])))

    def datum_variances(self, plan: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the variances (N, 3) east, north, up in m² of both datums and of their difference, at (N, 2)."""
        before, after = (epoch.variance_at(self.crs, plan) for epoch in self.epochs)
        if self._tied is not None:
            return before, after, self._tied.variance_at(self.crs, plan)
        return before, after, self._shared.of_difference(before, after)

    @property
    def cell_m(self) -> float:
        return float(np.sqrt(self.cell_m2))

    @property
    def cell_m2(self) -> float:
        return self.frame.step_x * self.frame.step_y * self.unit_m**2

    def windows(self) -> Iterator[GridWindow]:
        for row in range(0, self.frame.rows, WINDOW_PX):
            for column in range(0, self.frame.columns, WINDOW_PX):
                yield GridWindow(
                    column,
                    row,
                    min(WINDOW_PX, self.frame.columns - column),
                    min(WINDOW_PX, self.frame.rows - row),
                )

    def around(self, window: GridWindow, reach: int) -> tuple[GridWindow, tuple[slice, slice]]:
        """Return a window widened as far as the grid goes, and the place of the first in it."""
        left, top = max(window.column - reach, 0), max(window.row - reach, 0)
        columns = min(window.column + window.columns + reach, self.frame.columns) - left
        rows = min(window.row + window.rows + reach, self.frame.rows) - top
        core = (
            slice(window.row - top, window.row - top + window.rows),
            slice(window.column - left, window.column - left + window.columns),
        )
        return GridWindow(left, top, columns, rows), core

    def part(self, window: GridWindow) -> RasterFrame:
        return self.frame.part(window.column, window.row, window.columns, window.rows)

    def place_m(self, window: GridWindow) -> FloatArray:
        """Return the places (H, W, 2) of cells, east and north of the middle of the grid."""
        x = (window.column + np.arange(window.columns) + 0.5 - self.frame.columns / 2) * self.frame.step_x
        y = (self.frame.rows / 2 - window.row - np.arange(window.rows) - 0.5) * self.frame.step_y
        return np.stack(np.meshgrid(x, y), axis=-1) * self.unit_m

    def heights_m(self, window: GridWindow) -> tuple[FloatArray, FloatArray]:
        """Return the heights (H, W) of both epochs, where both have some, measured or not; NaN elsewhere.

        Heights on the rim of what is known do not count: a wall that ends there cannot be seen.
        """
        wide, core = self.around(window, _RIM)
        frame = self.part(window)
        heights = [self._read(one, one.names[0], self.part(wide)) * one.unit_m for one in self.rasters]
        known = np.isfinite(heights[0]) & np.isfinite(heights[1])
        known = binary_erosion(known, np.ones((3, 3)), _RIM, border_value=1)[core]
        heights = [height[core] for height in heights]
        if self._inside is not None:
            known &= cells_inside(self._inside, frame)
        return np.where(known, heights[0], np.nan), np.where(known, heights[1], np.nan)

    def cells(self, window: GridWindow) -> Cells:
        """Return the cells of a window, before any registration."""
        wide, core = self.around(window, _MARGIN)
        heights = self.heights_m(wide)
        reach = int(np.clip(np.ceil(2 * self.datum_h_m / self.cell_m), 1, _MOST_REACH))
        variance, step = np.zeros(heights[0][core].shape), np.zeros(heights[0][core].shape)
        slopes, both = [], np.ones(step.shape, dtype=bool)
        for one, node, height in zip(self.rasters, self._node_variance, heights, strict=True):
            sigma = self._read(one, one.names[1], self.part(wide))
            noise = np.maximum(np.nan_to_num(sigma**2 - self._between(node, wide)), 0.0)
            measured = self._measured(one, self.part(wide))
            beside = step_variance(height, np.where(measured, np.sqrt(noise), 0.0), self.cell_m, reach)
            # The σ of an interpolated cell is that of its interpolation.
            step = np.maximum(step, np.where(measured, beside, noise)[core])
            variance += np.where(measured, noise, 0.0)[core]
            both &= measured[core]
            # On the rim of what is known, the slope is not: such a cell counts as steep.
            slope = self._slope(height)[core]
            slopes.append(np.where(np.isfinite(slope), slope, 2 * STEEPEST))
        # Either surface may be steep here. What is steeper yet is a step.
        square = np.minimum(np.maximum(*(np.sum(slope**2, axis=-1) for slope in slopes)), STEEPEST**2)
        for one in self.rasters:  # A height lies somewhere in its cell.
            variance += square * one.frame.step_x * one.frame.step_y * self.unit_m**2 / 12
        variance += square * self._between(self._node_h, window) + (0.1 * self.cell_m) ** 2
        difference = (heights[1] - heights[0])[core]
        datum = np.where(np.isfinite(difference), self._between(self._node_datum, window), np.nan)
        return Cells(difference, variance, datum, slopes[0], step, both)

    def registered(self, window: GridWindow, noise: Noise, *, applied: bool) -> Cells:
        """Return the cells of a window, after the registration if that is applied, with the σ neighbours share."""
        cells = self.cells(window)
        if not applied:
            return replace(cells, datum_m=np.maximum(cells.datum_m, noise.long_range_m))
        moved = noise.moved_by(cells.slope, self.place_m(window))
        datum = np.hypot(np.sqrt(noise.shift_cov_m2[2, 2]), noise.long_range_m)
        shape = cells.difference_m.shape
        return replace(cells, difference_m=cells.difference_m - moved, datum_m=np.full(shape, datum))

    def _slope(self, height_m: FloatArray) -> FloatArray:
        if min(height_m.shape) < 2:
            return np.zeros((*height_m.shape, 2))
        south, east = np.gradient(height_m, self.frame.step_y * self.unit_m, self.frame.step_x * self.unit_m)
        return np.stack([east, -south], axis=-1)

    def samples(self, stable: shapely.Geometry | None, progress: Progress) -> Samples:
        """Return samples of cells, and of pairs of them; only in a polygon of stable ground, if there is one."""
        rng = np.random.default_rng(_SEED)
        windows = list(self.windows())
        each = max(_SAMPLES // len(windows), 500)
        each_pair = max(_PAIRS // len(windows), 50)
        samples: list[tuple[FloatArray, ...]] = []
        pairs: dict[int, list[FloatArray]] = {lag: [] for lag in LAGS}
        designs: dict[int, list[FloatArray]] = {lag: [] for lag in LAGS}
        with progress.task("samples", len(windows)) as task:
            for window in windows:
                cells, place = self.cells(window), self.place_m(window)
                counts = cells.is_certain
                if stable is not None:
                    counts &= cells_inside(stable, self.part(window))
                flat = counts & (np.linalg.norm(cells.slope, axis=-1) < STEEPEST)
                index = np.flatnonzero(counts)
                index = rng.choice(index, min(each, len(index)), replace=False)
                row, column = np.unravel_index(index, counts.shape)
                columns = [getattr(cells, one.name) for one in fields(cells)]
                samples.append(tuple(values[row, column] for values in (*columns, place)))
                for lag in LAGS:
                    one, two = _paired(flat, lag, each_pair, rng)
                    if len(one[0]):
                        pairs[lag].append(np.stack([_normalised(cells, one), _normalised(cells, two)], axis=1))
                        designs[lag].append(np.stack([_row(cells, place, one), _row(cells, place, two)], axis=1))
                task.advance()
        *columns, places = (np.concatenate(part) for part in zip(*samples, strict=True))
        return Samples(
            Cells(*columns),
            places,
            {lag: np.concatenate(part) for lag, part in pairs.items() if part},
            {lag: np.concatenate(part) for lag, part in designs.items() if part},
        )

    def _read(self, one: EpochRasters, name: str, frame: RasterFrame) -> FloatArray:
        finer = frame.step_x / one.frame.step_x
        return read_onto(one.folder / name, frame, "average" if finer > _FINER else "bilinear")

    def _measured(self, one: EpochRasters, frame: RasterFrame) -> BoolArray:
        """Return which cells an epoch has measured; of the ground below a surface, all count."""
        if one.of == "terrain":
            return np.ones((frame.rows, frame.columns), dtype=bool)
        return np.asarray(read_onto(one.folder / "measured.tif", frame, "nearest") == MEASURED)

    def _between(self, nodes: FloatArray, window: GridWindow) -> FloatArray:
        row = (window.row + np.arange(window.rows) + 0.5) / self._steps[0]
        column = (window.column + np.arange(window.columns) + 0.5) / self._steps[1]
        return np.asarray(map_coordinates(nodes, np.meshgrid(row, column, indexing="ij"), order=1, mode="nearest"))


def step_variance(height_m: FloatArray, sigma_m: FloatArray, cell_m: float, reach: int) -> FloatArray:
    """Return the variance (H, W) in m² of heights beside steps; 0: elsewhere.

    An error of up to `reach` cells in the plan changes a height by any value up to the relief of its neighbourhood:
    the variance is that of the uniform distribution. What the slope and the noise explain is no relief.

    Args:
        height_m: (H, W); NaN: not known.
        sigma_m: (H, W) noise of the heights.
    """
    known = np.isfinite(height_m)
    low, high = np.where(known, height_m, np.inf), np.where(known, height_m, -np.inf)
    size = 2 * reach + 1
    relief = maximum_filter(high, size) - minimum_filter(low, size)
    # Along an axis, a slope explains what both neighbours agree on; beyond 45° it is a step.
    explained = np.zeros(height_m.shape)
    for axis in (0, 1):
        rise = np.diff(height_m, axis=axis, prepend=np.nan), np.diff(height_m, axis=axis, append=np.nan)
        least = np.minimum(*np.abs(np.nan_to_num(rise)))
        explained += np.where(rise[0] * rise[1] > 0, np.minimum(least, STEEPEST * cell_m), 0.0)
    relief = np.maximum(relief - 2 * reach * explained - _NOISE_RANGE * sigma_m, 0.0)
    return np.asarray(np.where(known, np.nan_to_num(relief, posinf=0.0, neginf=0.0) ** 2 / 3, 0.0))


def _common_frame(before: EpochRasters, after: EpochRasters) -> RasterFrame:
    path = before.folder / before.names[0]
    if not is_same_crs(before.frame, after.frame):
        message = f"is in {before.sidecar.crs}, and that of the later epoch in {after.sidecar.crs}."
        remedy = "Export both with the same --crs."
        raise InputError("epochs-differ-in-crs", message, path=path, remedy=remedy)
    datums = before.sidecar.vertical_datum.name, after.sidecar.vertical_datum.name
    if datums[0] != datums[1]:
        message = f"has heights above {datums[0]}, the later epoch above {datums[1]}."
        remedy = "Export both with one --vertical."
        raise InputError("epochs-differ-in-heights", message, path=path, remedy=remedy)
    coarser = max(before.frame, after.frame, key=lambda frame: frame.step_x)
    bounds = np.array([before.frame.bounds, after.frame.bounds])
    west, south = bounds[:, :2].max(axis=0).tolist()
    east, north = bounds[:, 2:].min(axis=0).tolist()
    left, top = np.ceil((west - coarser.west) / coarser.step_x), np.ceil((coarser.north - north) / coarser.step_y)
    columns = int((east - coarser.west) / coarser.step_x - left)
    rows = int((coarser.north - south) / coarser.step_y - top)
    if columns < 1 or rows < 1:
        raise InputError("epochs-apart", "does not overlap the raster of the later epoch.", path=path)
    return coarser.part(int(left), int(top), columns, rows)


Index = tuple[Any, Any]


def _paired(flat: BoolArray, lag: int, count: int, rng: np.random.Generator) -> tuple[Index, Index]:
    """Return up to `count` pairs of level cells that lie `lag` cells apart, along rows and columns."""
    ones, twos = [], []
    for axis in (0, 1):
        if flat.shape[axis] <= lag:
            continue
        near, far = (flat[:-lag], flat[lag:]) if axis == 0 else (flat[:, :-lag], flat[:, lag:])
        row, column = np.nonzero(near & far)
        chosen = rng.choice(len(row), min(count // 2, len(row)), replace=False)
        row, column = row[chosen], column[chosen]
        ones.append((row, column))
        twos.append((row + lag, column) if axis == 0 else (row, column + lag))
    if not ones:
        return (np.zeros(0, int),) * 2, (np.zeros(0, int),) * 2
    first, second = (tuple(np.concatenate(part) for part in zip(*group, strict=True)) for group in (ones, twos))
    return (first[0], first[1]), (second[0], second[1])


def _normalised(cells: Cells, index: Index) -> FloatArray:
    return np.asarray(cells.difference_m[index] / np.sqrt(cells.variance_m2[index]))


def _row(cells: Cells, place_m: FloatArray, index: Index) -> FloatArray:
    """Return rows (K, 6) of the design of shift and tilt, and the σ of each cell."""
    one = np.ones(len(index[0]))
    return np.column_stack([one, -cells.slope[index], place_m[index], np.sqrt(cells.variance_m2[index])])
