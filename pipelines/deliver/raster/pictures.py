"""Pictures of the rasters for people: the orthophoto made small, and the surface model as hillshade."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import ByteArray, FloatArray
from pipelines.formats.geotiff import read_reduced

_LONGEST_PX = 2000
_SUN_AZIMUTH_DEG, _SUN_ELEVATION_DEG = 315.0, 45.0


def write_pictures(folder: Path, heights_by_plan: float) -> None:
    """Write `preview.png` and `hillshade.png` of the rasters in a folder.

    Args:
        folder: has `orthophoto.tif` and `dsm.tif`.
        heights_by_plan: horizontal unit over the unit of the heights.
    """
    rgba, _ = read_reduced(folder / "orthophoto.tif", _LONGEST_PX)
    _write_preview(folder / "preview.png", rgba)
    height, cell = read_reduced(folder / "dsm.tif", _LONGEST_PX)
    _write_hillshade(folder / "hillshade.png", height[0], cell * heights_by_plan)


def _write_preview(path: Path, rgba: NDArray[np.uint8]) -> None:
    """Write red, green, blue and alpha (4, H, W) as a PNG."""
    cv2.imwrite(str(path), np.ascontiguousarray(np.moveaxis(rgba, 0, 2)[..., [2, 1, 0, 3]]))


def _write_hillshade(path: Path, height: FloatArray, cell: float) -> None:
    """Write the hillshade of heights (H, W) as a PNG; transparent where there is no surface.

    Args:
        path: of the PNG.
        height: (H, W) rows from the north; NaN: no surface.
        cell: size of a cell, in the unit of the heights.
    """
    grey = hillshade(height, cell)
    alpha = np.where(np.isfinite(height), 255, 0).astype(np.uint8)
    cv2.imwrite(str(path), np.dstack([grey, grey, grey, alpha]))


def hillshade(height: FloatArray, cell: float) -> ByteArray:
    """Return the light (H, W) of a sun in the north-west on a surface, 0 … 255; the sun stands at 45°."""
    south, east = np.gradient(np.where(np.isfinite(height), height, np.nanmedian(height)), cell)
    azimuth, elevation = np.radians(_SUN_AZIMUTH_DEG), np.radians(_SUN_ELEVATION_DEG)
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    light = (sun[2] - sun[0] * east + sun[1] * south) / np.sqrt(1.0 + east**2 + south**2)
    return np.asarray(np.round(255 * np.clip(light, 0.0, 1.0)), dtype=np.uint8)
