"""Visibility of surfels (discs at the points of a cloud) in a camera, and crossings of a grid's cells by beams.

Each disc hides the points behind it:

1. A point covers a disc on its plane. The disc is drawn into a depth buffer, pixel by pixel, at the depth of the
   plane. For discs seen at a grazing angle, the distance from the point's depth is limited to `_SLANT` times the
   sum of radius and pixel.
2. A point is seen unless a disc at its own pixel is nearer than the point's disc by more than the point's radius.

Discs extend over silhouettes by their radius: a point close behind an edge counts as hidden.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import ArrayN, ArrayN3, ByteArray, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)


_NEAR_M = 1e-3  # least depth of a disc that is drawn
_SLANT = 4.0
_MOST_PX = 12  # limit of a disc's radius


@dataclass(frozen=True)
class Surfels:
    """P discs: positions (P, 3) in metres, unit normals (P, 3) with an arbitrary sign, radii (P,)."""

    position: FloatArray
    normal: FloatArray
    radius_m: FloatArray


@dataclass(frozen=True)
class SeenSurfels:
    """K discs that a camera sees: `rows` among all discs, pixels (`row`, `column`), depths along the camera's z."""

    rows: IntArray
    row: IntArray
    column: IntArray
    depth_m: FloatArray


def seen_surfels(surfels: Surfels, cam_from_world: FloatArray, center: FloatArray, camera: Pinhole) -> SeenSurfels:
    """Return the discs that a camera with a rotation (3, 3) and a centre (3,) in metres sees."""
    in_cam = (surfels.position - center) @ cam_from_world.T
    normal = surfels.normal @ cam_from_world.T
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pixel, depth_at_pixel = np.full(len(in_cam), -1, dtype=np.int64), np.zeros(len(in_cam))
    nearest = np.full(camera.width * camera.height, np.inf)
    _draw(in_cam, normal, surfels.radius_m, intrinsics, camera.width, camera.height, nearest, pixel, depth_at_pixel)
    inside = np.flatnonzero(pixel >= 0)
    rows = inside[depth_at_pixel[inside] <= nearest[pixel[inside]] + surfels.radius_m[inside]]
    row, column = np.divmod(pixel[rows], camera.width)
    return SeenSurfels(rows, row, column, in_cam[rows, 2])


@kernel(nogil=True, error_model="numpy")
def _draw(
    points: ArrayN3,  # (P, 3) float64
    normals: ArrayN3,  # (P, 3) float64
    radii: ArrayN,  # (P,) float64
    intrinsics: ArrayN,  # (4,) float64
    width: int,
    height: int,
    nearest: ArrayN,  # (height · width,) float64
    pixel: ArrayN,  # (P,) int64
    depth_at_pixel: ArrayN,  # (P,) float64
) -> None:
    """Draw discs in camera coordinates into a depth buffer.

    The pixel of each centre inside the image is noted, and the depth of its disc there.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for p in range(len(points)):
        x, y, z, radius = points[p, 0], points[p, 1], points[p, 2], radii[p]
        if z < _NEAR_M:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        reach = min(radius * max(fx, fy) / z, _MOST_PX)
        if not (u > -reach and u < width + reach and v > -reach and v < height + reach):
            continue
        if u >= 0 and u < width and v >= 0 and v < height:
            pixel[p] = int(v) * width + int(u)
        limit = _SLANT * (radius + z / min(fx, fy))
        offset = normals[p, 0] * x + normals[p, 1] * y + normals[p, 2] * z
        for row in range(max(int(v - reach), 0), min(int(v + reach), height - 1) + 1):
            for column in range(max(int(u - reach), 0), min(int(u + reach), width - 1) + 1):
                right, down = column + 0.5 - u, row + 0.5 - v
                own = row == int(v) and column == int(u)
                if right * right + down * down > reach * reach and not own:
                    continue
                slope_x, slope_y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                along = normals[p, 0] * slope_x + normals[p, 1] * slope_y + normals[p, 2]
                depth = z if along == 0 else offset / along
                depth = min(max(depth, z - limit), z + limit)
                if own:
                    depth_at_pixel[p] = depth
                place = row * width + column
                nearest[place] = min(nearest[place], depth)


_MOST = 255  # crossings of a cell that are counted
_STEP = 0.25  # of a cell's side


def count_beams(
    end: FloatArray, start: FloatArray, low: FloatArray, cell_m: float, shape: IntArray
) -> NDArray[np.uint8]:
    """Return how many beams cross each cell of a grid, 255 at most, from its low corner (3,), of a shape (3,).

    Beams are sampled at a quarter of a cell's side, from their ends (P, 3), in the grid, until they leave it
    towards their starts (P, 3), which lie elsewhere: corners of cells may be missed.
    """
    count = np.zeros(tuple(shape.tolist()), dtype=np.uint8)
    _cross(end, start, low, cell_m, count)
    return count


@kernel(nogil=True, error_model="numpy")
def _cross(
    end: ArrayN3,  # (P, 3) float64
    start: ArrayN3,  # (P, 3) float64
    low: ArrayN,  # (3,) float64
    cell_m: float,
    count: ByteArray,  # (X, Y, Z) uint8
) -> None:
    for p in range(len(end)):
        dx, dy, dz = start[p, 0] - end[p, 0], start[p, 1] - end[p, 1], start[p, 2] - end[p, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        steps = int(length / (_STEP * cell_m))
        last = -1
        for step in range(steps + 1):
            part = step * _STEP * cell_m / length
            i = int(np.floor((end[p, 0] + part * dx - low[0]) / cell_m))
            j = int(np.floor((end[p, 1] + part * dy - low[1]) / cell_m))
            k = int(np.floor((end[p, 2] + part * dz - low[2]) / cell_m))
            if i < 0 or j < 0 or k < 0 or i >= count.shape[0] or j >= count.shape[1] or k >= count.shape[2]:
                break
            place = (i * count.shape[1] + j) * count.shape[2] + k
            if place != last and count[i, j, k] < _MOST:
                count[i, j, k] += 1
            last = place
