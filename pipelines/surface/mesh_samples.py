"""Points on the triangles of a measured mesh, evenly spread, so that a mesh is used as a cloud is."""

from collections.abc import Iterator

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray

_MOST_SAMPLES = 60_000_000
# Steps of the two coordinates within triangles: multiples of them fill a square evenly (doi 10.1016/0022-314X(89)
# 90035-5: the generalised golden ratio).
_STEPS = np.array([0.7548776662466927, 0.5698402909980532])


def triangle_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return the areas (F,) of triangles (F, 3) of vertices (V, 3)."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2)


def meets_box(
    vertices: FloatArray, faces: IntArray, low: FloatArray | float, high: FloatArray | float
) -> BoolArray:
    """Return whether the box around a triangle meets the box from `low` (3,) to `high` (3,), for each (F,)."""
    corners = vertices[faces]
    return np.asarray(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))


def samples(vertices: FloatArray, faces: IntArray, spacing_m: float, size: int) -> Iterator[FloatArray]:
    """Yield points (P, 3) on triangles (F, 3) of vertices (V, 3) in metres, P ≤ `size`.

    Each stands for an area of `spacing_m` squared: their number follows the area, however small the triangles.
    With more than 60 million points, they lie further apart.
    """
    until = np.cumsum(triangle_areas(vertices, faces))
    whole = float(until[-1]) if len(until) else 0.0
    if whole <= 0:
        return
    count = int(np.ceil(min(whole / spacing_m**2, _MOST_SAMPLES)))
    for first in range(0, count, size):
        number = np.arange(first, min(first + size, count))
        triangle = np.searchsorted(until, (number + 0.5) / count * whole)
        along = ((number[:, None] + 1) * _STEPS) % 1.0
        # The half of the square beyond the diagonal is folded onto the triangle.
        along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
        corner, second, third = (vertices[faces[triangle, place]] for place in range(3))
        yield corner + along[:, :1] * (second - corner) + along[:, 1:] * (third - corner)
