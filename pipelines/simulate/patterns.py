"""Building blocks of procedural textures, faded out where they are finer than a pixel.

A texture that aliases gives every photograph other features at the same place. Every pattern therefore takes the
width of the pixel on the surface, and filters itself: a box filter for stripes, fading for noise and random cells.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.types import ByteArray, Float32Array

_LATTICE, _UPSAMPLE = 128, 4
Image = ByteArray | Float32Array
_WIDTH = 256  # width of the image into which samples are arranged for cv2.remap


def _noise_table() -> Float32Array:
    """Return a periodic image of smooth noise in 0…1; part of the algorithm, hence of fixed seed."""
    lattice = np.random.default_rng(20260112).random((_LATTICE, _LATTICE)).astype(np.float32)
    padded = np.pad(lattice, 4, mode="wrap")
    size = (_LATTICE + 8) * _UPSAMPLE
    smooth = cv2.resize(padded, (size, size), interpolation=cv2.INTER_CUBIC)
    crop = 4 * _UPSAMPLE
    return np.ascontiguousarray(smooth[crop:-crop, crop:-crop])


_NOISE = _noise_table()


def sample(image: Image, x: Float32Array, y: Float32Array, *, wrap: bool) -> Float32Array:
    """Return bilinear samples of an image at pixel coordinates (N,), as float32 (N,) or (N, channels)."""
    count = len(x)
    rows = max(1, -(-count // _WIDTH))
    maps = np.zeros((2, rows * _WIDTH), dtype=np.float32)
    maps[0, :count], maps[1, :count] = x, y
    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    grids = maps.reshape(2, rows, _WIDTH)
    samples = cv2.remap(image, grids[0], grids[1], cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(samples.reshape(rows * _WIDTH, *samples.shape[2:])[:count], dtype=np.float32)


def visible(size: float, pixel: Float32Array) -> Float32Array:
    """Return the contrast, 0…1, of a pattern of period 2 · `size` metres in pixels of width `pixel` (N,)."""
    return np.clip((2.0 * size / np.maximum(pixel, 1e-6) - 1.5) / 1.5, 0.0, 1.0).astype(np.float32)


def noise(u: Float32Array, v: Float32Array, size: float, pixel: Float32Array) -> Float32Array:
    """Return smooth noise (N,) in about −0.5…0.5 with blobs of `size` metres."""
    strength = visible(size, pixel)
    shown = np.nonzero(strength)[0]
    if len(shown) < len(strength):  # noise that is too fine to be visible need not be looked up
        value = np.zeros_like(strength)
        if len(shown):
            value[shown] = _look_up(u[shown], v[shown], size) * strength[shown]
        return value
    return _look_up(u, v, size) * strength


def _look_up(u: Float32Array, v: Float32Array, size: float) -> Float32Array:
    scale = np.float32(_UPSAMPLE / size)
    period = np.float32(_LATTICE * _UPSAMPLE)
    # The modulo is written out: np.mod takes longer than the look-up, and cv2.remap has 16-bit coordinates only.
    x, y = u * scale, v * scale
    x -= period * np.floor(x / period)
    y -= period * np.floor(y / period)
    return sample(_NOISE, x, y, wrap=True) - np.float32(0.5)


def fbm(
    u: Float32Array, v: Float32Array, sizes: tuple[float, ...], pixel: Float32Array, gain: float = 0.8
) -> Float32Array:
    """Return noise (N,) of several sizes, each `gain` times as strong as the size before."""
    total = np.zeros_like(u)
    strength = 1.0
    for i, size in enumerate(sizes):
        shift = np.float32(17.31 * i)
        # Each octave is turned, so that the lattices do not line up.
        turned_u, turned_v = u * np.float32(0.8) + v * np.float32(0.6), v * np.float32(0.8) - u * np.float32(0.6)
        u, v = turned_u, turned_v
        total += np.float32(strength) * noise(u + shift, v - shift, size, pixel)
        strength *= gain
    return total


def cell_random(i: Float32Array, j: Float32Array, salt: int) -> Float32Array:
    """Return a random number (N,) in 0…1 for every cell (i, j) of whole numbers."""
    bits = i.astype(np.int32).view(np.uint32) * np.uint32(374761393)
    bits += j.astype(np.int32).view(np.uint32) * np.uint32(668265263)
    bits += np.uint32(salt * 2654435761 & 0xFFFFFFFF)
    bits = (bits ^ (bits >> np.uint32(13))) * np.uint32(1274126177)
    bits ^= bits >> np.uint32(16)
    return (bits >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def stripes(x: Float32Array, period: ArrayLike, width: ArrayLike, pixel: Float32Array) -> Float32Array:
    """Return the share (N,) of the pixel covered by stripes [0, width) of every period, box-filtered exactly."""
    every, wide = np.asarray(period, dtype=np.float32), np.asarray(width, dtype=np.float32)
    reach = np.maximum(pixel, np.float32(1e-4)).astype(np.float32)

    def covered(end: NDArray[np.floating[Any]]) -> Float32Array:
        whole = np.floor(end / every)
        return np.asarray(whole * wide + np.minimum(end - whole * every, wide))

    low, high = covered(x - reach / np.float32(2)), covered(x + reach / np.float32(2))
    return np.asarray(np.clip((high - low) / reach, 0.0, 1.0).astype(np.float32))


def band(x: Float32Array, low: ArrayLike, high: ArrayLike, pixel: Float32Array) -> Float32Array:
    """Return the share (N,) of the pixel that lies in low…high, box-filtered exactly."""
    reach = np.maximum(pixel, np.float32(1e-4))
    half = reach / np.float32(2)
    low, high = np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)
    inside = np.minimum(x + half, high) - np.maximum(x - half, low)
    return np.asarray(np.clip(inside / reach, 0.0, 1.0).astype(np.float32))


def mix(a: Float32Array, b: Float32Array, share: Float32Array) -> Float32Array:
    """Return a (N, 3) and b (N, 3) or (3,), blended by `share` (N,) of b."""
    return np.asarray(a + (b - a) * share[:, None])


class Pyramid:
    """Image pyramid, for sampling at any distance.

    Args:
        image: (H, W, 3) uint8.
        pixel_m: size of its pixels.
    """

    def __init__(self, image: ByteArray, pixel_m: float) -> None:
        self._pixel_m = pixel_m
        self._levels = [image]
        while min(self._levels[-1].shape[:2]) > 16:
            height, width = self._levels[-1].shape[:2]
            smaller = cv2.resize(self._levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(smaller, dtype=np.uint8))

    def sample(self, u: Float32Array, v: Float32Array, pixel: Float32Array) -> Float32Array:
        """Return values (N, 3) in 0…1 at (u, v) metres from the image's centre, filtered to `pixel` (N,) metres."""
        level = np.clip(np.log2(np.maximum(pixel / self._pixel_m, 1.0)), 0, len(self._levels) - 1.001)
        whole = level.astype(np.int32)
        total = np.zeros((len(u), 3), dtype=np.float32)
        for k in range(int(whole.min(initial=0)), int(whole.max(initial=0)) + 2):
            weight = 1 - np.abs(level - k)
            chosen = np.nonzero(weight > 0)[0]
            if len(chosen):
                image = self._levels[k]
                scale = np.float32(1 / (self._pixel_m * 2**k))
                x = u[chosen] * scale + np.float32(image.shape[1] / 2 - 0.5)
                y = v[chosen] * scale + np.float32(image.shape[0] / 2 - 0.5)
                total[chosen] += weight[chosen, None].astype(np.float32) * sample(image, x, y, wrap=False)
        return total / np.float32(255)
