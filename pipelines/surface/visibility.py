"""Support of points by depth maps: how many views show a surface there, and how far apart their surfaces lie.

1. A view's surface at a point is read off its depth map at the point's projection: linear in inverse depth between
   the four pixels around it, if these lie on one surface (the inverse depth of a plane is linear on the image).
   Otherwise it is that of the pixel.
2. The view agrees if that depth differs from the point's by at most `tolerance` of the depth.
3. The view looks through the point if its surface lies further behind than that, and a nearer surface hides it.
4. The residual of an agreeing view is the vector along the ray from the point to the view's surface.

`seen_surface` says which points of a reference the photographs saw: those that no other point of the reference
hides. The model has no say: a surface that training missed was seen all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange
from scipy.ndimage import minimum_filter

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import Array33, ArrayN, ArrayN3, ArrayNK, BoolArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.footprints import rows_by_square
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)


# Largest range of the depths of four pixels of one surface, as a part of them: ground under 5° at f = 500 px.
_ONE_SURFACE = 0.04
_BLOCK = 128  # points that share a choice of cameras
_CELLS = 256  # across the points' extent, to sort them into blocks
_NEAR = 1e-6  # least depth

_VIEWS, _THROUGH, _UP, _UP2, _HORIZONTAL2, _Z2, _NORMAL, _NORMAL2, _DIRECTION = range(9)
_SUMS = _DIRECTION + 3


@dataclass(frozen=True)
class Viewpoints:
    """Cameras of V undistorted photographs: rotations (V, 3, 3), centres (V, 3) in metres, and pinholes."""

    cam_from_world: FloatArray
    center_in_world: FloatArray
    pinholes: tuple[Pinhole, ...]


@dataclass(frozen=True)
class DepthViews:
    """V depth maps with their cameras, in one frame (metres)."""

    cam_from_world: FloatArray  # (V, 3, 3) rotations
    center_in_world: FloatArray  # (V, 3) camera centres
    intrinsics_px: FloatArray  # (V, 4) fx, fy, cx, cy; the centre of the top-left pixel is (0.5, 0.5)
    size_px: IntArray  # (V, 2) width and height
    start: IntArray  # (V,) each map's first pixel in `depth_m`
    depth_m: Float32Array  # (P,) of all maps, row by row, along the camera's z axis; 0: no surface

    @classmethod
    def of(cls, cameras: Viewpoints, depth_m: Float32Array) -> DepthViews:
        """Return the maps of cameras, which lie one after the other in `depth_m` (P,)."""
        intrinsics = np.array([[pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy] for pinhole in cameras.pinholes])
        size = np.array([[pinhole.width, pinhole.height] for pinhole in cameras.pinholes], dtype=np.int64)
        start = np.concatenate([[0], np.cumsum(size.prod(axis=1))[:-1]])
        return cls(cameras.cam_from_world, cameras.center_in_world, intrinsics, size, start, depth_m)


# The arrays of `DepthViews`, for kernels.
ViewArrays = tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray, Float32Array]


@dataclass(frozen=True)
class Support:
    """Support of N points; a mean or RMS is NaN for a point without an agreeing view.

    The surface of a single view is uncertain by about these RMS. Errors of the views correlate, because the same
    Gaussians cause them: the RMS does not fall with √views.
    """

    views: IntArray  # (N,) number of views whose surface agrees
    seen_through: IntArray  # (N,) number of views that look through the point
    mean_up_m: FloatArray  # (N,) mean upward component of the residuals
    rms_up_m: FloatArray  # (N,) RMS of their upward components: the height's, on level ground
    rms_horizontal_m: FloatArray  # (N,) of horizontal components; on level ground mostly the rays' slant
    rms_depth_m: FloatArray  # (N,) RMS along the cameras' z axes
    mean_normal_m: FloatArray  # (N,) along the points' normals, whatever the slant; NaN without one
    rms_normal_m: FloatArray  # (N,) likewise
    spread_rad: FloatArray  # (N,) RMS angle of the agreeing rays about their mean direction: 0 without parallax
    mean_ray: FloatArray  # (N, 3) mean unit vector of the agreeing rays, from the camera

    def scaled(self, scale: float) -> Support:
        """Return the support in a frame whose unit is 1/`scale` of this one's."""
        lengths = {name: scale * value for name, value in vars(self).items() if name.endswith("_m")}
        return replace(self, **lengths)


def support(
    point_in_world: FloatArray,
    views: DepthViews,
    up_in_world: FloatArray,
    tolerance: float,
    normal_in_world: FloatArray | None = None,
) -> Support:
    """Return the support of points (N, 3), finite, by depth maps; `up_in_world` is a unit vector.

    Depths agree within the tolerance, a part of them. Unit normals (N, 3) have an arbitrary sign; NaN: unknown.
    """
    points = np.ascontiguousarray(point_in_world, dtype=np.float64).reshape(-1, 3)
    normals = np.full_like(points, np.nan) if normal_in_world is None else normal_in_world
    depth = views.depth_m.view()
    depth.flags.writeable = False  # as mapped files are: one type of array, compiled once
    cameras = [
        np.ascontiguousarray(values, dtype=np.float64)
        for values in (views.cam_from_world, views.center_in_world, views.intrinsics_px)
    ]
    places = [np.ascontiguousarray(values, dtype=np.int64) for values in (views.size_px, views.start)]
    up = np.ascontiguousarray(up_in_world, dtype=np.float64)
    sums = np.zeros((len(points), _SUMS))
    if len(points):
        unit_normals = np.ascontiguousarray(normals, dtype=np.float64)
        _sum_support(points, unit_normals, _blocks(points), (*cameras, *places, depth), up, tolerance, sums)
    with np.errstate(invalid="ignore"):
        count = np.where(sums[:, _VIEWS] > 0, sums[:, _VIEWS], np.nan)
        resultant = np.linalg.norm(sums[:, _DIRECTION:], axis=1) / count
        return Support(
            views=sums[:, _VIEWS].astype(np.int64),
            seen_through=sums[:, _THROUGH].astype(np.int64),
            mean_up_m=sums[:, _UP] / count,
            rms_up_m=np.sqrt(sums[:, _UP2] / count),
            rms_horizontal_m=np.sqrt(sums[:, _HORIZONTAL2] / count),
            rms_depth_m=np.sqrt(sums[:, _Z2] / count),
            mean_normal_m=sums[:, _NORMAL] / count,
            rms_normal_m=np.sqrt(sums[:, _NORMAL2] / count),
            spread_rad=np.sqrt(np.maximum(2 * (1 - resultant), 0)),
            mean_ray=sums[:, _DIRECTION:] / count[:, None],
        )


def _blocks(points: FloatArray) -> IntArray:
    """Return the points' indices, ordered so that consecutive ones lie close together (Morton's order of cells)."""
    low = points.min(axis=0)
    size = max(float(np.ptp(points, axis=0).max()), _NEAR) / _CELLS
    cell = np.minimum(((points - low) / size).astype(np.int64), _CELLS - 1)
    spread = np.zeros(_CELLS, np.int64)
    for bit in range(_CELLS.bit_length() - 1):
        spread |= (np.arange(_CELLS) >> bit & 1) << 3 * bit
    return np.argsort(spread[cell] @ [1, 2, 4], kind="stable")


@njit(nogil=True, error_model="numpy")
def point_in_cam(
    point: ArrayN,  # (3,) float64
    rotation: Array33,  # (3, 3) float64
    center: ArrayN,  # (3,) float64
) -> tuple[float, float, float]:
    """Return a point in the camera's axes, from world coordinates, rotation cam ← world (3, 3) and centre."""
    x, y, z = 0.0, 0.0, 0.0
    for k in range(3):
        d = point[k] - center[k]
        x += rotation[0, k] * d
        y += rotation[1, k] * d
        z += rotation[2, k] * d
    return x, y, z


@kernel(nogil=True, error_model="numpy")
def sees_sphere(
    middle: ArrayN,  # (3,) float64
    radius: float,
    rotation: Array33,  # (3, 3) float64
    center: ArrayN,  # (3,) float64
    intrinsics: ArrayN,  # (4,) float64
    size: ArrayN,  # (2,) int64
) -> bool:
    """Return whether a sphere may touch the frustum of a camera."""
    x, y, z = point_in_cam(middle, rotation, center)
    if z < -radius:
        return False
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, right = -cx / fx, (size[0] - cx) / fx
    above, below = -cy / fy, (size[1] - cy) / fy
    # Signed distances from the four planes through the centre and the image's sides, outwards.
    if max((left * z - x) / np.sqrt(1 + left * left), (x - right * z) / np.sqrt(1 + right * right)) > radius:
        return False
    return max((above * z - y) / np.sqrt(1 + above * above), (y - below * z) / np.sqrt(1 + below * below)) <= radius


@njit(nogil=True, error_model="numpy")
def surface_at(
    depth: ArrayN,  # (pixels,) float32
    start: int,
    width: int,
    height: int,
    u: float,
    v: float,
) -> float:
    """Return the depth of a view's surface at a place on its image; 0: none."""
    own = depth[start + int(v) * width + int(u)]
    column = min(max(int(np.floor(u - 0.5)), 0), width - 2)
    row = min(max(int(np.floor(v - 0.5)), 0), height - 2)
    if width < 2 or height < 2:
        return own
    first = start + row * width + column
    a, b, c, d = depth[first], depth[first + 1], depth[first + width], depth[first + width + 1]
    least = min(a, b, c, d)
    if least <= 0 or max(a, b, c, d) > (1 + _ONE_SURFACE) * least:
        return own
    # Clamped beyond the outermost pixel centres.
    right = min(max(u - 0.5 - column, 0.0), 1.0)
    down = min(max(v - 0.5 - row, 0.0), 1.0)
    above = (1 - right) / a + right / b
    below = (1 - right) / c + right / d
    return 1 / ((1 - down) * above + down * below)


@njit(nogil=True, error_model="numpy")
def _add_view(
    row: int,
    points: ArrayN3,  # (N, 3) float64
    normals: ArrayN3,  # (N, 3) float64
    views: ViewArrays,  # see `DepthViews`
    view: int,
    up: ArrayN,  # (3,) float64
    tolerance: float,
    sums: ArrayNK,  # (N, _SUMS) float64
) -> None:
    """Add a view to the sums of a point. Numbers rather than rows of arrays, each of which would be counted."""
    rotations, centers, intrinsics, sizes, starts, depth = views
    dx, dy, dz = (
        points[row, 0] - centers[view, 0],
        points[row, 1] - centers[view, 1],
        points[row, 2] - centers[view, 2],
    )
    z = rotations[view, 2, 0] * dx + rotations[view, 2, 1] * dy + rotations[view, 2, 2] * dz
    if z <= _NEAR:
        return
    width, height = sizes[view, 0], sizes[view, 1]
    x = rotations[view, 0, 0] * dx + rotations[view, 0, 1] * dy + rotations[view, 0, 2] * dz
    u = intrinsics[view, 0] * x / z + intrinsics[view, 2]
    if not (u >= 0 and u < width):
        return
    y = rotations[view, 1, 0] * dx + rotations[view, 1, 1] * dy + rotations[view, 1, 2] * dz
    v = intrinsics[view, 1] * y / z + intrinsics[view, 3]
    if not (v >= 0 and v < height):
        return
    surface = surface_at(depth, starts[view], width, height, u, v)
    if surface <= 0:
        return
    difference = surface - z
    if difference > tolerance * z:
        sums[row, _THROUGH] += 1
    if abs(difference) > tolerance * z:
        return
    ratio = difference / z
    to_x, to_y, to_z = ratio * dx, ratio * dy, ratio * dz
    upwards = to_x * up[0] + to_y * up[1] + to_z * up[2]
    along = to_x * normals[row, 0] + to_y * normals[row, 1] + to_z * normals[row, 2]
    square = to_x * to_x + to_y * to_y + to_z * to_z
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    sums[row, _DIRECTION] += dx / length
    sums[row, _DIRECTION + 1] += dy / length
    sums[row, _DIRECTION + 2] += dz / length
    sums[row, _VIEWS] += 1
    sums[row, _UP] += upwards
    sums[row, _UP2] += upwards * upwards
    sums[row, _HORIZONTAL2] += max(square - upwards * upwards, 0.0)
    sums[row, _Z2] += difference * difference
    sums[row, _NORMAL] += along
    sums[row, _NORMAL2] += along * along


@njit(nogil=True, error_model="numpy")
def _sum_block(
    rows: ArrayN,  # (R,) int64
    points: ArrayN3,  # (N, 3) float64
    normals: ArrayN3,  # (N, 3) float64
    views: ViewArrays,  # see `DepthViews`
    up: ArrayN,  # (3,) float64
    tolerance: float,
    sums: ArrayNK,  # (N, _SUMS) float64
) -> None:
    """Add all views to the sums of the points of one block."""
    low, high = points[rows[0]].copy(), points[rows[0]].copy()
    for row in rows:
        for k in range(3):
            low[k] = min(low[k], points[row, k])
            high[k] = max(high[k], points[row, k])
    middle = 0.5 * (low + high)
    radius = 0.5 * np.sqrt(((high - low) ** 2).sum())
    rotations, centers, intrinsics, sizes, starts, _ = views
    for view in range(len(starts)):
        if not sees_sphere(middle, radius, rotations[view], centers[view], intrinsics[view], sizes[view]):
            continue
        for row in rows:
            _add_view(row, points, normals, views, view, up, tolerance, sums)


@kernel(parallel=True, nogil=True, error_model="numpy")
def _sum_support(
    points: ArrayN3,  # (N, 3) float64
    normals: ArrayN3,  # (N, 3) float64
    order: ArrayN,  # (N,) int64
    views: ViewArrays,  # see `DepthViews`
    up: ArrayN,  # (3,) float64
    tolerance: float,
    sums: ArrayNK,  # (N, _SUMS) float64
) -> None:
    """Fill the sums (N, _SUMS) of all points, block by block; `order` puts the points of a block together."""
    for block in prange((len(order) + _BLOCK - 1) // _BLOCK):
        rows = order[block * _BLOCK : min((block + 1) * _BLOCK, len(order))]
        _sum_block(rows, points, normals, views, up, tolerance, sums)


LEAST_VIEWS = 3  # as many as must agree on a point of the model's cloud
_CELL_VOXELS = 1.5  # width of a pixel of the maps on the surface: none stays empty between the points
_TOLERANCE_VOXELS = 4.0  # a map shows the nearest point of three pixels: on a slope of 45° the others lie behind
_NEAR_M = 0.1
_BLOCK_M = 40.0  # side of the blocks of points that a view shows or not
_UPWARDS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class SeenSurface:
    """Depth maps of a reference from the photographs."""

    views: DepthViews
    tolerance: float  # largest difference of depths of one surface, as a part of the depth

    def sees(self, position_in_geo: FloatArray) -> BoolArray:
        """Return whether enough photographs saw points (P, 3)."""
        return support(position_in_geo, self.views, _UPWARDS, self.tolerance).views >= LEAST_VIEWS


def seen_surface(
    viewpoints: Viewpoints, position_in_geo: FloatArray, voxel_m: float, progress: Progress = SILENT
) -> SeenSurface:
    """Return the depth maps of a reference, of points (P, 3) that lie one a voxel."""
    blocks = []
    for _, rows in rows_by_square(position_in_geo, _BLOCK_M):
        part = position_in_geo[rows]
        low, high = part.min(axis=0), part.max(axis=0)
        blocks.append((part, (low + high) / 2, float(np.linalg.norm(high - low)) / 2))
    maps: list[tuple[Pinhole, Float32Array]] = []
    depths = []
    with progress.task("photographs of the reference", len(viewpoints.pinholes)) as task:
        for rotation, center, pinhole in zip(
            viewpoints.cam_from_world, viewpoints.center_in_world, viewpoints.pinholes, strict=True
        ):
            in_view = _in_view(blocks, rotation, center, pinhole)
            depths.append(float(np.median(in_view[:, 2])) if len(in_view) else np.inf)
            # Never larger than the photograph, and one pixel if nothing is in view.
            shrink = float(np.clip(_CELL_VOXELS * voxel_m * pinhole.fx / depths[-1], 1, pinhole.width))
            maps.append(_depth_map(in_view, pinhole, shrink if len(in_view) else float(pinhole.width)))
            task.advance()
    coarse = replace(viewpoints, pinholes=tuple(pinhole for pinhole, _ in maps))
    views = DepthViews.of(coarse, np.concatenate([depth.ravel() for _, depth in maps]))
    return SeenSurface(views, _TOLERANCE_VOXELS * voxel_m / float(np.median(depths)))


def _in_view(
    blocks: list[tuple[FloatArray, FloatArray, float]], rotation: FloatArray, center: FloatArray, pinhole: Pinhole
) -> FloatArray:
    """Return pixel coordinates and depth (K, 3) of the points in a view, from blocks with middle and radius."""
    intrinsics = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
    size = np.array([pinhole.width, pinhole.height])
    near = [
        part for part, middle, radius in blocks if sees_sphere(middle, radius, rotation, center, intrinsics, size)
    ]
    in_cam = (np.concatenate(near) - center) @ rotation.T if near else np.zeros((0, 3))
    in_cam = in_cam[in_cam[:, 2] > _NEAR_M]
    xy = pinhole.project(in_cam)
    return np.column_stack([xy, in_cam[:, 2]])[pinhole.contains(xy)]


def _depth_map(in_view: FloatArray, pinhole: Pinhole, shrink: float) -> tuple[Pinhole, Float32Array]:
    """Return the least depth (H, W) of the points in and beside each pixel of an image `shrink` times smaller."""
    width, height = max(int(np.ceil(pinhole.width / shrink)), 1), max(int(np.ceil(pinhole.height / shrink)), 1)
    fx, fy, cx, cy = (value / shrink for value in (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy))
    depth, step = np.full((height, width), np.inf, dtype=np.float32), pinhole.fx / fx
    column = np.minimum((in_view[:, 0] / step).astype(np.int64), width - 1)
    row = np.minimum((in_view[:, 1] / step).astype(np.int64), height - 1)
    np.minimum.at(depth, (row, column), in_view[:, 2].astype(np.float32))
    nearest = minimum_filter(depth, size=3, mode="nearest")
    return Pinhole(width, height, fx, fy, cx, cy), np.where(np.isfinite(nearest), nearest, np.float32(0))
