"""Whole cells of one window: what is measured, and inside the area what is interpolated; and the ground below."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.deliver.raster_window import RasterSource, between_nodes, georeference_sigma_maps, places_in_geo
from pipelines.formats.geotiff import RasterFrame
from pipelines.surface.filling import FilledCells, fill_cells
from pipelines.surface.ground import GroundModel

MEASURED, INTERPOLATED = 255, 128  # in `measured.tif`; 0: outside the area, or unknown
# A hole is filled cell by cell up to `_NARROW` cells from its rim, and beyond `REACH` by a coarse raster of the
# whole; between, one goes over into the other.
_NARROW, REACH = 16, 64
_RIM_M = 1.0  # around what stands on the ground, or hides it
_WRONG = 0.1  # share of the heights of the model alone that are wrong, by three simulated flights


@dataclass(frozen=True)
class SeenCells:
    """What is measured in a window and up to `REACH` cells around it (H, W).

    Attributes:
        frame: of these cells.
        own: rows and columns of the window among them.
        height: NaN: not measured.
        rgba: (4, H, W); alpha as in `WindowCells`.
        modelled: as in `WindowCells`.
        sigma_h_m, sigma_v_m: of the window's own cells.
        inside: cells in the area of interest.
    """

    frame: RasterFrame
    own: tuple[slice, slice]
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
    own, target = seen.own, source.target
    cells = fill_cells(seen.height, seen.inside, REACH, seen.modelled)
    blank = seen.rgba[3][own] == 0
    rgb = np.where(seen.rgba[3] > 0, seen.rgba[:3], seen.rgba[:3].reshape(3, -1)[:, cells.source])[:, *own]
    measured, inside = np.isfinite(seen.height)[own], seen.inside[own]
    height, spread, distance = cells.height[own].copy(), cells.sigma[own].copy(), cells.distance[own].copy()
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
    modelled = seen.modelled[own]
    taken = ~measured & np.isfinite(modelled) & np.isfinite(height)
    spread[taken] = np.sqrt(spread[taken] ** 2 + _WRONG * (modelled[taken] - height[taken]) ** 2)
    height[taken] = modelled[taken]
    known = inside & np.isfinite(height)
    frame = seen.frame.part(own[1].start, own[0].start, known.shape[1], known.shape[0])
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
        sigma = np.where(variance_m2[own] > 0, np.sqrt(georeference_v**2 + variance_m2[own]), seen.sigma_v_m)
        heights |= {"dtm": ground[own], "sigma_dtm": sigma}
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
