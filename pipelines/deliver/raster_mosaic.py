"""Rasters of the stage, window by window: rendered into parts, made whole inside the area, then put together.

A whole window has what is measured, inside the area what is interpolated, and the ground below.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, label

from pipelines import __version__
from pipelines.core.json_values import Json
from pipelines.core.progress import Progress
from pipelines.core.types import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from pipelines.deliver.bands import Bands
from pipelines.deliver.photo_colours import MARGIN, CellColours, PhotoColours
from pipelines.deliver.raster_window import (
    PAINTED,
    RasterSource,
    between_nodes,
    georeference_sigma_maps,
    places_in_geo,
    render_window,
)
from pipelines.formats.georef_sidecar import CrsSidecar
from pipelines.formats.geotiff import (
    Band,
    RasterFrame,
    RasterKind,
    cells_inside,
    outlines,
    read_cells,
    read_reduced,
    write_mosaic,
    write_part,
    write_vrt,
)
from pipelines.formats.vector_files import feature
from pipelines.surface.filling import FilledCells, fill_cells
from pipelines.surface.ground import GroundModel
from pipelines.survey.measured_ground import MOST_FILLED, MeasuredGround
from pipelines.survey.options import FillWidth
from pipelines.survey.target_crs import TargetCrs

MEASURED, INTERPOLATED = 255, 128  # in `measured.tif`; 0: outside the area, or unknown
# A hole is filled cell by cell up to `_NARROW` cells from its rim, and beyond `REACH` by a coarse raster of the
# whole; between, one goes over into the other.
_NARROW, REACH = 16, 64
_RIM_M = 1.0  # around what stands on the ground, or hides it
_WRONG = 0.1  # share of the heights of the model alone that are wrong, by three simulated flights


@dataclass(frozen=True)
class SeenCells:
    """Measured cells of a window, and of up to `REACH` cells around it (H, W).

    Attributes:
        frame: of these cells.
        in_window: rows and columns of the window among them.
        height: NaN: not measured.
        rgba: (4, H, W); alpha as in `WindowCells`.
        modelled: as in `WindowCells`.
        sigma_h_m, sigma_v_m: of the window's own cells.
        inside: cells in the area of interest.
    """

    frame: RasterFrame
    in_window: tuple[slice, slice]
    height: FloatArray
    rgba: ByteArray
    modelled: FloatArray
    sigma_h_m: FloatArray
    sigma_v_m: FloatArray
    inside: BoolArray


@dataclass(frozen=True)
class CoarseCells:
    """Whole raster at a smaller size, filled, with colours (H, W, 3) of its cells.

    `step` is the number of cells of the raster along the side of one of these.
    """

    cells: FilledCells
    rgb: ByteArray
    step: float

    def at(self, first: tuple[int, int], chosen: BoolArray) -> tuple[NDArray[Any], ...]:
        """Return rows and columns (K,) in it of the chosen cells of a window that begins at a row and column."""
        return tuple(
            np.minimum((start + index) / self.step, size - 1).astype(np.int64)
            for start, index, size in zip(first, np.nonzero(chosen), self.rgb.shape, strict=False)
        )


def whole_cells(
    source: RasterSource, seen: SeenCells, coarse: CoarseCells, first: tuple[int, int]
) -> dict[str, NDArray[Any]]:
    """Return the bands of each raster in a window that begins at a row and column; empty outside the area."""
    here, target = seen.in_window, source.target
    cells = fill_cells(seen.height, seen.inside, REACH, seen.modelled)
    blank = seen.rgba[3][here] == 0
    rgb = np.where(seen.rgba[3] > 0, seen.rgba[:3], seen.rgba[:3].reshape(3, -1)[:, cells.source])[:, *here]
    measured, inside = np.isfinite(seen.height)[here], seen.inside[here]
    height, spread, distance = (
        cells.height[here].copy(),
        cells.sigma[here].copy(),
        cells.distance[here].copy(),
    )
    wide = inside & ~measured & ((distance > _NARROW) | np.isnan(height))
    if wide.any():
        at = coarse.at(first, wide)
        fine = np.clip((REACH - distance[wide]) / (REACH - _NARROW), 0.0, 1.0)
        fine[np.isnan(height[wide])] = 0.0
        for values, wider in ((height, coarse.cells.height), (spread, coarse.cells.sigma)):
            values[wide] = np.where(fine > 0, fine * values[wide], 0.0) + (1 - fine) * wider[at]
        distance[wide] = np.where(fine > 0, distance[wide], coarse.cells.distance[at] * coarse.step)
        rgb[:, wide] = np.where((fine == 0) & blank[wide], coarse.rgb[at].T, rgb[:, wide])
    # The model may know what no view confirms. Where it differs from what lies around, it is wrong one time in ten.
    modelled = seen.modelled[here]
    taken = ~measured & np.isfinite(modelled) & np.isfinite(height)
    spread[taken] = np.sqrt(spread[taken] ** 2 + _WRONG * (modelled[taken] - height[taken]) ** 2)
    height[taken] = modelled[taken]
    known = inside & np.isfinite(height)
    frame = seen.frame.part(here[1].start, here[0].start, known.shape[1], known.shape[0])
    georeference_h, georeference_v = georeference_sigma_maps(source, frame, np.where(known, height, np.nan))
    # What views do not confirm to a training pixel is known no better than that.
    spread_m = np.hypot(spread * target.crs.height_unit_m, source.training_gsd_m)
    # The place of what lies in a hole is as uncertain as the way to its rim is long.
    away_m = distance * frame.step_x * target.horizontal_unit_m
    heights = {
        "dsm": height,
        "sigma_h": np.where(measured, seen.sigma_h_m, np.hypot(georeference_h, away_m)),
        "sigma_v": np.where(measured, seen.sigma_v_m, np.hypot(georeference_v, spread_m)),
    }
    if source.terrain is not None:
        ground, variance_m2 = _ground(source, source.terrain, seen)
        sigma = np.where(variance_m2[here] > 0, np.sqrt(georeference_v**2 + variance_m2[here]), seen.sigma_v_m)
        heights |= {"dtm": ground[here], "sigma_dtm": sigma}
    alpha, mask = np.where(known, 255, 0), np.where(measured, MEASURED, INTERPOLATED) * known
    return {
        "orthophoto": (np.concatenate([rgb, alpha[None]]) * known).astype(np.uint8),
        "measured": mask[None].astype(np.uint8),
        **{name: np.where(known, values, np.nan)[None] for name, values in heights.items()},
    }


def _ground(source: RasterSource, terrain: GroundModel, seen: SeenCells) -> tuple[FloatArray, FloatArray]:
    """Return heights (H, W) of the ground in the CRS, and their variance in m² where it is not the surface; else 0.

    Where the surface is the ground, its cells are taken over. Elsewhere the terrain is, shifted by what the ground
    around lies above it.
    """
    # Twice as dense as the terrain's own cells.
    every = max(int(terrain.cell_m / (2 * seen.frame.step_x * source.target.horizontal_unit_m)), 1)
    nodes = tuple(np.linspace(0, size, size // every + 2) for size in seen.height.shape)
    row, column = np.meshgrid(*nodes, indexing="ij")
    level = source.terrain_level
    cell = np.column_stack([column.ravel(), row.ravel()])
    plan = places_in_geo(source, seen.frame, cell, np.full(len(cell), np.median(level)))[:, :2]
    height, gap_m = (
        between_nodes(terrain.interpolated(values, plan).reshape(row.shape), nodes, seen.height.shape)
        for values in (level, terrain.gap_m)
    )
    above = seen.height - height
    with np.errstate(invalid="ignore"):
        is_ground = np.abs(above) * source.target.crs.height_unit_m <= terrain.limit_m
    # On the rim of what stands there, or hides the ground, cells have mixed heights.
    rim = max(round(_RIM_M / (seen.frame.step_x * source.target.horizontal_unit_m)), 1)
    is_ground = binary_erosion(is_ground, iterations=rim, border_value=1)
    around = fill_cells(np.where(is_ground, above, np.nan), seen.inside, REACH, with_sigma=False)
    share = np.clip(1.0 - around.distance / REACH, 0.0, 1.0)
    height = height + np.where(np.isfinite(around.height), share * around.height, 0.0)
    variance_m2 = terrain.bridged_variance(np.maximum(gap_m, terrain.cell_m / 2))
    return height, np.where(is_ground, 0.0, variance_m2)


_SEEN = ("orthophoto", "dsm", "modelled", "sigma_h", "sigma_v")  # parts of what is measured
_WINDOW_PX = 1536
_SAMPLES_PX = 192  # a side of a window
_OVERVIEW_PX = 4000  # along the longer side, at which islands are looked for
_LEAST_ISLAND = 0.01  # of the largest part of the surface
_COARSE_PX = 1500  # along the longer side, at which wide holes are filled
_WIDER = 16.0  # holes than those that the area has by itself, as far as the rasters' tenth reaches
_OUTLINES_PX = 2000  # along the longer side, at which interpolated parts are outlined

_COLOURS = (
    Band("red", colour="Red"),
    Band("green", colour="Green"),
    Band("blue", colour="Blue"),
    Band("inside the area", colour="Alpha"),
)


@dataclass(frozen=True)
class _Window:
    """Window by its first cell, and the frame of its cells."""

    column: int
    row: int
    frame: RasterFrame


class Mosaic:
    """Rasters over one frame, and the area (a polygon in their CRS) outside which they are empty.

    They are whole inside it with `fill` "all". Else they end where their own measured cells do, which are finer
    than those that the area was found by: holes up to a width of `fill` metres are filled, or, if it is None, the
    narrowest holes up to a tenth of the rasters. Pixels of the photographs are `photo_m` wide on the ground. Parts
    in the folder are kept: `parts` of what is measured, `whole` of the rasters to deliver.
    """

    def __init__(
        self,
        folder: Path,
        frame: RasterFrame,
        target: TargetCrs,
        polygon: shapely.Geometry,
        *,
        has_terrain: bool,
        fill: FillWidth | None,
        photo_m: float,
    ) -> None:
        self.folder, self.frame, self.target, self.polygon = folder, frame, target, polygon
        self._fill, self._photo_m = fill, photo_m
        height = f"height above {target.crs.vertical.name}"
        self._kinds = {
            "orthophoto": RasterKind("uint8", _COLOURS),
            "dsm": RasterKind("float32", (Band(f"surface: {height}", target.crs.height_unit),)),
            "sigma_h": RasterKind("float32", (Band("predicted horizontal standard deviation", "metre"),)),
            "sigma_v": RasterKind("float32", (Band("predicted vertical standard deviation", "metre"),)),
            "measured": RasterKind("uint8", (Band(f"measured {MEASURED}, interpolated {INTERPOLATED}"),)),
        }
        if has_terrain:
            self._kinds |= {
                "dtm": RasterKind("float32", (Band(f"ground: {height}", target.crs.height_unit),)),
                "sigma_dtm": RasterKind("float32", (Band("predicted vertical standard deviation", "metre"),)),
            }
        self._seen, self._whole, self._coloured = (folder / name for name in ("seen", "whole", "coloured"))
        for part in (self._seen, self._whole, self._coloured):
            part.mkdir(parents=True, exist_ok=True)

    def render(self, source: RasterSource, progress: Progress) -> None:
        """Render the windows whose parts are missing, then fill what is not measured inside the area."""
        windows = list(self._windows())
        with progress.task("windows", len(windows)) as task:
            for window in windows:
                if not all(self._part(self._seen, name, window).exists() for name in _SEEN):
                    cells = render_window(source, window.frame, window.column, window.row)
                    heights = (cells.height, cells.modelled, cells.sigma_h_m, cells.sigma_v_m)
                    bands: list[NDArray[Any]] = [
                        cells.rgba,
                        *(values[None].astype(np.float32) for values in heights),
                    ]
                    self._write(self._seen, window, dict(zip(_SEEN, bands, strict=True)))
                task.advance()
        self._drop_islands()
        if self._fill != "all":
            self.polygon = self._outline(self._fill)
        for name in ("orthophoto", "dsm", "modelled"):
            parts = [(self._part(self._seen, name, one), one.column, one.row) for one in windows]
            write_vrt(name, parts, self.frame, self._kinds["dsm" if name == "modelled" else name], {})
        with progress.task("whole windows", len(windows)) as task:
            for window in windows:
                if not all(self._part(self._whole, name, window).exists() for name in self._kinds):
                    seen, first = self._seen_around(window), (window.row, window.column)
                    self._write(self._whole, window, whole_cells(source, seen, self._coarse, first))
                task.advance()

    def colour(self, colours: PhotoColours, progress: Progress) -> None:
        """Colour the orthophoto's cells by the photographs that see them; the others keep the splat's colours."""
        names = ("orthophoto", "source")
        for window, cells in self._of_photographs(colours, "colours of the photographs", names, progress):
            rgba = read_cells(self._part(self._whole, "orthophoto", window))
            number = np.where(rgba[3] > 0, cells.camera + 1, 0)
            seen = np.clip(np.round(np.nan_to_num(cells.colours)), 0, 255).astype(np.uint8)
            rgba[:3] = np.where(number > 0, seen, rgba[:3])
            self._write(self._coloured, window, {"orthophoto": rgba, "source": number[None].astype(np.uint16)})

    def add_bands(self, colours: PhotoColours, bands: Bands, progress: Progress) -> None:
        """Deliver the bands of a rig on the same cells, of the photographs that see them; the others are empty."""
        self._kinds["bands"] = RasterKind("float32", bands.described())
        for window, cells in self._of_photographs(colours, "bands", ("bands",), progress):
            inside = read_cells(self._part(self._whole, "orthophoto", window))[3] > 0
            values = bands.with_indices(cells.colours)
            self._write(self._coloured, window, {"bands": np.where(inside, values, np.float32(np.nan))})

    def _of_photographs(
        self, colours: PhotoColours, task_name: str, names: tuple[str, ...], progress: Progress
    ) -> Iterator[tuple[_Window, CellColours]]:
        """Yield the windows that lack a part of one of these names, with what photographs show of their cells."""
        windows = list(self._windows())
        whole = [(self._part(self._whole, "dsm", one), one.column, one.row) for one in windows]
        heights = write_vrt("dsm", whole, self.frame, self._kinds["dsm"], {})
        with progress.task(task_name, len(windows)) as task:
            for window in windows:
                if not all(self._part(self._coloured, name, window).exists() for name in names):
                    part, in_window, frame = self._around(window, MARGIN)
                    height = read_cells(heights, part)[0].astype(np.float64)
                    cells = colours.window(frame, (part[0].start, part[1].start), height)
                    yield window, CellColours(cells.colours[:, *in_window], cells.camera[in_window])
                task.advance()

    def add_source(self) -> None:
        """Deliver the number of the photograph that each cell's detail is from, from 1 on; 0: none."""
        self._kinds["source"] = RasterKind("uint16", (Band("number of the photograph (source.json)"),))

    def photographed(self) -> float:
        """Return the share of the cells with a colour whose colour is that of photographs."""
        seen = known = 0
        for window in self._windows():
            path = self._part(self._coloured, "source", window)
            seen += int((read_cells(path)[0] > 0).sum()) if path.exists() else 0
            known += int((read_cells(self._part(self._whole, "measured", window))[0] > 0).sum())
        return seen / max(known, 1)

    @property
    def _step(self) -> int:
        """Cells along a side of those at which the whole raster is looked at."""
        return -(-max(self.frame.columns, self.frame.rows) // _OVERVIEW_PX)

    def _measured(self) -> BoolArray:
        """Return which coarse cells of the whole raster hold a measured one."""
        step = self._step
        seen = np.zeros((-(-self.frame.rows // step), -(-self.frame.columns // step)), dtype=bool)
        for window in self._windows():
            alpha = read_cells(self._part(self._seen, "orthophoto", window))[3]
            np.logical_or.at(seen, _coarse_cells(window, step), alpha == MEASURED)
        return seen

    def _outline(self, fill: float | None) -> Any:
        """Return the polygon of what is measured in the area, with holes up to a width; all where nothing is."""
        step_x, step_y = self._step * self.frame.step_x, self._step * self.frame.step_y
        cell_m = step_x * self.target.horizontal_unit_m
        seen = self._measured()

        def plan_in_m(plan: FloatArray) -> FloatArray:
            east, north = (plan[:, 0] - self.frame.west) / step_x, (plan[:, 1] - self.frame.north) / step_y
            return np.column_stack([cell_m * east, cell_m * (len(seen) + north)])

        def plan_of_m(plan: FloatArray) -> FloatArray:
            east, north = (plan / cell_m).T
            return np.column_stack(
                [self.frame.west + step_x * east, self.frame.north + step_y * (north - len(seen))]
            )

        ground = MeasuredGround(seen[::-1], np.zeros(2), np.array([cell_m, self._photo_m]))
        within = shapely.transform(self.polygon, plan_in_m)
        if fill is None and ground.share(within) >= 1.0 - MOST_FILLED:
            return self.polygon
        outline = ground.outline(within, fill, wider=_WIDER)
        return self.polygon if outline is None else shapely.transform(outline, plan_of_m)

    def _drop_islands(self) -> None:
        """Unmeasure the cells of islands: small parts, apart from all other surface, are agreements by chance."""
        step, seen = self._step, self._measured()
        number, _ = label(seen, structure=np.ones((3, 3)))
        sizes = np.bincount(number.ravel())
        if len(sizes) < 3:
            return
        island = sizes < _LEAST_ISLAND * sizes[1:].max()
        island[0] = False
        for window in self._windows():
            dropped = island[number[_coarse_cells(window, step)]]
            if not dropped.any():
                continue
            bands = {name: read_cells(self._part(self._seen, name, window)) for name in _SEEN}
            bands["modelled"][:, dropped] = bands["dsm"][:, dropped]
            bands["orthophoto"][3][dropped] = PAINTED
            for name in ("dsm", "sigma_h", "sigma_v"):
                bands[name][:, dropped] = np.nan
            self._write(self._seen, window, bands)

    def _seen_around(self, window: _Window) -> SeenCells:
        part, in_window, frame = self._around(window, REACH)
        sigma_h, sigma_v = (read_cells(self._part(self._seen, name, window))[0] for name in ("sigma_h", "sigma_v"))
        height, inside = (
            read_cells(self._seen / "dsm.vrt", part)[0].astype(np.float64),
            cells_inside(self.polygon, frame),
        )
        if self._fill == 0:
            inside &= np.isfinite(height)
        return SeenCells(
            frame=frame,
            in_window=in_window,
            height=height,
            rgba=read_cells(self._seen / "orthophoto.vrt", part),
            modelled=read_cells(self._seen / "modelled.vrt", part)[0].astype(np.float64),
            sigma_h_m=sigma_h,
            sigma_v_m=sigma_v,
            inside=inside,
        )

    def _around(self, window: _Window, margin: int) -> tuple[tuple[slice, slice], tuple[slice, slice], RasterFrame]:
        """Return the cells of a window and up to `margin` around it, its own among them, and the frame of all."""
        row, column = window.row, window.column
        top, left = max(row - margin, 0), max(column - margin, 0)
        rows = min(row + window.frame.rows + margin, self.frame.rows) - top
        columns = min(column + window.frame.columns + margin, self.frame.columns) - left
        in_window = (
            slice(row - top, row - top + window.frame.rows),
            slice(column - left, column - left + window.frame.columns),
        )
        part = (slice(top, top + rows), slice(left, left + columns))
        return part, in_window, self.frame.part(left, top, columns, rows)

    @cached_property
    def _coarse(self) -> CoarseCells:
        height, _ = read_reduced(self._seen / "dsm.vrt", _COARSE_PX)
        rgba, _ = read_reduced(self._seen / "orthophoto.vrt", _COARSE_PX)
        rows, columns = height.shape[1:]
        inside = cells_inside(self.polygon, self.frame.resized(columns, rows))
        modelled, _ = read_reduced(self._seen / "modelled.vrt", _COARSE_PX)
        cells = fill_cells(height[0], inside, max(rows, columns), modelled[0])
        rgb = np.moveaxis(rgba[:3], 0, 2).reshape(-1, 3)[cells.source]
        return CoarseCells(cells, rgb, self.frame.columns / columns)

    def sample(self, name: str) -> FloatArray:
        """Return values (K,) of cells all over a raster that have one; enough for medians and bounds."""
        paths = (self._part(self._whole, name, window) for window in self._windows())
        values = [read_reduced(path, _SAMPLES_PX)[0][0] for path in paths]
        flat = np.concatenate([part.ravel() for part in values])
        return np.asarray(flat[np.isfinite(flat)], dtype=np.float64)

    def shares(self) -> tuple[float, float, float]:
        """Return the measured and interpolated shares of the delivered area, and that area in hectares."""
        inside = measured = interpolated = 0
        for window in self._windows():
            mask = read_cells(self._part(self._whole, "measured", window))[0]
            inside += int(cells_inside(self.polygon, window.frame).sum())
            measured += int((mask == MEASURED).sum())
            interpolated += int((mask == INTERPOLATED).sum())
        hectares = inside * self.frame.step_x * self.frame.step_y * self.target.horizontal_unit_m**2 / 1e4
        return measured / max(inside, 1), interpolated / max(inside, 1), hectares

    def interpolated_parts(self, path: Path) -> list[Json]:
        """Return the interpolated parts of the mask at a path as features in WGS84, the largest first.

        There are none in a local frame, which GeoJSON cannot state.
        """
        if self.target.origin is None:
            return []
        mask, _ = read_reduced(path, _OUTLINES_PX)
        interpolated: BoolArray = (mask[0] > 0) & (mask[0] <= (MEASURED + INTERPOLATED) / 2)
        metres = self.target.horizontal_unit_m**2

        def in_wgs84(plan: FloatArray) -> FloatArray:
            lla = self.target.crs.lla_from_xyz(np.column_stack([plan, np.zeros(len(plan))]))
            return np.round(lla[:, [1, 0]], 8)

        parts = sorted(outlines(interpolated, self.frame), key=lambda part: -float(part.area))
        return [
            feature(
                shapely.geometry.mapping(shapely.orient_polygons(shapely.transform(part, in_wgs84))),
                {"area_m2": round(float(part.area) * metres, 4)},
            )
            for part in parts
        ]

    def write(
        self, folder: Path, sidecar_of: Callable[[str], CrsSidecar], progress: Progress
    ) -> Iterator[tuple[Path, CrsSidecar]]:
        """Write each raster into a folder, with accuracy and σ of its sidecar as metadata; yield both."""
        with progress.task("rasters", len(self._kinds)) as task:
            for name, kind in self._kinds.items():
                parts = [(self._delivered(name, one), one.column, one.row) for one in self._windows()]
                path, sidecar = folder / f"{name}.tif", sidecar_of(name)
                write_mosaic(path, parts, self.frame, kind, _tags(sidecar))
                yield path, sidecar
                task.advance(note=path.name)

    def _windows(self) -> Iterator[_Window]:
        for row in range(0, self.frame.rows, _WINDOW_PX):
            for column in range(0, self.frame.columns, _WINDOW_PX):
                columns = min(_WINDOW_PX, self.frame.columns - column)
                rows = min(_WINDOW_PX, self.frame.rows - row)
                yield _Window(column, row, self.frame.part(column, row, columns, rows))

    def _write(self, folder: Path, window: _Window, bands: dict[str, AnyArray]) -> None:
        for name, values in bands.items():
            write_part(self._part(folder, name, window), values, window.frame)

    def _delivered(self, name: str, window: _Window) -> Path:
        coloured = self._part(self._coloured, name, window)
        return coloured if coloured.exists() else self._part(self._whole, name, window)

    def _part(self, folder: Path, name: str, window: _Window) -> Path:
        return folder / f"{name}_{window.row}_{window.column}.tif"


def _tags(sidecar: CrsSidecar) -> dict[str, str]:
    tags = {
        "TIFFTAG_SOFTWARE": f"GeoRefGS {__version__}",
        "GEOREF_CRS": sidecar.crs,
        "GEOREF_VERTICAL_DATUM": sidecar.vertical_datum.name,
        "GEOREF_EPOCH": "not stated",
    }
    if sidecar.accuracy is not None:
        tags["GEOREF_ACCURACY"] = sidecar.accuracy.text
    if sidecar.sigma is not None:
        tags["GEOREF_MEDIAN_CELL_SIGMA_H_M"] = f"{sidecar.sigma.median_sigma_h_m:.4f}"
        tags["GEOREF_MEDIAN_CELL_SIGMA_V_M"] = f"{sidecar.sigma.median_sigma_v_m:.4f}"
    return tags


def _coarse_cells(window: _Window, step: int) -> tuple[IntArray, IntArray]:
    """Return the rows (H, 1) and columns (1, W) of a window in a raster with one cell for `step` × `step`."""
    rows = (window.row + np.arange(window.frame.rows, dtype=np.int64)) // step
    columns = (window.column + np.arange(window.frame.columns, dtype=np.int64)) // step
    return rows[:, None], columns[None, :]
