"""Rasters of the stage, window by window: rendered into parts, then put together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from pipelines import __version__
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray, IntArray
from pipelines.deliver.raster_window import RasterSource, WindowCells, render_window
from pipelines.formats.georef_sidecar import CrsSidecar
from pipelines.formats.geotiff import (
    NODATA,
    Band,
    RasterFrame,
    RasterKind,
    read_all,
    read_reduced,
    write_mosaic,
    write_part,
)
from pipelines.survey.target_crs import TargetCrs

_WINDOW_PX = 1536
_SAMPLES_PX = 192  # a side of a window
_ISLANDS_PX = 4000  # along the longer side, at which islands are looked for
_LEAST_ISLAND = 0.01  # of the largest part of the surface

_COLOURS = (
    Band("red", colour="Red"),
    Band("green", colour="Green"),
    Band("blue", colour="Blue"),
    Band("surface seen", colour="Alpha"),
)


@dataclass(frozen=True)
class _Window:
    """Window by its first cell, and the frame of its cells."""

    column: int
    row: int
    frame: RasterFrame


class Mosaic:
    """Rasters `orthophoto`, `dsm`, `sigma_h` and `sigma_v` over one frame; parts in the folder are kept."""

    def __init__(self, folder: Path, frame: RasterFrame, target: TargetCrs) -> None:
        self.folder, self.frame = folder, frame
        height = f"height above {target.crs.vertical.name}"
        self._kinds = {
            "orthophoto": RasterKind("uint8", _COLOURS),
            "dsm": RasterKind("float32", (Band(height, target.crs.height_unit),)),
            "sigma_h": RasterKind("float32", (Band("predicted horizontal standard deviation", "metre"),)),
            "sigma_v": RasterKind("float32", (Band("predicted vertical standard deviation", "metre"),)),
        }
        folder.mkdir(exist_ok=True)

    def render(self, source: RasterSource, progress: Progress) -> None:
        """Render the windows whose parts are missing."""
        windows = list(self._windows())
        with progress.task("windows", len(windows)) as task:
            for window in windows:
                if not all(self._part(name, window).exists() for name in self._kinds):
                    cells = render_window(source, window.frame, window.column, window.row)
                    for name in self._kinds:
                        write_part(self._part(name, window), _bands(name, cells), window.frame)
                task.advance()

    def drop_islands(self) -> None:
        """Empty the cells of islands: small parts, apart from all other surface, are agreements by chance."""
        step = -(-max(self.frame.columns, self.frame.rows) // _ISLANDS_PX)
        seen = np.zeros((-(-self.frame.rows // step), -(-self.frame.columns // step)), dtype=bool)
        for window in self._windows():
            np.logical_or.at(seen, _coarse(window, step), read_all(self._part("orthophoto", window))[3] > 0)
        number, _ = label(seen, structure=np.ones((3, 3)))
        sizes = np.bincount(number.ravel())
        if len(sizes) < 3:
            return
        island = sizes < _LEAST_ISLAND * sizes[1:].max()
        island[0] = False
        for window in self._windows():
            dropped = island[number[_coarse(window, step)]]
            if not dropped.any():
                continue
            for name, kind in self._kinds.items():
                values = read_all(self._part(name, window))
                values[:, dropped] = 0 if kind.dtype == "uint8" else NODATA
                write_part(self._part(name, window), values, window.frame)

    def sample(self, name: str) -> FloatArray:
        """Return values (K,) of cells all over a raster that have one; enough for medians and bounds."""
        values = [read_reduced(self._part(name, window), _SAMPLES_PX)[0][0] for window in self._windows()]
        flat = np.concatenate([part.ravel() for part in values])
        return np.asarray(flat[np.isfinite(flat)], dtype=np.float64)

    def covered(self) -> float:
        """Return the share of the cells that have a surface."""
        alpha = [read_reduced(self._part("orthophoto", window), _SAMPLES_PX)[0][3] for window in self._windows()]
        return float(np.concatenate([part.ravel() for part in alpha]).mean() / 255)

    def write(self, folder: Path, sidecar: CrsSidecar, progress: Progress) -> Iterator[Path]:
        """Write each raster into a folder, with accuracy and σ of the sidecar as metadata, and yield its path."""
        with progress.task("rasters", len(self._kinds)) as task:
            for name, kind in self._kinds.items():
                parts = [(self._part(name, window), window.column, window.row) for window in self._windows()]
                path = folder / f"{name}.tif"
                write_mosaic(path, parts, self.frame, kind, _tags(sidecar))
                yield path
                task.advance(note=path.name)

    def _windows(self) -> Iterator[_Window]:
        for row in range(0, self.frame.rows, _WINDOW_PX):
            for column in range(0, self.frame.columns, _WINDOW_PX):
                columns = min(_WINDOW_PX, self.frame.columns - column)
                rows = min(_WINDOW_PX, self.frame.rows - row)
                yield _Window(column, row, self.frame.part(column, row, columns, rows))

    def _part(self, name: str, window: _Window) -> Path:
        return self.folder / f"{name}_{window.row}_{window.column}.tif"


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


def _coarse(window: _Window, step: int) -> tuple[IntArray, IntArray]:
    """Return the rows (H, 1) and columns (1, W) of a window in a raster with one cell for `step` × `step`."""
    rows = (window.row + np.arange(window.frame.rows, dtype=np.int64)) // step
    columns = (window.column + np.arange(window.frame.columns, dtype=np.int64)) // step
    return rows[:, None], columns[None, :]


def _bands(name: str, cells: WindowCells) -> NDArray[Any]:
    """Return the bands (B, H, W) of one raster."""
    if name == "orthophoto":
        return cells.rgba
    heights = {"dsm": cells.height, "sigma_h": cells.sigma_h_m, "sigma_v": cells.sigma_v_m}
    return heights[name][None].astype(np.float32)
