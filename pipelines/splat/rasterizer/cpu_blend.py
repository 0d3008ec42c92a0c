"""Blending of the splats of each tile and its derivative, as numba kernels.

One row of a tile is one vector (see `cpu_lanes`). Once a pixel is done, its transmittance T is kept as −T: no splat
adds to the pixel any more, and the final value of T stays known. Forward and backward walk the same lists in the
same direction with the same arithmetic, so that both take the same decisions at every cut-off.
"""

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import DTypeLike

from pipelines.core.types import ArrayHW, ArrayHWC, ArrayN, ArrayN3, ArrayNK
from pipelines.splat.rasterizer.api import ALPHA_MAX, TRANSMITTANCE_MIN
from pipelines.splat.rasterizer.cpu_lanes import (
    LANES,
    Lanes,
    any_positive,
    exp,
    jit,
    load,
    parallel_jit,
    splat,
    store,
    store_totals,
    where_greater,
    worker_jit,
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
    TILE_HEIGHT,
    TILE_WIDTH,
    X,
    Y,
    unpack_hit,
)

TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
# Hits between two checks which rows of the tile are not done yet.
HITS_PER_CHECK = 16

# Planes of a tile's scratch memory.
T, R, G, B, D, D2, MEDIAN, N_X, N_Y, N_Z = range(10)
FORWARD_PLANES = 10

# Colour, alpha, Σ w z, Σ w z², median depth and normal; ∂L/∂ all of them but the median depth.
_Images = tuple[ArrayHWC, ArrayHW, ArrayHW, ArrayHW, ArrayHW, ArrayHWC]
_ImageGradients = tuple[ArrayHWC, ArrayHW, ArrayHW, ArrayHW, ArrayHWC]


@jit
def pixel_centers(
    dtype: DTypeLike,  # of the pixels: float32 or float64
) -> Any:
    """Return the centres (LANES,) of a row's pixels, from its left end."""
    centers = np.empty(LANES, dtype)
    for lane in range(LANES):
        centers[lane] = lane + 0.5
    return centers


@jit
def row_exponent(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    index: int,
    dx: Lanes,  # px
    dy: float,  # px
) -> Any:
    """Return ln α of one splat along a row of pixels, before the cut-offs."""
    slanted = splat(table[index, FACTOR_XX]) * dx + splat(table[index, FACTOR_XY] * dy)
    vertical = table[index, FACTOR_YY] * dy
    return splat(table[index, LOG_OPACITY] - vertical * vertical) - slanted * slanted


@jit
def row_depth(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    index: int,
    dx: Lanes,  # px
    dy: float,  # px
) -> Any:
    """Return z of one splat along a row of pixels."""
    return splat(table[index, SLOPE_X]) * dx + splat(table[index, DEPTH] + table[index, SLOPE_Y] * dy)


@jit
def start_tile(
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    tile_x: int,
    tile_y: int,
    width: int,
    height: int,
) -> None:
    """Set T = 1 for pixels inside the image; pixels outside are done from the start. Other planes start at 0."""
    number = scratch.dtype.type
    for k in range(scratch.shape[0]):
        scratch[k] = 0
    for row in range(TILE_HEIGHT):
        for column in range(TILE_WIDTH):
            inside = tile_y + row < height and tile_x + column < width
            scratch[T * TILE_PIXELS + row * TILE_WIDTH + column] = number(1.0) if inside else number(-1.0)


@jit
def alive_rows(
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    top: int,
    bottom: int,
) -> Any:
    """Return first and last row of top … bottom with a pixel that is not done; top > bottom if there is none."""
    while top <= bottom and not any_positive(load(scratch, T * TILE_PIXELS + top * TILE_WIDTH)):
        top += 1
    while bottom > top and not any_positive(load(scratch, T * TILE_PIXELS + bottom * TILE_WIDTH)):
        bottom -= 1
    return top, bottom


@jit
def _blend_tile(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    first: int,
    last: int,
    tile_x: int,
    tile_y: int,
    depth: bool,
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    lane_x: ArrayN,  # (LANES,) float32/64
) -> int:
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
            if normals.shape[0] > 0:
                for axis in range(3):
                    plane = (N_X + axis) * TILE_PIXELS + at
                    store(scratch, plane, load(scratch, plane) + weight * splat(normals[index, axis]))
    return last


@jit
def _finish_tile(
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    tile_x: int,
    tile_y: int,
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
) -> None:
    colour, alpha, depth, depth2, median, normal = images
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
            if normal.shape[0] > 0:
                for axis in range(3):
                    normal[y, x, axis] = scratch[(N_X + axis) * TILE_PIXELS + at]


@worker_jit
def _blend(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    tile_start: ArrayN,  # (tiles + 1,) int64
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
    tile_end: ArrayN,  # (tiles,) int64
    worker: int,
    workers: int,
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
            table, normals, hits, tile_start[tile], tile_start[tile + 1], x, y, depth, scratch, lane_x
        )
        _finish_tile(scratch, x, y, background, images)


@parallel_jit
def blend(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    tile_start: ArrayN,  # (tiles + 1,) int64
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
    tile_end: ArrayN,  # (tiles,) int64
    workers: int,
) -> None:
    """Blend the splats of all tiles into images.

    Args:
        table, normals: (M, SPLAT_WIDTH) and (M or 0, 3) of the splats.
        hits: (H,) packed hits by tile, nearest first.
        tile_start: (tiles + 1,) into `hits`.
        background: (3,) float64.
        images: colour (H, W, 3), alpha (H, W), Σ w z (H, W), Σ w z² (H, W), median depth (H, W), normal (H, W, 3),
            written; depths and normal may have no pixels.
        tile_end: (tiles,) hit after the last one used, written.
        workers: number of threads.
    """
    for worker in prange(workers):
        _blend(table, normals, hits, tile_start, background, images, tile_end, np.int64(worker), workers)


# Planes of a tile's scratch memory beside `T`.
G_RED, G_GREEN, G_BLUE, G_DEPTH, G_DEPTH2, G_REST, REMAINING, G_NX, G_NY, G_NZ = range(1, 11)
BACKWARD_PLANES = 11

# Places in the gradient of one hit: Σ q and its moments in dx and dy, where q = ∂L/∂(exponent) at each pixel, and
# ∂L/∂ depth, its slopes and colour. The order is in fours, because sums are formed in fours.
Q, Q_X, Q_Y, Q_YY, Q_XX, Q_XY, D_DEPTH, D_SLOPE_X, D_RED, D_GREEN, D_BLUE, D_SLOPE_Y = range(12)
HIT_GRADIENT_WIDTH = 12
NORMAL_WIDTH = 4  # of ∂L/∂ normal of a hit, with a zero behind it


@jit
def _start_tile_gradient(
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    tile_x: int,
    tile_y: int,
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
    grads: _ImageGradients,  # (H, W, 3), 3 × (H, W), (H, W, 3) float32/64
) -> None:
    """Fill the scratch planes with the gradient of each pixel's colour, alpha and depth.

    With v_i = g·c_i + g_z z_i + g_zz z_i² + g_n·n_i − (g·background − g_alpha) the loss is Σ w_i v_i + constant.
    Background and alpha therefore need no further term. `REMAINING` starts as the whole sum.
    """
    colour, alpha, depth, depth2, _, normal = images
    g_colour, g_alpha, g_depth, g_depth2, g_normal = grads
    for row in range(min(TILE_HEIGHT, colour.shape[0] - tile_y)):
        for column in range(min(TILE_WIDTH, colour.shape[1] - tile_x)):
            at = row * TILE_WIDTH + column
            y, x = tile_y + row, tile_x + column
            red, green, blue = g_colour[y, x, 0], g_colour[y, x, 1], g_colour[y, x, 2]
            behind = red * background[0] + green * background[1] + blue * background[2]
            scratch[G_RED * TILE_PIXELS + at] = red
            scratch[G_GREEN * TILE_PIXELS + at] = green
            scratch[G_BLUE * TILE_PIXELS + at] = blue
            scratch[G_REST * TILE_PIXELS + at] = behind - g_alpha[y, x]
            whole = red * colour[y, x, 0] + green * colour[y, x, 1] + blue * colour[y, x, 2] - behind
            whole += g_alpha[y, x] * alpha[y, x]
            if depth.shape[0] > 0:
                scratch[G_DEPTH * TILE_PIXELS + at] = g_depth[y, x]
                scratch[G_DEPTH2 * TILE_PIXELS + at] = g_depth2[y, x]
                whole += g_depth[y, x] * depth[y, x] + g_depth2[y, x] * depth2[y, x]
            if normal.shape[0] > 0:
                for axis in range(3):
                    scratch[(G_NX + axis) * TILE_PIXELS + at] = g_normal[y, x, axis]
                    whole += g_normal[y, x, axis] * normal[y, x, axis]
            scratch[REMAINING * TILE_PIXELS + at] = whole


@jit
def _store_hit_gradient(
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    place: int,
    dx: Lanes,  # px
    moments: tuple[Lanes, Lanes, Lanes],  # Σ q, Σ q dy, Σ q dy²
    colour_and_depth: tuple[Lanes, Lanes, Lanes, Lanes, Lanes],  # red, green, blue, depth, slope y
) -> None:
    """Sum a hit's gradient over the columns, in each of which dx is constant."""
    q, qy, qyy = moments
    red, green, blue, depth, slope_y = colour_and_depth
    start, qx = place * HIT_GRADIENT_WIDTH, q * dx
    store_totals(gradient, start + Q, q, qx, qy, qyy)
    store_totals(gradient, start + Q_XX, qx * dx, qy * dx, depth, depth * dx)
    store_totals(gradient, start + D_RED, red, green, blue, slope_y)


@jit
def _blend_tile_gradient(  # noqa: PLR0915  (one loop, whose sums stay in registers)
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    first: int,
    last: int,
    tile_x: int,
    tile_y: int,
    depth: bool,
    scratch: ArrayN,  # (planes · TILE_PIXELS,) float32/64
    lane_x: ArrayN,  # (LANES,) float32/64
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    normal_gradient: ArrayN,  # (H · NORMAL_WIDTH or 0,) float32/64
) -> None:
    """Write the gradient of hits first … last − 1; `scratch` as `start_tile` and `_start_tile_gradient` left it.

    ∂L/∂α_i = T_i v_i − (Σ_{j>i} w_j v_j) / (1 − α_i), and q_i = ∂L/∂ln α_i = α_i ∂L/∂α_i.
    """
    number = table.dtype.type
    zero, one, t_min = splat(number(0.0)), splat(number(1.0)), splat(number(TRANSMITTANCE_MIN))
    cutoff, alpha_max = splat(number(LOG_ALPHA_MIN)), splat(number(ALPHA_MAX))
    pixel_x = load(lane_x, 0) + splat(number(tile_x))
    top, bottom = 0, TILE_HEIGHT - 1
    for place in range(first, last):
        if (place - first) % HITS_PER_CHECK == 0:
            top, bottom = alive_rows(scratch, top, bottom)
        index, first_row, last_row = unpack_hit(hits[place])
        red, green, blue = splat(table[index, RED]), splat(table[index, GREEN]), splat(table[index, BLUE])
        dx = pixel_x - splat(table[index, X])
        q_sum, qy_sum, qyy_sum, red_sum, green_sum, blue_sum, depth_sum, slope_y_sum, nx_sum, ny_sum, nz_sum = (
            zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
        )  # fmt: skip
        for row in range(max(first_row, top), min(last_row, bottom) + 1):
            at = row * TILE_WIDTH
            dy = number(tile_y + row) + number(0.5) - table[index, Y]
            exponent = row_exponent(table, index, dx, dy)
            free_alpha = exp(exponent)
            alpha = where_greater(free_alpha, alpha_max, alpha_max, free_alpha)
            alpha = where_greater(cutoff, exponent, zero, alpha)
            t = load(scratch, T * TILE_PIXELS + at)
            kept = one - alpha
            t_next = t * kept
            alpha = where_greater(t_next, t_min, alpha, zero)
            weight = alpha * t
            done = where_greater(t, zero, zero - t, t)
            store(scratch, T * TILE_PIXELS + at, where_greater(t_next, t_min, t_next, done))

            g_red = load(scratch, G_RED * TILE_PIXELS + at)
            g_green = load(scratch, G_GREEN * TILE_PIXELS + at)
            g_blue = load(scratch, G_BLUE * TILE_PIXELS + at)
            value = g_red * red + g_green * green + g_blue * blue - load(scratch, G_REST * TILE_PIXELS + at)
            if depth:
                z = row_depth(table, index, dx, dy)
                g_depth2 = z * load(scratch, G_DEPTH2 * TILE_PIXELS + at)
                g_depth = g_depth2 + load(scratch, G_DEPTH * TILE_PIXELS + at)
                value = value + g_depth * z
                g_depth = weight * (g_depth + g_depth2)
                depth_sum = depth_sum + g_depth
                slope_y_sum = slope_y_sum + g_depth * splat(dy)
            if normals.shape[0] > 0:
                g_nx = load(scratch, G_NX * TILE_PIXELS + at)
                g_ny = load(scratch, G_NY * TILE_PIXELS + at)
                g_nz = load(scratch, G_NZ * TILE_PIXELS + at)
                value = value + g_nx * splat(normals[index, 0]) + g_ny * splat(normals[index, 1])
                value = value + g_nz * splat(normals[index, 2])
                nx_sum, ny_sum, nz_sum = nx_sum + weight * g_nx, ny_sum + weight * g_ny, nz_sum + weight * g_nz
            part = weight * value
            remaining = load(scratch, REMAINING * TILE_PIXELS + at) - part
            store(scratch, REMAINING * TILE_PIXELS + at, remaining)
            q = where_greater(free_alpha, alpha_max, zero, part - remaining * (alpha / kept))
            qy = q * splat(dy)
            q_sum = q_sum + q
            qy_sum = qy_sum + qy
            qyy_sum = qyy_sum + qy * splat(dy)
            red_sum = red_sum + weight * g_red
            green_sum = green_sum + weight * g_green
            blue_sum = blue_sum + weight * g_blue
        colour_and_depth = (red_sum, green_sum, blue_sum, depth_sum, slope_y_sum)
        _store_hit_gradient(gradient, place, dx, (q_sum, qy_sum, qyy_sum), colour_and_depth)
        if normals.shape[0] > 0:
            store_totals(normal_gradient, place * NORMAL_WIDTH, nx_sum, ny_sum, nz_sum, zero)


@worker_jit
def _blend_gradient(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    tile_start: ArrayN,  # (tiles + 1,) int64
    tile_end: ArrayN,  # (tiles,) int64
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
    grads: _ImageGradients,  # (H, W, 3), 3 × (H, W), (H, W, 3) float32/64
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    normal_gradient: ArrayN,  # (H · NORMAL_WIDTH or 0,) float32/64
    worker: int,
    workers: int,
) -> None:
    height, width = images[1].shape
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    depth = images[2].shape[0] > 0
    scratch = np.empty(BACKWARD_PLANES * TILE_PIXELS, table.dtype)
    lane_x = pixel_centers(table.dtype)
    for tile in range(worker, tile_end.shape[0], workers):
        x, y = tile % columns * TILE_WIDTH, tile // columns * TILE_HEIGHT
        start_tile(scratch, x, y, width, height)
        _start_tile_gradient(scratch, x, y, background, images, grads)
        _blend_tile_gradient(table, normals, hits, tile_start[tile], tile_end[tile], x, y, depth, scratch, lane_x,
                             gradient, normal_gradient)  # fmt: skip
        for k in range(tile_end[tile] * HIT_GRADIENT_WIDTH, tile_start[tile + 1] * HIT_GRADIENT_WIDTH):
            gradient[k] = 0
        if normals.shape[0] > 0:
            for k in range(tile_end[tile] * NORMAL_WIDTH, tile_start[tile + 1] * NORMAL_WIDTH):
                normal_gradient[k] = 0


@parallel_jit
def blend_gradient(
    table: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    hits: ArrayN,  # (H,) int64
    tile_start: ArrayN,  # (tiles + 1,) int64
    tile_end: ArrayN,  # (tiles,) int64
    background: ArrayN,  # (3,) float64
    images: _Images,  # (H, W, 3), 4 × (H, W), (H, W, 3) float32/64
    grads: _ImageGradients,  # (H, W, 3), 3 × (H, W), (H, W, 3) float32/64
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    normal_gradient: ArrayN,  # (H · NORMAL_WIDTH or 0,) float32/64
    workers: int,
) -> None:
    """Write the derivative of `blend`.

    Args:
        table, normals, hits, tile_start, tile_end, background, images: arguments and results of `blend`.
        grads: ∂L/∂ colour (H, W, 3), alpha (H, W), Σ w z and Σ w z² (H, W or 0, 0), normal (H, W, 3 or 0, 0, 3).
        gradient, normal_gradient: (H · HIT_GRADIENT_WIDTH,) and (H · NORMAL_WIDTH or 0,) of the hits in order,
            written.
        workers: number of threads.
    """
    for worker in prange(workers):
        _blend_gradient(
            table, normals, hits, tile_start, tile_end, background, images, grads, gradient, normal_gradient,
            np.int64(worker), workers,
        )  # fmt: skip
