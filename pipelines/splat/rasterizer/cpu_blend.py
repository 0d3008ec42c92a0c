"""Blending of the splats of each tile, as numba kernels.

One row of a tile is one vector (see `cpu_lanes`). Once a pixel is done, its transmittance T is kept as −T: no splat
adds to the pixel any more, and the final value of T stays known. Forward and backward walk the same lists in the
same direction with the same arithmetic, so that both take the same decisions at every cut-off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from pipelines.splat.rasterizer.api import ALPHA_MAX, TRANSMITTANCE_MIN
from pipelines.splat.rasterizer.cpu_jit import jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_lanes import (
    LANES,
    any_positive,
    exp,
    load,
    splat,
    store,
    where_greater,
)
from pipelines.splat.rasterizer.cpu_project import (
    BLUE,
    DEPTH,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    GREEN,
    LOG_ALPHA_MIN,
    LOG_OPACITY,
    RED,
    SLOPE_X,
    SLOPE_Y,
    X,
    Y,
)
from pipelines.splat.rasterizer.cpu_tiles import TILE_HEIGHT, TILE_WIDTH, unpack_hit

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Hits between two checks which rows of the tile are not done yet.
HITS_PER_CHECK = 16

# Planes of a tile's scratch memory.
T, R, G, B, D, D2, MEDIAN = range(7)
FORWARD_PLANES = 7


@jit
def pixel_centers(dtype: Any) -> Any:
    """Return the centres (LANES,) of a row's pixels, from its left end."""
    centers = np.empty(LANES, dtype)
    for lane in range(LANES):
        centers[lane] = lane + 0.5
    return centers


@jit
def row_exponent(table: Any, index: int, dx: Any, dy: Any) -> Any:
    """Return ln α of one splat along a row of pixels, before the cut-offs."""
    slanted = splat(table[index, FACTOR_XX]) * dx + splat(table[index, FACTOR_XY] * dy)
    vertical = table[index, FACTOR_YY] * dy
    return splat(table[index, LOG_OPACITY] - vertical * vertical) - slanted * slanted


@jit
def row_depth(table: Any, index: int, dx: Any, dy: Any) -> Any:
    """Return z of one splat along a row of pixels."""
    return splat(table[index, SLOPE_X]) * dx + splat(table[index, DEPTH] + table[index, SLOPE_Y] * dy)


@jit
def start_tile(scratch: Any, tile_x: int, tile_y: int, width: int, height: int) -> None:
    """Set T = 1 for pixels inside the image; pixels outside are done from the start. Other planes start at 0."""
    number = scratch.dtype.type
    for k in range(scratch.shape[0]):
        scratch[k] = 0
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            inside = tile_y + row < height and tile_x + column < width
            scratch[T * TILE_PIXELS + row * TILE_WIDTH + column] = number(1.0) if inside else number(-1.0)


@jit
def alive_rows(scratch: Any, top: int, bottom: int) -> Any:
    """Return first and last row of top … bottom with a pixel that is not done; top > bottom if there is none."""
    while top <= bottom and not any_positive(load(scratch, T * TILE_PIXELS + top * TILE_WIDTH)):
        top += 1
    while bottom > top and not any_positive(load(scratch, T * TILE_PIXELS + bottom * TILE_WIDTH)):
        bottom -= 1
    return top, bottom


@jit
def _blend_tile(table: Any, hits: Any, first: int, last: int, tile_x: int, tile_y: int, depth: bool, scratch: Any,
                lane_x: Any) -> int:  # fmt: skip
    """Blend hits first … last − 1 into the tile's scratch planes; return the hit after the last one used."""
    number = table.dtype.type
    zero, one, half = splat(number(0.0)), splat(number(1.0)), splat(number(0.5))
    cutoff, alpha_max = splat(number(LOG_ALPHA_MIN)), splat(number(ALPHA_MAX))
    t_min = splat(number(TRANSMITTANCE_MIN))
    pixel_x = load(lane_x, 0) + splat(number(tile_x))
    top, bottom = 0, TILE_HEIGHT - 1
    for place in range(first, last):
        if (place - first) % HITS_PER_CHECK == 0:
            top, bottom = alive_rows(scratch, top, bottom)
            if top > bottom:
                return place
        index, first_row, last_row = unpack_hit(hits[place])
        red, green, blue = splat(table[index, RED]), splat(table[index, GREEN]), splat(table[index, BLUE])
        dx = pixel_x - splat(table[index, X])
        for row in range(max(first_row, top), min(last_row, bottom) + 1):
            at = row * TILE_WIDTH
            dy = number(tile_y + row) + number(0.5) - table[index, Y]
            exponent = row_exponent(table, index, dx, dy)
            alpha = exp(exponent)
            alpha = where_greater(alpha, alpha_max, alpha_max, alpha)
            alpha = where_greater(cutoff, exponent, zero, alpha)
            t = load(scratch, T * TILE_PIXELS + at)
            t_next = t * (one - alpha)
            weight = where_greater(t_next, t_min, alpha * t, zero)
            done = where_greater(t, zero, zero - t, t)
            store(scratch, T * TILE_PIXELS + at, where_greater(t_next, t_min, t_next, done))
            store(scratch, R * TILE_PIXELS + at, load(scratch, R * TILE_PIXELS + at) + weight * red)
            store(scratch, G * TILE_PIXELS + at, load(scratch, G * TILE_PIXELS + at) + weight * green)
            store(scratch, B * TILE_PIXELS + at, load(scratch, B * TILE_PIXELS + at) + weight * blue)
            if depth:
                z = row_depth(table, index, dx, dy)
                store(scratch, D * TILE_PIXELS + at, load(scratch, D * TILE_PIXELS + at) + weight * z)
                store(scratch, D2 * TILE_PIXELS + at, load(scratch, D2 * TILE_PIXELS + at) + weight * z * z)
                median = load(scratch, MEDIAN * TILE_PIXELS + at)
                crossed = where_greater(t, half, where_greater(t_next, half, median, z), median)
                store(scratch, MEDIAN * TILE_PIXELS + at, crossed)
    return last


@jit
def _finish_tile(scratch: Any, tile_x: int, tile_y: int, background: Any, images: Any) -> None:
    """Write a blended tile into the images."""
    colour, alpha, depth, depth2, median = images
    for row in range(min(TILE_HEIGHT, colour.shape[0] - tile_y)):
        for column in range(min(TILE_WIDTH, colour.shape[1] - tile_x)):
            at = row * TILE_WIDTH + column
            y, x = tile_y + row, tile_x + column
            final = abs(scratch[T * TILE_PIXELS + at])
            colour[y, x, 0] = scratch[R * TILE_PIXELS + at] + final * background[0]
            colour[y, x, 1] = scratch[G * TILE_PIXELS + at] + final * background[1]
            colour[y, x, 2] = scratch[B * TILE_PIXELS + at] + final * background[2]
            alpha[y, x] = 1 - final
            if depth.shape[0] > 0:
                depth[y, x] = scratch[D * TILE_PIXELS + at]
                depth2[y, x] = scratch[D2 * TILE_PIXELS + at]
                median[y, x] = scratch[MEDIAN * TILE_PIXELS + at]


@worker_jit
def _blend(
    table: Any, hits: Any, tile_start: Any, background: Any, images: Any, tile_end: Any, worker: int, workers: int
) -> None:
    height, width = images[1].shape
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    depth = images[2].shape[0] > 0
    scratch = np.empty(FORWARD_PLANES * TILE_PIXELS, table.dtype)
    lane_x = pixel_centers(table.dtype)
    for tile in range(worker, tile_end.shape[0], workers):
        x, y = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        start_tile(scratch, x, y, width, height)
        tile_end[tile] = _blend_tile(
            table, hits, tile_start[tile], tile_start[tile + 1], x, y, depth, scratch, lane_x
        )
        _finish_tile(scratch, x, y, background, images)


@parallel_jit
def blend(
    table: Any, hits: Any, tile_start: Any, background: Any, images: Any, tile_end: Any, workers: int
) -> None:
    """Blend the splats of all tiles into images.

    Args:
        table: (M, SPLAT_WIDTH) splats, nearest first.
        hits: (H,) packed hits by tile, nearest first.
        tile_start: (tiles + 1,) into `hits`.
        background: (3,) float64.
        images: colour (H, W, 3), alpha (H, W), Σ w z (H, W), Σ w z² (H, W), median depth (H, W), written; the
            depths may be of size (0, 0).
        tile_end: (tiles,) hit after the last one used, written.
        workers: number of threads.
    """
    for worker in prange(workers):
        _blend(table, hits, tile_start, background, images, tile_end, np.int64(worker), workers)
