"""Weights of the points that a training view is held to, by the contrast of its photograph."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array

_WINDOW_PX = 5  # side of the window that contrast is averaged over
_MEDIAN_WEIGHT = 2.5  # at the median contrast of the known surface
_MOST = 12.0
_BROKEN = 0.3  # weight where the surface bends or ends
_SAMPLE = 4  # of rows and columns, for the median
_REACH_PX = 3  # of the test for an unbroken surface
_BEND = 0.005  # limit of |z/z₁ + z/z₂ − 2| for a depth z between opposite neighbours z₁, z₂


def pull_weights(rgb: ByteArray, depth_m: Float32Array) -> Float32Array:
    """Return the weight (H, W) of each depth's pull, 0.3 … 12, proportional to the contrast of the photograph.

    Gaussians are blended in the order of their centres. The photometric loss therefore draws the Gaussians of a
    slanted surface behind it, with a force that grows with the contrast: most of all those of small details, such
    as windows and survey targets. Stereo is most exact at these places. Where the surface bends, or ends within
    `_REACH_PX`, stereo is least exact, and the weight is smallest.

    Args:
        rgb: (H, W, 3) photograph.
        depth_m: (H, W) along the optical axis; 0: unknown.
    """
    contrast = _contrast(rgb)
    sample = contrast[::_SAMPLE, ::_SAMPLE][depth_m[::_SAMPLE, ::_SAMPLE] > 0]
    if len(sample) == 0:
        return np.ones(depth_m.shape, np.float32)
    typical = max(float(np.median(sample)), 1e-3)
    weight = np.clip(_MEDIAN_WEIGHT / typical * contrast, 1.0, _MOST)
    return np.where(_unbroken(depth_m), weight, _BROKEN).astype(np.float32)


def _contrast(rgb: ByteArray) -> Float32Array:
    """Return the root mean square (H, W) of the grey levels' gradient around each pixel."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)
    square = cv2.boxFilter(across * across + down * down, -1, (_WINDOW_PX, _WINDOW_PX))
    return np.asarray(np.sqrt(square), np.float32)


def _unbroken(depth_m: Float32Array) -> BoolArray:
    """Return whether the surface goes on as a plane (H, W) in all directions around each pixel."""
    height, width = depth_m.shape
    # The inverse depth of a plane is linear on the image, at any angle of view.
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, np.float32(1e-9)), np.float32(np.nan))
    around = np.pad(inverse, _REACH_PX, constant_values=np.nan)
    plane = np.ones(depth_m.shape, dtype=np.bool_)
    for down, right in ((0, _REACH_PX), (_REACH_PX, 0), (_REACH_PX, _REACH_PX), (_REACH_PX, -_REACH_PX)):
        ahead = around[_REACH_PX + down :, _REACH_PX + right :][:height, :width]
        behind = around[_REACH_PX - down :, _REACH_PX - right :][:height, :width]
        plane &= np.abs(ahead + behind - 2 * inverse) < _BEND * inverse
    return plane
