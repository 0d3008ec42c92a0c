"""Kernels of the fusion: the pixels of a depth map that are candidates of a square, and means over voxels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.core.types import (
    Array33,
    ArrayHW,
    ArrayHWC,
    ArrayN,
    ArrayN3,
    ArrayNK,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)
from pipelines.geometry.footprints import voxel_keys
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

_MOST_KEYS = 2**62  # of voxels, without overflow of int64
_HASH = 0x9E3779B97F4A7C15 - 2**64  # multiplicative hashing: 2⁶⁴ over the golden ratio


@dataclass(frozen=True)
class PixelLimits:
    """Limits of the pixels that are candidates."""

    reach_px: int  # from a pixel to those whose differences give its normal
    bend: float  # of |z/z₁ + z/z₂ − 2| for a depth z between opposite neighbours z₁, z₂
    grazing: float  # least cosine between ray and normal
    coarsest_m: float  # wider pixels are left out
    step: int  # between the rows, and the columns, that are used
    look_px: int  # between the pixels that are tested for lying in the square


def chosen_pixels(
    depth: Float32Array,
    rgb: ByteArray,
    intrinsics_px: FloatArray,
    turn: FloatArray,
    center: FloatArray,
    scale: float,
    box: FloatArray,
    limits: PixelLimits,
) -> tuple[FloatArray, FloatArray, ByteArray, FloatArray]:
    """Return places (K, 3), normals (K, 3) towards the camera, colours (K, 3), and widths (K,) of pixels in a box.

    A pixel is chosen if the surface around it is smooth: its normal is known, and does not graze.

    Args:
        depth, rgb: (H, W) and (H, W, 3) of a view.
        intrinsics_px: (4,) fx, fy, cx, cy.
        turn, center: (3, 3) directions of the camera in the points' frame, times their scale, and its place (3,).
        scale: metres of the points' frame in a unit of depth.
        box: (4,) least east and north, and what these stay below.
        limits: of the pixels.
    """
    window = (limits.reach_px, limits.step, limits.look_px)
    pixels: tuple[FloatArray, FloatArray, ByteArray, FloatArray] = _chosen(
        depth, rgb, intrinsics_px, turn, center, scale, box, window, limits.bend, limits.grazing, limits.coarsest_m
    )
    return pixels


@njit(nogil=True, error_model="numpy")
def _surface_at(
    depth: ArrayHW,  # (H, W) float32
    row: int,
    column: int,
    lens: ArrayN,  # (4,) float64
    turn: Array33,  # (3, 3) float64
    center: ArrayN,  # (3,) float64
) -> tuple[float, float, float]:
    """Return the place of a pixel's surface."""
    z = np.float64(depth[row, column])
    x, y = z * ((column + 0.5 - lens[2]) / lens[0]), z * ((row + 0.5 - lens[3]) / lens[1])
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + center[0],
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + center[1],
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + center[2],
    )


@njit(nogil=True, error_model="numpy")
def _window(
    depth: ArrayHW,  # (H, W) float32
    lens: ArrayN,  # (4,) float64
    turn: Array33,  # (3, 3) float64
    center: ArrayN,  # (3,) float64
    box: ArrayN,  # (4,) float64
    reach: int,
    look: int,
) -> tuple[int, int, int, int]:
    """Return the rows and columns that show a box; parts narrower than `look` may be missed."""
    height, width = depth.shape
    top, bottom, left, right = height, -1, width, -1
    for row in range(0, height, look):
        for column in range(0, width, look):
            if depth[row, column] == 0:
                continue
            east, north, _ = _surface_at(depth, row, column, lens, turn, center)
            if east >= box[0] and north >= box[1] and east < box[2] and north < box[3]:
                top, bottom = min(top, row), max(bottom, row)
                left, right = min(left, column), max(right, column)
    if bottom < 0:
        return 0, 0, 0, 0
    spare = look + reach
    return (
        max(top - spare, 0),
        min(bottom + spare + 1, height),
        max(left - spare, 0),
        min(right + spare + 1, width),
    )


@kernel(nogil=True, error_model="numpy")
def _chosen(
    depth: ArrayHW,  # (H, W) float32
    rgb: ArrayHWC,  # (H, W, 3) uint8
    lens: ArrayN,  # (4,) float64
    turn: Array33,  # (3, 3) float64
    center: ArrayN,  # (3,) float64
    scale: float,
    box: ArrayN,  # (4,) float64
    window: tuple[int, int, int],  # reach, step, look, px
    most_bend: float,
    grazing: float,
    coarsest_m: float,
) -> Any:
    """Return what `chosen_pixels` does."""
    reach, step, look = window
    top, bottom, left, right = _window(depth, lens, turn, center, box, reach, look)
    most = (max(bottom - top, 0) // step + 1) * (max(right - left, 0) // step + 1)
    position, normal = np.empty((most, 3)), np.empty((most, 3))
    colour, pixel_m = np.empty((most, 3), np.uint8), np.empty(most)
    count, first = 0, step // 2
    for row in range(top + reach + (first - top - reach) % step, bottom - reach, step):
        for column in range(left + reach + (first - left - reach) % step, right - reach, step):
            own = np.float64(depth[row, column])  # `float` keeps the 32 bits
            size_m = scale * own / lens[0]
            if not (own > 0 and size_m < coarsest_m):
                continue
            x, y, z = _surface_at(depth, row, column, lens, turn, center)
            if not (x >= box[0] and y >= box[1] and x < box[2] and y < box[3]):
                continue
            # As `agreement.bends`, of one pixel.
            bend = max(
                abs(own / depth[row, column - reach] + own / depth[row, column + reach] - 2),
                abs(own / depth[row - reach, column] + own / depth[row + reach, column] - 2),
            )
            if not bend < most_bend:
                continue
            a, b, c = _surface_at(depth, row, column + reach, lens, turn, center)
            i, j, k = _surface_at(depth, row, column - reach, lens, turn, center)
            a, b, c = a - i, b - j, c - k  # to the right
            d, e, f = _surface_at(depth, row + reach, column, lens, turn, center)
            i, j, k = _surface_at(depth, row - reach, column, lens, turn, center)
            d, e, f = d - i, e - j, f - k  # downwards
            i, j, k = b * f - c * e, c * d - a * f, a * e - b * d
            length = np.sqrt(i * i + j * j + k * k)
            if not length > 0:
                continue
            i, j, k = i / length, j / length, k / length
            east, north, up = center[0] - x, center[1] - y, center[2] - z
            cosine = (i * east + j * north + k * up) / np.sqrt(east * east + north * north + up * up)
            if not abs(cosine) > grazing:
                continue
            sign = 1.0 if cosine > 0 else -1.0
            position[count, 0], position[count, 1], position[count, 2] = x, y, z
            normal[count, 0], normal[count, 1], normal[count, 2] = sign * i, sign * j, sign * k
            colour[count] = rgb[row, column]
            pixel_m[count] = size_m
            count += 1
    return position[:count].copy(), normal[:count].copy(), colour[:count].copy(), pixel_m[:count].copy()


def voxel_means(side_m: float, position: FloatArray, *values: NDArray[Any]) -> list[FloatArray]:
    """Return the means of values (P, …) over the voxels that hold points (P, 3): (V, …) each."""
    if not len(position):
        return [np.zeros(value.shape) for value in values]
    voxel, count = _members(_keys(np.ascontiguousarray(position, dtype=np.float64), side_m))
    means = []
    for value in values:
        sums = np.zeros((len(count), int(np.prod(value.shape[1:]))))
        _add_rows(voxel, np.ascontiguousarray(value).reshape(len(value), -1), sums)
        sums /= count[:, None]
        means.append(sums.reshape(-1, *value.shape[1:]))
    return means


def _keys(position: FloatArray, side_m: float) -> IntArray:
    """Return a number (P,) for the voxel of each point, in the order of the voxels, as `voxel_keys` does."""
    low, extent = _extent(position, side_m)
    if not (np.isfinite(extent).all() and np.prod(extent) < _MOST_KEYS):
        return voxel_keys(position, side_m)
    return np.asarray(_numbered(position, side_m, low, extent.astype(np.int64)))


@kernel(nogil=True, error_model="numpy")
def _extent(
    position: ArrayN3,  # (P, 3) float64
    side_m: float,
) -> Any:
    """Return the least voxel (3,) of points, and how many there are (3,) along each axis."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for row in range(len(position)):
        for k in range(3):
            voxel = np.floor(position[row, k] / side_m)
            low[k], high[k] = min(low[k], voxel), max(high[k], voxel)
    return low, high - low + 1


@kernel(nogil=True, error_model="numpy")
def _numbered(
    position: ArrayN3,  # (P, 3) float64
    side_m: float,
    low: ArrayN,  # (3,) float64
    extent: ArrayN,  # (3,) int64
) -> Any:
    key = np.empty(len(position), np.int64)
    for row in range(len(position)):
        number = 0
        for k in range(3):
            number = number * extent[k] + np.int64(np.floor(position[row, k] / side_m) - low[k])
        key[row] = number
    return key


def _members(key: IntArray) -> tuple[IntArray, IntArray]:
    """Return the number (P,) of each key's voxel, in ascending order of the keys, and how many have it (V,)."""
    first, own, count = _hashed(key)
    order = np.argsort(own)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank[first], count[order]


@kernel(nogil=True, error_model="numpy")
def _hashed(
    key: IntArray,  # (P,) int64
) -> Any:
    """Return the number (P,) of each key among the different ones, in the order of their first, these, and counts.

    An open hash table is twice as fast as sorting: a voxel has dozens of points.
    """
    bits = 10
    table = np.full(1 << bits, -1, np.int64)
    own, count = np.empty(1 << (bits - 1), np.int64), np.empty(1 << (bits - 1), np.int64)
    member, used = np.empty(len(key), np.int64), 0
    for row in range(len(key)):
        if used == len(own):  # half full
            bits += 1
            more, counted = np.empty(1 << (bits - 1), np.int64), np.empty(1 << (bits - 1), np.int64)
            more[:used], counted[:used] = own, count
            own, count = more, counted
            table = np.full(1 << bits, -1, np.int64)
            for number in range(used):
                table[_slot(table, own, own[number], bits)] = number
        slot = _slot(table, own, key[row], bits)
        if table[slot] < 0:
            table[slot], own[used], count[used] = used, key[row], 0
            used += 1
        member[row] = table[slot]
        count[table[slot]] += 1
    return member, own[:used].copy(), count[:used].copy()


@njit(nogil=True, error_model="numpy")
def _slot(
    table: IntArray,  # (T,) int64
    own: IntArray,  # (K,) int64
    key: int,
    bits: int,
) -> Any:
    """Return the place of a key in the table, or the free one that it takes."""
    mask = len(table) - 1
    slot = np.int64(np.uint64(key * _HASH) >> np.uint64(64 - bits))
    while table[slot] >= 0 and own[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@kernel(nogil=True, error_model="numpy")
def _add_rows(
    voxel: ArrayN,  # (P,) int64
    values: ArrayNK,  # (P, K) of any type
    sums: ArrayNK,  # (V, K) float64
) -> None:
    """Add values (P, K) to the sums (V, K) of their voxels."""
    for row in range(len(values)):
        for k in range(values.shape[1]):
            sums[voxel[row], k] += values[row, k]
