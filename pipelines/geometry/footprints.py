"""Footprints of photographs: the rays of the image's border, intersected with the surface of the scene.

Also functions for point sets: points by voxel, by square in plan, and rows of dataclasses of arrays.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.machine import thread_count
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import Camera, undistort

_PER_SIDE = 16  # border pixels: the bow of a lens and the relief show in the outline
_SHALLOWEST = 0.1  # tangent of the angle below the horizon: beyond, a ray ends at ten times the height above ground
_NEIGHBOURS = 9  # points whose median is the height of the surface
_SAMPLES = 32  # along a ray, from the camera down to the lowest point
_BISECTIONS = 16
_FOR_ONE_THREAD = 10_000  # coordinates of places: to start several takes longer


class PointSurface:
    """Surface through points (N, 3) in metres, N ≥ 1, z up: the smoothed height of the nearest point in plan.

    The smoothed height is the median over the nearest points, the point itself among them.
    """

    def __init__(self, points: FloatArray) -> None:
        height = points[:, 2]
        self._tree = cKDTree(points[:, :2])
        _, near = self._tree.query(points[:, :2], k=min(_NEIGHBOURS, len(points)), workers=thread_count())
        self._height = np.median(height[np.reshape(near, (len(points), -1))], axis=1)
        self.median, self.lowest = float(np.median(height)), float(height.min())
        self.highest = float(self._height.max())

    def heights(self, places: FloatArray) -> FloatArray:
        """Return the heights (…,) at places (…, 2)."""
        return self.height_of(self.nearest(places))

    def nearest(self, places: FloatArray) -> IntArray:
        """Return the points (…,), as rows, that give places (…, 2) their heights."""
        workers = thread_count() if places.size > _FOR_ONE_THREAD else 1
        return np.asarray(self._tree.query(places, workers=workers)[1], dtype=np.int64)

    def height_of(self, nearest: IntArray) -> FloatArray:
        """Return the heights (…,) of places whose nearest points are (…,)."""
        return np.asarray(self._height[nearest])


@dataclass(frozen=True)
class Footprint:
    """Outline (K, 3) of what a photograph shows, z up, anticlockwise seen from above, not closed; K = 0: no ground.

    `clipped`: the photograph also shows what lies above the horizon, or too near below it to be placed.
    """

    outline: FloatArray
    clipped: bool


def border_rays(camera: Camera) -> FloatArray:
    """Return rays (K, 3) in the camera's frame through the border of its image, clockwise from the upper left.

    The corners are among them. A pixel that the lens gives no ray is left out.
    """
    step = np.linspace(0.0, 1.0, _PER_SIDE, endpoint=False)
    zero, one = np.zeros(_PER_SIDE), np.ones(_PER_SIDE)
    sides = [np.column_stack(side) for side in ((step, zero), (one, step), (1 - step, one), (zero, 1 - step))]
    slopes = undistort(camera, np.concatenate(sides) * [camera.width, camera.height])
    slopes = slopes[np.isfinite(slopes).all(axis=1)]
    return np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)


def footprint(rays: FloatArray, center: FloatArray, surface: PointSurface) -> Footprint:
    """Return the outline at which rays (K, 3) from a centre (3,) meet a surface, z up.

    1. The part of the border that does not point at least `_SHALLOWEST` below the horizon is cut off.
    2. Each ray ends where it first passes below the surface. A ray that never runs above it ends at the median
       height.
    3. Where the relief makes the outline cross itself, the outline is that on the plane of its median height.
    """
    unit, below = _below_horizon(rays)
    clipped = bool((below < 0).any())
    seen = clipped_ring(unit, below)
    if len(seen) < 3 or center[2] <= surface.median:
        return Footprint(np.zeros((0, 3)), clipped)
    ray = seen / -seen[:, 2:]
    depth = _depths(ray, center, surface)
    outline = center + depth[:, None] * ray
    if _crosses_itself(outline[:, :2]):
        outline = center + np.median(depth) * ray
    return Footprint(outline if ring_area(outline) > 0 else outline[::-1], clipped)


def ground_points(rays: FloatArray, center: FloatArray, surface: PointSurface) -> FloatArray:
    """Return the points (K, 3) at which rays (K, 3) from a centre (3,) first pass below a surface, z up.

    NaN for rays that do not point at least `_SHALLOWEST` below the horizon, and for a centre below the surface. A
    ray that never runs above the surface ends at the median height.
    """
    points = np.full(rays.shape, np.nan)
    unit, below = _below_horizon(rays)
    falls = below > 0
    if center[2] > surface.median and falls.any():
        ray = unit[falls] / -unit[falls, 2:]
        points[falls] = center + _depths(ray, center, surface)[:, None] * ray
    return points


def _below_horizon(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit rays (K, 3), and a margin (K,): positive where they point further down than `_SHALLOWEST`."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit, -unit[:, 2] - _SHALLOWEST * np.hypot(unit[:, 0], unit[:, 1])


def _depths(ray: FloatArray, center: FloatArray, surface: PointSurface) -> FloatArray:
    """Return how far (K,) below the centre rays (K, 3), which descend by one, first pass below the surface.

    The surface is level around each of its points, in a convex cell of the plan. Where a part of a ray begins and
    ends in one cell, no point needs to be looked for in between.
    """
    count = len(ray)
    steps = np.linspace(0.0, center[2] - surface.lowest, _SAMPLES)
    above, open_ = np.full(count, center[2] > surface.heights(center[:2])), np.arange(count)
    low, high = np.zeros(count), np.full(count, np.nan)  # of the part in which a ray passes below
    at_low, at_high = np.full(count, -1), np.full(count, -1)  # points below its ends; -1: not looked for
    for before, depth in itertools.pairwise(steps.tolist()):
        if center[2] - depth > surface.highest:
            above[:], at_low[:] = True, -1
            continue
        at = surface.nearest(center[:2] + depth * ray[open_, :2])
        is_above = center[2] - depth - surface.height_of(at) > 0
        passes = above[open_] & ~is_above
        rows, rest = open_[passes], open_[~passes]
        low[rows], high[rows], at_high[rows] = before, depth, at[passes]
        above[rest], at_low[rest] = is_above[~passes], at[~passes]
        open_ = rest
    rows = np.flatnonzero(np.isfinite(high))
    for _ in range(_BISECTIONS):
        middle, at = (low[rows] + high[rows]) / 2, at_low[rows]
        apart = at != at_high[rows]
        at[apart] = surface.nearest(center[:2] + middle[apart, None] * ray[rows[apart], :2])
        is_above = center[2] - middle - surface.height_of(at) > 0
        for is_end, end, at_end in ((is_above, low, at_low), (~is_above, high, at_high)):
            end[rows[is_end]], at_end[rows[is_end]] = middle[is_end], at[is_end]
    return np.where(np.isfinite(high), high, center[2] - surface.median)


def clipped_ring(ring: FloatArray, inside: FloatArray) -> FloatArray:
    """Return the part of a ring (K, d), not closed, where a function is not negative (Sutherland and Hodgman 1974).

    `inside` (K,) is the function at the corners, linear between them.
    """
    kept = []
    for index in range(len(ring)):
        before, here = inside[index - 1], inside[index]
        if (before < 0) != (here < 0):
            share = before / (before - here)
            kept.append(ring[index - 1] + share * (ring[index] - ring[index - 1]))
        if here >= 0:
            kept.append(ring[index])
    return np.array(kept).reshape(-1, ring.shape[1])


def _crosses_itself(ring: FloatArray) -> bool:
    """Return whether any two edges of a ring (K, 2) that have no corner in common cross."""
    following = np.roll(ring, -1, axis=0)
    edge = following - ring

    def sides(points: FloatArray) -> FloatArray:
        """Return on which side of each edge (rows) points (columns) lie."""
        arm = points[None] - ring[:, None]
        return np.asarray(np.sign(edge[:, None, 0] * arm[..., 1] - edge[:, None, 1] * arm[..., 0]))

    parted = sides(ring) * sides(following) < 0
    return bool((parted & parted.T).any())


def ring_area(outline: FloatArray) -> float:
    """Return the area of an outline in plan, negative if it runs clockwise."""
    x, y = outline[:, 0] - outline[0, 0], outline[:, 1] - outline[0, 1]
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


_SMALLEST_M = 1e-6  # side of a voxel
_LARGEST_NUMBER = 2**62  # of a row, without overflow of int64


def rows_by_square(points: FloatArray, side_m: float) -> list[tuple[tuple[int, int], IntArray]]:
    """Return the squares (east, north) in plan that hold points (P, 2 or more), and the rows of their points."""
    if not len(points):
        return []
    square = np.floor(points[:, :2] / side_m).astype(np.int64)
    order = np.lexsort(square.T)
    starts = np.flatnonzero(np.any(np.diff(square[order], axis=0), axis=1)) + 1
    return [((int(square[rows[0], 0]), int(square[rows[0], 1])), rows) for rows in np.split(order, starts)]


def voxel_keys(points: FloatArray, side_m: float) -> IntArray:
    """Return a number (P,) for the voxel of each of P ≥ 1 points (P, 3), the same for points of one voxel."""
    return row_numbers(np.floor(points / side_m).astype(np.int64))


def first_of_voxels(points: FloatArray, side_m: float) -> IntArray:
    """Return ascending rows of the first point in each voxel; arguments as for `voxel_keys`, or no points."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    return np.sort(np.unique(voxel_keys(points, side_m), return_index=True)[1])


def thin_to_voxels(points: FloatArray, side_m: FloatArray) -> IntArray:
    """Return ascending indices of the first of points (P, 3) in each voxel.

    The wanted sides (P,) of the points' voxels are rounded to powers of two, so that equal sides share a grid.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    return np.sort(np.unique(_sized_voxel_keys(points, side_m), return_index=True)[1])


def count_voxels(points: FloatArray, side_m: FloatArray) -> int:
    """Return the number of points that `thin_to_voxels` leaves of P ≥ 1, several times as fast."""
    return len(np.unique(_sized_voxel_keys(points, side_m)))


def _sized_voxel_keys(points: FloatArray, side_m: FloatArray) -> IntArray:
    level = np.round(np.log2(np.maximum(side_m, _SMALLEST_M)))
    voxel = np.floor(points / (2.0**level)[:, None])
    return row_numbers(np.column_stack([level, voxel]).astype(np.int64))


def row_numbers(rows: IntArray) -> IntArray:
    """Return a number (P,) for each of P ≥ 1 rows, the same for equal rows; numbers sort ten times as fast."""
    number = np.zeros(len(rows), dtype=np.int64)
    for column in (rows - rows.min(axis=0)).T:
        extent = int(column.max()) + 1
        if int(number.max()) >= _LARGEST_NUMBER // extent:
            _, number = np.unique(number, return_inverse=True)
        number = number * extent + column
    return number
