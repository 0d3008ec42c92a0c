"""Signed distances to the surface on a sparse grid, averaged over the depth maps, and the mesh of their zeros.

After Curless and Levoy (doi 10.1145/237170.237269), with distances along the surface's normal. Memory holds one
chunk of the grid at a time, and one square of the plan of its mesh.

1. Cells of the grid that enough views show within the truncation hold voxels; all others hold nothing.
2. A view sees a plane at a pixel, which its inverse depths give. A voxel's distance is that to the plane.
3. A view's weight is the number of its pixels on a square metre of the surface: with one σ a pixel, that is the
   information of the view about the place. Of the views of a cell, the finest count.
4. A view that looks through a voxel counts it as free, with the same weight, and so carves what few views show.
   Behind its surface, a view says nothing.
5. Marching cubes find the zeros. Neighbouring chunks share a layer of voxels, whose values agree to the last digit.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange

from pipelines.core.extras import require
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.similarity import Similarity
from pipelines.splat.kernel_cache import kernel
from pipelines.surface.fusion import BEND, GRAZING, REACH_PX
from pipelines.surface.surface_views import SurfaceViews
from pipelines.surface.visibility import point_in_cam, sees_sphere, surface_at

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

_CELL = 4  # voxels along a cell's side
_CHUNK = 16  # cells along a chunk's side
_SQUARE = 4  # chunks along the side of a square of the plan
_TRUNCATION = 4.0  # in voxels or pixels, whichever is more: views of one surface differ by less (`SAME_SURFACE`)
_FINEST = 12  # views of a cell that are averaged, those with the most pixels: a hundred agree no better
_BITS, _ZERO = 21, 1 << 20  # of a cell's coordinate in its number
_PENDING = 8_000_000  # numbers of cells that wait to be counted

# Says which places (N, 3) of the mesh's frame lie in the area of interest, as a mask (N,).
Inside = Callable[[FloatArray], BoolArray]


@dataclass(frozen=True)
class GridSettings:
    """Settings of the grid, in metres of the mesh's frame."""

    voxel_m: float
    pixel_m: float  # median width of a pixel on the surface
    coarsest_m: float  # wider pixels say nothing about the surface
    min_views: int  # least number of views that show a cell

    @property
    def truncation_m(self) -> float:
        return _TRUNCATION * max(self.voxel_m, self.pixel_m)


@dataclass(frozen=True)
class RawMesh:
    """V vertices (V, 3) in metres, F faces (F, 3), anticlockwise seen from outside."""

    vertices: FloatArray
    faces: IntArray


def occupied_cells(
    views: SurfaceViews,
    frame_from_model: Similarity,
    settings: GridSettings,
    inside: Inside,
    progress: Progress = SILENT,
) -> IntArray:
    """Return the cells (K, 3) in the area that at least `min_views` views show within the truncation, sorted."""
    side_m = _CELL * settings.voxel_m
    reach = int(np.ceil(settings.truncation_m / side_m))
    around = np.arange(-reach, reach + 1)
    offsets = ((around[:, None, None] << 2 * _BITS) + (around[:, None] << _BITS) + around).ravel()
    step = max(1, int(side_m / (2 * settings.pixel_m)))
    number, count, pending = np.zeros(0, np.int64), np.zeros(0, np.int64), []
    with progress.task("cells", len(views)) as task:
        for place in range(len(views)):
            view = views.view(place)
            rows, columns = (step * index for index in np.nonzero(view.depth_m[::step, ::step]))
            fine = frame_from_model.scale * view.depth_m[rows, columns] / view.pinhole.fx < settings.coarsest_m
            position = frame_from_model.apply(view.points(rows[fine], columns[fine]))
            position = position[inside(position)]
            cell = np.floor(position / side_m).astype(np.int64) + _ZERO
            shown = np.unique((cell[:, 0] << 2 * _BITS) + (cell[:, 1] << _BITS) + cell[:, 2])
            pending.append(np.unique(shown[:, None] + offsets))
            if sum(map(len, pending)) > _PENDING or place == len(views) - 1:
                every = np.concatenate([number, *pending])
                counts = np.concatenate([count, np.ones(len(every) - len(number), np.int64)])
                number, member = np.unique(every, return_inverse=True)
                count, pending = np.bincount(member, counts).astype(np.int64), []
            task.advance()
    kept = number[count >= settings.min_views]
    mask = (1 << _BITS) - 1
    return np.stack([kept >> 2 * _BITS, kept >> _BITS & mask, kept & mask], axis=1) - _ZERO


def surface_squares(
    views: SurfaceViews,
    frame_from_model: Similarity,
    settings: GridSettings,
    cells: IntArray,
    progress: Progress = SILENT,
) -> Iterator[RawMesh]:
    """Yield the mesh of each square of the plan, in the frame, z up; on common borders, vertices agree exactly.

    Raises:
        BackendUnavailableError: scikit-image is not installed.
    """
    require("mesh")
    square = np.unique(cells[:, :2] // (_CHUNK * _SQUARE), axis=0)
    grid = _Grid(views, frame_from_model, settings, cells)
    with progress.task("squares", len(square)) as task:
        for place in square:
            parts = [part for part in map(grid.mesh, grid.chunks(place)) if part is not None]
            if parts:
                yield welded(parts, settings.voxel_m)
            task.advance()


def welded(parts: list[RawMesh], voxel_m: float) -> RawMesh:
    """Return one mesh of meshes whose common vertices lie within a thousandth of a voxel; no face without area."""
    vertices = np.concatenate([part.vertices for part in parts])
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, start[:-1], strict=True)])
    place = np.round(vertices / (1e-3 * voxel_m)).astype(np.int64)
    _, first, member = np.unique(place, axis=0, return_index=True, return_inverse=True)
    faces = member.ravel()[faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return RawMesh(vertices[first], faces[proper])


class _Grid:
    """Grid with its views: their cameras in the frame, for kernels that compute depths in the unit of the maps."""

    def __init__(
        self, views: SurfaceViews, frame_from_model: Similarity, settings: GridSettings, cells: IntArray
    ) -> None:
        maps, self._scale, self._settings = views.depth_views(), frame_from_model.scale, settings
        # Divided by the scale, a rotation turns metres of the frame into lengths of the maps.
        rotation = np.ascontiguousarray(maps.cam_from_world @ frame_from_model.rotation.T / self._scale)
        center = np.ascontiguousarray(frame_from_model.apply(maps.center_in_world))
        self._views = (rotation, center, maps.intrinsics_px, maps.size_px, maps.start, maps.depth_m)
        self._cells = cells

    def chunks(self, square: IntArray) -> IntArray:
        """Return the chunks (C, 3) of a square that hold cells."""
        inside = (self._cells[:, :2] // (_CHUNK * _SQUARE) == square).all(axis=1)
        return np.unique(self._cells[inside] // _CHUNK, axis=0)

    def mesh(self, chunk: IntArray) -> RawMesh | None:
        """Return the mesh of a chunk; None: no surface passes through it."""
        from skimage.measure import marching_cubes

        low, voxel_m = chunk * _CHUNK, self._settings.voxel_m
        first, last = np.searchsorted(self._cells[:, 0], [low[0], low[0] + _CHUNK + 1])
        near = self._cells[first:last]
        cells = near[((near >= low) & (near <= low + _CHUNK)).all(axis=1)]
        side = _CHUNK * _CELL + 1
        middle, radius = (low + _CHUNK / 2) * _CELL * voxel_m, _CHUNK * _CELL * voxel_m
        seen = [
            view
            for view in range(len(self._views[0]))
            if sees_sphere(middle, radius / self._scale, *(values[view] for values in self._views[:4]))
        ]
        total, weight = np.zeros((side,) * 3, np.float32), np.zeros((side,) * 3, np.float32)
        limits = np.array([self._settings.truncation_m, self._settings.coarsest_m]) / self._scale
        _integrate(cells, low, voxel_m, self._scale, limits, np.array(seen, np.int64), self._views, total, weight)
        known = weight > 0
        cubes = known[1:] & known[:-1]
        cubes = cubes[:, 1:] & cubes[:, :-1]
        cubes = cubes[:, :, 1:] & cubes[:, :, :-1]
        distance = np.divide(total, weight, out=np.full_like(total, limits[0]), where=known)
        if not (distance < 0).any() or not cubes.any():
            return None
        mask = np.zeros((side,) * 3, dtype=bool)
        mask[1:, 1:, 1:] = cubes
        try:
            vertices, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent", mask=mask)
        except (RuntimeError, ValueError):  # no zero in the mask
            return None
        return RawMesh((vertices.astype(np.float64) + low * _CELL) * voxel_m, faces.astype(np.int64))


@njit(nogil=True, error_model="numpy")
def _distance(point: Any, view: int, views: Any, truncation: float, coarsest: float) -> tuple[float, float]:
    """Return a view's distance of a point from its surface, and the weight; the weight is 0 if it says nothing."""
    rotations, centers, intrinsics_px, sizes, starts, depth = views
    x, y, z = point_in_cam(point, rotations[view], centers[view])
    if z <= 0:
        return 0.0, 0.0
    intrinsics, width, height = intrinsics_px[view], sizes[view, 0], sizes[view, 1]
    u = intrinsics[0] * x / z + intrinsics[2]
    v = intrinsics[1] * y / z + intrinsics[3]
    if not (u >= REACH_PX and u < width - REACH_PX and v >= REACH_PX and v < height - REACH_PX):
        return 0.0, 0.0
    here = starts[view] + int(v) * width + int(u)
    own, left, right = depth[here], depth[here - REACH_PX], depth[here + REACH_PX]
    above, below = depth[here - REACH_PX * width], depth[here + REACH_PX * width]
    if min(own, left, right, above, below) <= 0:
        return 0.0, 0.0
    if max(abs(own / left + own / right - 2), abs(own / above + own / below - 2)) > BEND:
        # A rim: what lies clearly before all of it is free, more is not known.
        nearest = min(own, left, right, above, below)
        return truncation, (intrinsics[0] / nearest) ** 2 if z < nearest - truncation else 0.0
    inverse = 1 / surface_at(depth, starts[view], width, height, u, v)
    along_u, along_v = (1 / right - 1 / left) / (2 * REACH_PX), (1 / below - 1 / above) / (2 * REACH_PX)
    # The plane of the surface in the camera's frame: normal · X = 1.
    ahead = inverse - (u - intrinsics[2]) * along_u - (v - intrinsics[3]) * along_v
    length = np.sqrt((intrinsics[0] * along_u) ** 2 + (intrinsics[1] * along_v) ** 2 + ahead**2)
    distance = (1 - z * inverse) / length
    cosine = z * inverse / (length * np.sqrt(x * x + y * y + z * z))
    if distance < -truncation:
        return 0.0, 0.0
    if distance < truncation and (cosine < GRAZING or 1 / (inverse * intrinsics[0]) > coarsest):
        return 0.0, 0.0
    return min(distance, truncation), cosine * (inverse * intrinsics[0]) ** 2


@kernel(parallel=True, nogil=True, error_model="numpy")
def _integrate(
    cells: Any, low: Any, voxel: float, scale: float, limits: Any, seen: Any, views: Any, total: Any, weight: Any
) -> None:
    """Add the weighted distances of the voxels of cells (K, 3) to a chunk whose first cell is `low`."""
    side = total.shape[0]
    for row in prange(len(cells)):
        cell = cells[row]
        middle, point = np.empty(3), np.empty(3)
        for k in range(3):
            middle[k] = (cell[k] + 0.5) * _CELL * voxel
        finest, finest_px = np.empty(_FINEST, np.int64), np.zeros(_FINEST)  # views, by pixels on a metre
        for view in seen:
            if not sees_sphere(
                middle, _CELL * voxel / scale, views[0][view], views[1][view], views[2][view], views[3][view]
            ):
                continue
            _, _, z = point_in_cam(middle, views[0][view], views[1][view])
            place = np.argmin(finest_px)
            if z > 0 and views[2][view, 0] / z > finest_px[place]:
                finest[place], finest_px[place] = view, views[2][view, 0] / z
        for view in finest[finest_px > 0]:
            for a in range(_CELL):
                i = (cell[0] - low[0]) * _CELL + a
                point[0] = (cell[0] * _CELL + a) * voxel
                for b in range(_CELL):
                    j = (cell[1] - low[1]) * _CELL + b
                    point[1] = (cell[1] * _CELL + b) * voxel
                    for c in range(_CELL):
                        k = (cell[2] - low[2]) * _CELL + c
                        if max(i, j, k) >= side:
                            continue
                        point[2] = (cell[2] * _CELL + c) * voxel
                        distance, share = _distance(point, view, views, limits[0], limits[1])
                        total[i, j, k] += share * distance
                        weight[i, j, k] += share
