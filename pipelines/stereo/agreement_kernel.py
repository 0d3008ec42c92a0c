"""Numba kernel that compares the depths of views; it holds no GIL, so that threads share the views."""

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

_GRAZING = 0.1  # of the depth: a ray that grazes the planes moves further between them


@njit(nogil=True, cache=True, error_model="numpy")
def compare_depths(
    depth: Any,
    ray_from_pixel: Any,
    center: Any,
    other_center: Any,
    pixel_from_world: Any,
    other: Any,
    other_index: Any,
    other_normals: Any,
    limits: Any,
    sums: Any,
    counts: Any,
) -> None:
    """Compare the points of a view with the surface of one other view, and add up what the comparison says.

    Args:
        depth: (H, W) float64 along the optical axis of the view; 0: no point.
        ray_from_pixel: (3, 3), from pixel (column, row, 1) to a ray of length one along the axis.
        center: (3,) of the view in `world`.
        other_center: (3,) of the other view.
        pixel_from_world: (3, 3) homogeneous pixel in the other view of a place relative to its centre.
        other: (4, h, w) float32: offset, score, step and sharpness of the other view.
        other_index: (h, w) rows of `other_normals`.
        other_normals: (F, 3).
        limits: (3,) least score, steps, and free, of `AgreementSettings`.
        sums: (2, H, W) float64; grows by the weighted differences of the depth, and by their weights.
        counts: (2, H, W) int32; grows by one where the other view agrees, and where it looks through the point.
    """
    least_score, steps, free = limits[0], limits[1], limits[2]
    rows, columns = other.shape[1], other.shape[2]
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            length = depth[v, u]
            if length <= 0:
                continue
            x, y = u + 0.5, v + 0.5
            r0 = ray_from_pixel[0, 0] * x + ray_from_pixel[0, 1] * y + ray_from_pixel[0, 2]
            r1 = ray_from_pixel[1, 0] * x + ray_from_pixel[1, 1] * y + ray_from_pixel[1, 2]
            r2 = ray_from_pixel[2, 0] * x + ray_from_pixel[2, 1] * y + ray_from_pixel[2, 2]
            p0, p1, p2 = center[0] + length * r0, center[1] + length * r1, center[2] + length * r2
            q0, q1, q2 = p0 - other_center[0], p1 - other_center[1], p2 - other_center[2]
            z = pixel_from_world[2, 0] * q0 + pixel_from_world[2, 1] * q1 + pixel_from_world[2, 2] * q2
            if z <= 0:
                continue
            across = (pixel_from_world[0, 0] * q0 + pixel_from_world[0, 1] * q1 + pixel_from_world[0, 2] * q2) / z
            down = (pixel_from_world[1, 0] * q0 + pixel_from_world[1, 1] * q1 + pixel_from_world[1, 2] * q2) / z
            if not (across >= 0 and across < columns and down >= 0 and down < rows):
                continue
            column, row = int(across), int(down)
            if not other[1, row, column] > least_score:
                continue
            which = other_index[row, column]
            n0, n1, n2 = other_normals[which, 0], other_normals[which, 1], other_normals[which, 2]
            offset = p0 * n0 + p1 * n1 + p2 * n2
            residual = np.float64(other[0, row, column]) - offset
            seen_at = offset - (n0 * other_center[0] + n1 * other_center[1] + n2 * other_center[2])
            if residual / seen_at > free:
                counts[1, v, u] += 1
            if abs(residual) < steps * other[2, row, column]:
                along = r0 * n0 + r1 * n1 + r2 * n2
                longer = residual / along
                if abs(longer) < _GRAZING * length:
                    weight = (along * other[3, row, column]) ** 2
                    sums[0, v, u] += weight * longer
                    sums[1, v, u] += weight
                    counts[0, v, u] += 1
