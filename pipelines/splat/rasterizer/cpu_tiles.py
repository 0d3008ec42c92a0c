"""Lists of the splats of each tile, nearest first: a parallel counting sort, as numba kernels.

An ellipse is cut into the columns of tiles that it crosses. Its extreme rows within a column have a closed form. A
tile is therefore listed only if the ellipse enters it, with exactly the rows that the ellipse enters (the idea of
AccuTile, doi 10.48550/arXiv.2412.00578).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.splat.rasterizer.cpu_jit import jit, kernel_jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_lanes import LANES
from pipelines.splat.rasterizer.cpu_project import E_LEVEL, E_X, E_XX, E_XY, E_Y, E_YY

TILE_WIDTH = LANES
TILE_HEIGHT = 32
# Number of runs of the depth order in which splats are counted and written, whatever the number of threads.
RUNS = 32


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Return the columns and rows of tiles over an image."""
    return -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)


@jit
def pack_hit(splat: int, first_row: int, last_row: int) -> int:
    """Pack a splat in a tile with the first and last of the tile's rows that it touches."""
    return (splat << 16) | (first_row << 8) | last_row


@jit
def unpack_hit(hit: int) -> Any:
    """Unpack a hit: inverts `pack_hit`."""
    return hit >> 16, (hit >> 8) & 255, hit & 255


@jit
def _clamp_to_int(value: float, low: int, high: int) -> int:
    return int(min(max(value, float(low)), float(high)))


@jit
def _column_span(ellipses: Any, splat: int, width: int) -> Any:
    """Return the first and last column of tiles; first > last if there is none."""
    x = float(ellipses[splat, E_X])
    extent = math.sqrt(float(ellipses[splat, E_LEVEL]) * float(ellipses[splat, E_XX]))
    first = _clamp_to_int(math.ceil(x - extent - 0.5), 0, width)
    last = _clamp_to_int(math.floor(x + extent - 0.5), -1, width - 1)
    if first > last:
        return 0, -1
    return first // TILE_WIDTH, last // TILE_WIDTH


@jit
def _row_span(ellipses: Any, splat: int, column: int, height: int) -> Any:
    """Return the first and last row of pixels that the ellipse touches within a column of tiles.

    At a distance dx from the centre the ellipse spans dx · xy/xx ± sqrt((level − dx²/xx) · det/xx). The upper
    branch is concave: its maximum over an interval lies at its global maximum, clamped to the interval.
    """
    x, y = float(ellipses[splat, E_X]), float(ellipses[splat, E_Y])
    xx, xy, yy = float(ellipses[splat, E_XX]), float(ellipses[splat, E_XY]), float(ellipses[splat, E_YY])
    level = float(ellipses[splat, E_LEVEL])
    extent = math.sqrt(level * xx)
    left = max(column * TILE_WIDTH + 0.5 - x, -extent)
    right = min(column * TILE_WIDTH + TILE_WIDTH - 0.5 - x, extent)
    slope = xy / xx
    spread = (xx * yy - xy * xy) / xx
    top = xy * math.sqrt(level / yy)
    dx_high, dx_low = min(max(top, left), right), min(max(-top, left), right)
    high = slope * dx_high + math.sqrt(spread * max(level - dx_high * dx_high / xx, 0.0))
    low = slope * dx_low - math.sqrt(spread * max(level - dx_low * dx_low / xx, 0.0))
    first = _clamp_to_int(math.ceil(y + low - 0.5), 0, height)
    last = _clamp_to_int(math.floor(y + high - 0.5), -1, height - 1)
    return first, last


@worker_jit
def _count_hits(ellipses: Any, width: int, height: int, per_tile: Any, per_splat: Any, run: int) -> None:
    splats = ellipses.shape[0]
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for tile in range(per_tile.shape[1]):
        per_tile[run, tile] = 0
    for splat in range(splats * run // RUNS, splats * (run + 1) // RUNS):
        hits = 0
        first_column, last_column = _column_span(ellipses, splat, width)
        for column in range(first_column, last_column + 1):
            first, last = _row_span(ellipses, splat, column, height)
            if first > last:
                continue
            for tile_row in range(first // TILE_HEIGHT, last // TILE_HEIGHT + 1):
                per_tile[run, tile_row * columns + column] += 1
                hits += 1
        per_splat[splat] = hits


@parallel_jit
def count_hits(ellipses: Any, width: int, height: int, per_tile: Any, per_splat: Any) -> None:
    """Count the tiles of each splat.

    Args:
        ellipses: (M, ELLIPSE_WIDTH), nearest first.
        width, height: of the image in px.
        per_tile: (RUNS, tiles) hits of each run in each tile, written.
        per_splat: (M,) hits of each splat, written.
    """
    for run in prange(RUNS):
        _count_hits(ellipses, width, height, per_tile, per_splat, np.int64(run))


@kernel_jit
def starts_from_counts(per_tile: Any, tile_start: Any) -> None:
    """Turn `per_tile` (RUNS, tiles) into the place of each run's first hit; fill `tile_start` (tiles + 1,)."""
    place = 0
    for tile in range(per_tile.shape[1]):
        tile_start[tile] = place
        for run in range(RUNS):
            count = per_tile[run, tile]
            per_tile[run, tile] = place
            place += count
    tile_start[per_tile.shape[1]] = place


@worker_jit
def _list_hits(
    ellipses: Any, width: int, height: int, next_place: Any, splat_start: Any, hits: Any, places: Any, run: int
) -> None:
    splats = ellipses.shape[0]
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for splat in range(splats * run // RUNS, splats * (run + 1) // RUNS):
        slot = splat_start[splat]
        first_column, last_column = _column_span(ellipses, splat, width)
        for column in range(first_column, last_column + 1):
            first, last = _row_span(ellipses, splat, column, height)
            if first > last:
                continue
            for tile_row in range(first // TILE_HEIGHT, last // TILE_HEIGHT + 1):
                tile, top = tile_row * columns + column, tile_row * TILE_HEIGHT
                place = next_place[run, tile]
                hits[place] = pack_hit(splat, max(first - top, 0), min(last - top, TILE_HEIGHT - 1))
                places[slot] = place
                next_place[run, tile] += 1
                slot += 1


@parallel_jit
def list_hits(
    ellipses: Any, width: int, height: int, next_place: Any, splat_start: Any, hits: Any, places: Any
) -> None:
    """List the splats of each tile, nearest first, and the places of each splat in those lists.

    Args:
        ellipses: (M, ELLIPSE_WIDTH), nearest first.
        width, height: of the image in px.
        next_place: (RUNS, tiles) from `starts_from_counts`, overwritten.
        splat_start: (M + 1,) start of each splat in `places`.
        hits: (H,) packed hits by tile, written.
        places: (H,) places in `hits` by splat, written.
    """
    for run in prange(RUNS):
        _list_hits(ellipses, width, height, next_place, splat_start, hits, places, np.int64(run))
