"""Numba kernels that find the visible Gaussians, fill the tables for blending, and list the splats of each tile.

Tables are in the order of the Gaussians: neighbours in memory are mostly neighbours in the image, and the splats of
a tile lie together. The lists are a parallel counting sort, nearest first. An ellipse is cut into the columns of
tiles that it crosses. Its extreme rows within a column have a closed form. A tile is therefore listed only if the
ellipse enters it, with exactly the rows that the ellipse enters (the idea of AccuTile, doi
10.48550/arXiv.2412.00578).
"""

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.core.types import Array34, ArrayN, ArrayN3, ArrayN4, ArrayNK, ArrayNK3, Vector2, Vector3
from pipelines.splat.rasterizer import cpu_gaussian as gaussian
from pipelines.splat.rasterizer.api import ALPHA_MIN
from pipelines.splat.rasterizer.cpu_gaussian import MAX_COEFFICIENTS, WIDEST, View
from pipelines.splat.rasterizer.cpu_lanes import LANES, jit, kernel_jit, parallel_jit, worker_jit

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
LOGIT_ALPHA_MIN = math.log(ALPHA_MIN / (1 - ALPHA_MIN))
# Gaussians that one worker takes at a time. Blocks are dealt out in turn, because visible Gaussians come in
# clusters.
BLOCK = 256
_ORDINARY = 100.0  # a size of which neither squares nor exponentials overflow in float64

# Columns of the table of splats that blending reads: centre, factor of the conic (see `_write_splat`),
# logarithm of the opacity, colour, depth of the centre, slope of the depth in metres per pixel.
X, Y, FACTOR_XX, FACTOR_XY, FACTOR_YY, LOG_OPACITY, RED, GREEN, BLUE, DEPTH, SLOPE_X, SLOPE_Y = range(12)
SPLAT_WIDTH = 12
# Columns of the table of ellipses that binning reads: centre, covariance, squared Mahalanobis radius.
E_X, E_Y, E_XX, E_XY, E_YY, E_LEVEL = range(6)
ELLIPSE_WIDTH = 6


@jit
def _ellipse(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    pose: Array34,  # (3, 4) float64
    view: View,
    i: int,
) -> Any:
    """Return the point in the camera's frame, screen covariance and slope of the depth of Gaussian i."""
    point = gaussian.transformed_point(pose, gaussian.row3(means, i))
    quat, _ = gaussian.unit_quat(quats, i)
    w = gaussian.screen_from_model(gaussian.jacobian(view, point), pose)
    axes = gaussian.times_rotation(w, gaussian.rotation(quat))
    variance = gaussian.variances(log_scales, i)
    cov = gaussian.screen_covariance(axes, variance, view.dilation)
    return point, cov, gaussian.depth_slope(axes, variance, cov, view.dilation, point[2])


@jit
def _holds_pixel(center: float, extent: float, size: float) -> bool:
    """Return whether a pixel centre 0.5, 1.5 … size − 0.5 lies within `extent` of `center`."""
    first = max(math.ceil(center - extent - 0.5), 0.0)
    last = min(math.floor(center + extent - 0.5), size - 1.0)
    return first <= last


@jit
def _may_reach_image(point: Vector3, largest_log_scale: float, view: View) -> bool:
    """Return False only if a sphere around the Gaussian surely projects outside the image: a cheap first test."""
    x, y, z = point
    sigma = math.exp(largest_log_scale) / z
    reach_x = WIDEST * math.sqrt(view.stretch_x * view.stretch_x * sigma * sigma + view.dilation)
    reach_y = WIDEST * math.sqrt(view.stretch_y * view.stretch_y * sigma * sigma + view.dilation)
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    return -reach_x <= u <= view.width + reach_x and -reach_y <= v <= view.height + reach_y


@jit
def _is_visible(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit: float,
    pose: Array34,  # (3, 4) float64
    view: View,
    i: int,
) -> bool:
    """Return whether the ellipse in which Gaussian i reaches ALPHA_MIN has a pixel in its bounding box.

    Comparisons are written so that NaN anywhere makes the Gaussian invisible.
    """
    point, (xx, xy, yy), _ = _ellipse(means, quats, log_scales, pose, view, i)
    if not (xx * yy - xy * xy > 0.0 and xx < math.inf and yy < math.inf):
        return False
    level = 2.0 * (gaussian.log_opacity(logit, (xx, xy, yy), view) - LOG_ALPHA_MIN)
    if not level >= 0.0:
        return False
    u = view.fx * point[0] / point[2] + view.cx
    v = view.fy * point[1] / point[2] + view.cy
    return _holds_pixel(u, math.sqrt(level * xx), view.width) and _holds_pixel(
        v, math.sqrt(level * yy), view.height
    )


@jit
def _is_surely_visible(
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit: float,
    point: Vector3,
    view: View,
    i: int,
) -> bool:
    """Return True only for a centre in the image whose ellipse holds a pixel by the image's dilation alone.

    With the filter, opacities depend on the ellipse.

    An ellipse that reaches half a pixel each way holds one. This test of most Gaussians is cheaper than their
    ellipse, and is False where an infinite or NaN quaternion or scale would make that invisible.
    """
    u = view.fx * point[0] / point[2] + view.cx
    v = view.fy * point[1] / point[2] + view.cy
    level = 2.0 * (gaussian.log_sigmoid(logit) - LOG_ALPHA_MIN)
    a, b, c = gaussian.row3(log_scales, i)
    turn = abs(quats[i, 0]) + abs(quats[i, 1]) + abs(quats[i, 2]) + abs(quats[i, 3])
    return (
        not view.mip_filter
        and 0.0 <= u <= view.width
        and 0.0 <= v <= view.height
        and level * view.dilation >= 0.25
        and abs(a) + abs(b) + abs(c) < _ORDINARY
        and turn < _ORDINARY
    )


@worker_jit
def _find_visible(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    pose: Array34,  # (3, 4) float64
    view: View,
    roughly: bool,
    visible: ArrayN,  # (N,) bool
    depth: ArrayN,  # (N,) float32/64
    worker: int,
    workers: int,
) -> None:
    for block in range(worker, (means.shape[0] + BLOCK - 1) // BLOCK, workers):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, means.shape[0])):
            visible[i] = False
            point = gaussian.transformed_point(pose, gaussian.row3(means, i))
            logit = float(logit_opacities[i])
            if not (point[2] >= view.near and logit >= LOGIT_ALPHA_MIN):
                continue
            a, b, c = gaussian.row3(log_scales, i)
            if _may_reach_image(point, max(a, b, c), view):
                visible[i] = (
                    roughly
                    or _is_surely_visible(quats, log_scales, logit, point, view, i)
                    or _is_visible(means, quats, log_scales, logit, pose, view, i)
                )
                depth[i] = point[2]


@parallel_jit
def find_visible(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    pose: Array34,  # (3, 4) float64
    view: View,
    roughly: bool,
    visible: ArrayN,  # (N,) bool
    depth: ArrayN,  # (N,) float32/64
    workers: int,
) -> None:
    """Write the visibility (N,) of N Gaussians, and the depth (N,) of the visible, on `workers` threads.

    Found `roughly`, more are visible than touch the image, for less work.
    """
    for worker in prange(workers):
        _find_visible(
            means, quats, log_scales, logit_opacities, pose, view, roughly, visible, depth, np.int64(worker),
            workers,
        )  # fmt: skip


@jit
def _write_splat(
    splats: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    row: int,
    center: Vector2,
    cov: Vector3,
    log_opacity: float,
) -> None:
    """Fill the rows for blending (without colour, depth and slope) and for binning.

    The conic is kept as the factor of ½ Σ⁻¹: the exponent is −(f_xx dx + f_xy dy)² − (f_yy dy)². This form does not
    cancel catastrophically for long thin Gaussians, as the polynomial does.
    """
    xx, xy, yy = cov
    determinant = xx * yy - xy * xy
    factor_xx = math.sqrt(0.5 * yy / determinant)
    splats[row, X], splats[row, Y] = center
    splats[row, FACTOR_XX] = factor_xx
    splats[row, FACTOR_XY] = -0.5 * xy / (determinant * factor_xx)
    splats[row, FACTOR_YY] = math.sqrt(0.5 / yy)
    splats[row, LOG_OPACITY] = log_opacity
    ellipses[row, E_X], ellipses[row, E_Y] = center
    ellipses[row, E_XX], ellipses[row, E_XY], ellipses[row, E_YY] = xx, xy, yy
    ellipses[row, E_LEVEL] = 2.0 * (log_opacity - LOG_ALPHA_MIN)


@worker_jit
def _project_visible(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    sh: ArrayNK3,  # (N, K, 3) float32/64
    pose: Array34,  # (3, 4) float64
    center: ArrayN,  # (3,) float64
    view: View,
    degree: int,
    visible: ArrayN,  # (M,) int64
    splats: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    worker: int,
    workers: int,
) -> None:
    basis = np.empty(MAX_COEFFICIENTS)
    count = visible.shape[0]
    for block in range(worker, (count + BLOCK - 1) // BLOCK, workers):
        for row in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            i = visible[row]
            (x, y, z), cov, slope = _ellipse(means, quats, log_scales, pose, view, i)
            on_screen = (view.fx * x / z + view.cx, view.fy * y / z + view.cy)
            log_opacity = gaussian.log_opacity(float(logit_opacities[i]), cov, view)
            _write_splat(splats, ellipses, row, on_screen, cov, log_opacity)
            direction, _ = gaussian.unit_direction(gaussian.row3(means, i), center)
            gaussian.sh_basis(direction, degree, basis)
            red, green, blue = gaussian.sh_colour(sh, i, basis, (degree + 1) ** 2)
            splats[row, RED] = max(red, 0.0)
            splats[row, GREEN] = max(green, 0.0)
            splats[row, BLUE] = max(blue, 0.0)
            splats[row, DEPTH] = z
            splats[row, SLOPE_X], splats[row, SLOPE_Y] = slope
            if normals.shape[0] > 0:
                turn = gaussian.rotation(gaussian.unit_quat(quats, i)[0])
                axis = gaussian.shortest_axis(log_scales, i)
                normal, _ = gaussian.facing_normal(turn, axis, direction)
                normals[row, 0], normals[row, 1], normals[row, 2] = normal


@parallel_jit
def project_visible(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    sh: ArrayNK3,  # (N, K, 3) float32/64
    pose: Array34,  # (3, 4) float64
    center: ArrayN,  # (3,) float64
    view: View,
    degree: int,
    visible: ArrayN,  # (M,) int64
    splats: ArrayNK,  # (M, SPLAT_WIDTH) float32/64
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    normals: ArrayN3,  # (M or 0, 3) float32/64
    workers: int,
) -> None:
    """Fill the tables of the M visible Gaussians.

    Args:
        means, quats, log_scales, logit_opacities, sh: of the N Gaussians.
        pose, center: (3, 4) and, in the model's frame, (3,).
        view: camera.
        degree: of the spherical harmonics in use.
        visible: (M,) rows of the Gaussians, ascending.
        splats, ellipses: (M, SPLAT_WIDTH), (M, ELLIPSE_WIDTH) in the order of `visible`, written.
        normals: (M, 3), see `Render.normal`, written; (0, 3): not wanted.
    """
    for worker in prange(workers):
        _project_visible(
            means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible, splats, ellipses,
            normals, np.int64(worker), workers,
        )  # fmt: skip


TILE_WIDTH = LANES
TILE_HEIGHT = 32
# Number of runs of the depth order in which splats are counted and written, whatever the number of threads.
RUNS = 32


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Return the numbers of tiles, across and down, that cover an image of so many pixels."""
    return -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)


@jit
def pack_hit(splat: int, first_row: int, last_row: int) -> int:
    """Pack a splat in a tile with the first and last of the tile's rows that it touches."""
    return (splat << 16) | (first_row << 8) | last_row


@jit
def unpack_hit(hit: int) -> Any:
    """Return the three parts of a packed hit: the high bits from 16 on, then two bytes."""
    return hit >> 16, (hit >> 8) & 255, hit & 255


@jit
def _clamp_to_int(value: float, low: int, high: int) -> int:
    return int(min(max(value, float(low)), float(high)))


@jit
def _column_span(
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    splat: int,
    width: int,
) -> Any:
    """Return the first and last column of tiles; first > last if there is none."""
    x = float(ellipses[splat, E_X])
    extent = math.sqrt(float(ellipses[splat, E_LEVEL]) * float(ellipses[splat, E_XX]))
    first = _clamp_to_int(math.ceil(x - extent - 0.5), 0, width)
    last = _clamp_to_int(math.floor(x + extent - 0.5), -1, width - 1)
    if first > last:
        return 0, -1
    return first // TILE_WIDTH, last // TILE_WIDTH


@jit
def _row_span(
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    splat: int,
    column: int,
    height: int,
) -> Any:
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
def _count_hits(
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    order: ArrayN,  # (M,) int64
    width: int,
    height: int,
    per_tile: ArrayNK,  # (RUNS, tiles) int64
    per_splat: ArrayN,  # (M,) int64
    run: int,
) -> None:
    splats = order.shape[0]
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for tile in range(per_tile.shape[1]):
        per_tile[run, tile] = 0
    for rank in range(splats * run // RUNS, splats * (run + 1) // RUNS):
        splat, hits = order[rank], 0
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
def count_hits(
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    order: ArrayN,  # (M,) int64
    width: int,
    height: int,
    per_tile: ArrayNK,  # (RUNS, tiles) int64
    per_splat: ArrayN,  # (M,) int64
) -> None:
    """Count the tiles of splats (M, ELLIPSE_WIDTH), nearest first in `order` (M,), in an image of some pixels.

    Hits of each run in each tile (RUNS, tiles), and hits of each splat (M,), are written.
    """
    for run in prange(RUNS):
        _count_hits(ellipses, order, width, height, per_tile, per_splat, np.int64(run))


@kernel_jit
def starts_from_counts(
    per_tile: ArrayNK,  # (RUNS, tiles) int64
    tile_start: ArrayN,  # (tiles + 1,) int64
) -> None:
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
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    order: ArrayN,  # (M,) int64
    width: int,
    height: int,
    next_place: ArrayNK,  # (RUNS, tiles) int64
    splat_start: ArrayN,  # (M + 1,) int64
    hits: ArrayN,  # (H,) int64
    places: ArrayN,  # (H,) int64
    run: int,
) -> None:
    splats = order.shape[0]
    columns = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for rank in range(splats * run // RUNS, splats * (run + 1) // RUNS):
        splat = order[rank]
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
    ellipses: ArrayNK,  # (M, ELLIPSE_WIDTH) float32/64
    order: ArrayN,  # (M,) int64
    width: int,
    height: int,
    next_place: ArrayNK,  # (RUNS, tiles) int64
    splat_start: ArrayN,  # (M + 1,) int64
    hits: ArrayN,  # (H,) int64
    places: ArrayN,  # (H,) int64
) -> None:
    """List the splats of each tile, nearest first, and the places of each splat in those lists.

    Args:
        ellipses, order, width, height: as in `count_hits`.
        next_place: (RUNS, tiles) from `starts_from_counts`, overwritten.
        splat_start: (M + 1,) start of each splat in `places`.
        hits, places: (H,) packed hits by tile, and places in `hits` by splat, written.
    """
    for run in prange(RUNS):
        _list_hits(ellipses, order, width, height, next_place, splat_start, hits, places, np.int64(run))
