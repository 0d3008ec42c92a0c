"""Contour lines of the surface model."""

from __future__ import annotations

import math
from pathlib import Path

import contourpy
import numpy as np
from scipy.ndimage import gaussian_filter

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.contour_files import ContourLine, write_contours_dxf, write_contours_gpkg
from pipelines.formats.geotiff import RasterFrame, read_reduced

_EVERY_MAJOR = 5
_LEAST_CELLS = 12.0  # length of the shortest line
_SMOOTHED = 1.5  # cells: σ of the smoothing, without which every stone has its own line
_MOST_LEVELS = 2_000
_LONGEST_PX = 6000  # of the surface that lines are drawn of


def write_contours(folder: Path, frame: RasterFrame, interval: float) -> int:
    """Write `contours.gpkg` and `contours.dxf` of the surface model in a folder, and return the number of lines.

    Args:
        folder: has `dsm.tif`.
        frame: of the rasters.
        interval: between two lines, in the unit of the heights.

    Raises:
        InputError: the interval is too small for the scene.
    """
    height, _ = read_reduced(folder / "dsm.tif", _LONGEST_PX)
    lines = contour_lines(height[0].astype(np.float64), frame, interval)
    write_contours_gpkg(folder / "contours.gpkg", lines, frame.wkt)
    write_contours_dxf(folder / "contours.dxf", lines)
    return len(lines)


def contour_lines(height: FloatArray, frame: RasterFrame, interval: float) -> list[ContourLine]:
    """Return the contour lines of a surface, lowest first; short ones are left out.

    Args:
        height: (H, W) rows from the north, over the whole frame; NaN: no surface.
        frame: of the raster, whose cells may be smaller.
        interval: between two lines, in the unit of the heights.

    Raises:
        InputError: the interval is too small for the scene.
    """
    known = np.isfinite(height)
    if known.sum() < 4:
        return []
    low, high = np.nanquantile(height, [0.0005, 0.9995])
    levels = interval * np.arange(math.ceil(low / interval), math.floor(high / interval) + 1)
    if len(levels) > _MOST_LEVELS:
        raise InputError(
            f"{len(levels)} heights are more than {_MOST_LEVELS}: give a larger interval", field="--contours"
        )
    west, south, east, north = frame.bounds
    step = (east - west) / height.shape[1], (north - south) / height.shape[0]
    x = west + (np.arange(height.shape[1]) + 0.5) * step[0]
    y = north - (np.arange(height.shape[0]) + 0.5) * step[1]
    generator = contourpy.contour_generator(x, y, np.ma.masked_invalid(_smoothed(height, known)))
    lines = []
    for level in levels:
        for xy in generator.lines(float(level)):
            points = np.asarray(xy)
            length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            if length >= _LEAST_CELLS * step[0]:
                lines.append(ContourLine(float(level), points, round(level / interval) % _EVERY_MAJOR == 0))
    return lines


def _smoothed(height: FloatArray, known: BoolArray) -> FloatArray:
    """Return heights (H, W), smoothed over what is known; NaN elsewhere."""
    weight = gaussian_filter(known.astype(np.float64), _SMOOTHED, mode="constant")
    total = gaussian_filter(np.where(known, height, 0.0), _SMOOTHED, mode="constant")
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)
