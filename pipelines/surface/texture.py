"""Colours of a mesh from the photographs: those of its vertices, and a texture for planar charts.

A place has the mean of the photographs that resolve it best, among those whose depth maps show it. Charts are
connected faces of one block that look along the same axis, projected along that: it takes time in proportion to the
faces. Where a chart folds over itself, both layers share their texels.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import njit, prange
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import (
    ArrayHWC,
    ArrayN3,
    ArrayNK,
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)
from pipelines.geometry.footprints import row_numbers, voxel_keys
from pipelines.geometry.similarity import Similarity
from pipelines.splat.kernel_cache import kernel
from pipelines.surface.mesh import RawMesh, edges_of, vertex_normals
from pipelines.surface.surface_views import SAME_SURFACE, SurfaceViews
from pipelines.surface.visibility import ViewArrays, point_in_cam, sees_sphere, surface_at

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

_BEST = 4  # photographs that a colour is the mean of
_BATCH, _GROUP = 1_000_000, 20_000  # places that are coloured at once, and that are asked for together in a view
_GREY = 128  # where no photograph shows anything
_BLOCK_TEXELS, _PADDING = 64, 2  # side of the blocks of charts, and texels around a chart
_LARGEST = 8192  # texels along a side, which viewers load
_COARSER = 1.25


@dataclass(frozen=True)
class TexturedMesh:
    """Mesh (V, 3), (F, 3) whose vertices are those of one chart each, with their places (V, 2) in the texture.

    Places are parts of the image (H, W, 3), from its upper left corner.
    """

    mesh: RawMesh
    uv: FloatArray
    image: ByteArray
    texel_m: float


def photographed_colours(
    points: FloatArray, normals: FloatArray, views: SurfaceViews, frame_from_model: Similarity
) -> tuple[ByteArray, BoolArray]:
    """Return the colours (N, 3) of places (N, 3) of the frame with unit normals (N, 3), and where one is known."""
    maps, rgb = views.depth_views(), np.full((len(points), 3), _GREY, np.uint8)
    cameras = tuple(vars(maps).values())
    photograph = cache(views.photograph)
    known = np.zeros(len(points), dtype=bool)
    for first in range(0, len(points), _BATCH):
        part = slice(first, first + _BATCH)
        place = frame_from_model.inverse().apply(points[part])
        normal = np.asarray(normals[part] @ frame_from_model.rotation)
        for rows in _near_each_other(place):
            near, towards = np.ascontiguousarray(place[rows]), np.ascontiguousarray(normal[rows])
            score, colour = np.zeros((len(rows), _BEST), np.float32), np.zeros((len(rows), _BEST, 3), np.float32)
            low, high = near.min(axis=0), near.max(axis=0)
            middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 1.99
            for view in range(len(views)):
                if sees_sphere(middle, radius, *(values[view] for values in cameras[:4])):
                    _add_colours(near, towards, cameras, view, *photograph(view), score, colour)
            total = score.sum(axis=1, keepdims=True)
            seen = total[:, 0] > 0
            mean = (score[..., None] * colour).sum(axis=1) / np.maximum(total, np.finfo(np.float32).tiny)
            known[first + rows] = seen
            rgb[first + rows[seen]] = np.clip(np.round(mean[seen]), 0, 255)
    return rgb, known


def _near_each_other(places: FloatArray) -> list[IntArray]:
    """Return the rows of places (N, 3) in groups of about `_GROUP` in one part of the space: few views see each."""
    side = float(np.ptp(places, axis=0).max()) / max((len(places) / _GROUP) ** 0.5, 1.0)
    key = voxel_keys(places, max(side, 1e-6))
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


@kernel(parallel=True, nogil=True, error_model="numpy")
def _add_colours(
    points: ArrayN3,  # (N, 3) float64
    normals: ArrayN3,  # (N, 3) float64
    views: ViewArrays,  # see `DepthViews`
    view: int,
    photo: ArrayHWC,  # (H, W, 3) uint8
    plain: ArrayNK,  # (3, 4) float64
    score: Float32Array,  # (N, _BEST) float32
    colour: Float32Array,  # (N, _BEST, 3) float32
) -> None:
    """Put a view among the best of the places that its depth map shows; scores are pixels on a square metre."""
    rotations, centers, intrinsics_px, sizes, starts, depth = views
    fx, fy, cx, cy = intrinsics_px[view]
    width, height = sizes[view]
    for row in prange(len(points)):
        x, y, z = point_in_cam(points[row], rotations[view], centers[view])
        if z <= 0:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= 1 and u < width - 1 and v >= 1 and v < height - 1):
            continue
        if abs(surface_at(depth, starts[view], width, height, u, v) - z) > SAME_SURFACE * z:
            continue
        towards = 0.0
        for k in range(3):
            towards += (centers[view, k] - points[row, k]) * normals[row, k]
        own = towards / np.sqrt(x * x + y * y + z * z) * (fx / z) ** 2
        if own <= score[row, _BEST - 1]:
            continue
        place = _BEST - 1
        while place > 0 and score[row, place - 1] < own:
            score[row, place] = score[row, place - 1]
            colour[row, place] = colour[row, place - 1]
            place -= 1
        score[row, place] = own
        for k in range(3):
            colour[row, place, k] = plain[k, 3]
            for band in range(3):
                colour[row, place, k] += plain[k, band] * _bilinear(photo, u - 0.5, v - 0.5, band)


@njit(nogil=True, error_model="numpy")
def _bilinear(
    photo: ArrayHWC,  # (H, W, 3) uint8
    column: float,
    row: float,
    band: int,
) -> float:
    i, j = int(row), int(column)
    down, right = row - i, column - j
    above = (1 - right) * photo[i, j, band] + right * photo[i, j + 1, band]
    below = (1 - right) * photo[i + 1, j, band] + right * photo[i + 1, j + 1, band]
    return (1 - down) * above + down * below


def textured(
    mesh: RawMesh,
    views: SurfaceViews,
    frame_from_model: Similarity,
    texel_m: float,
    progress: Progress = SILENT,
    *,
    surface_faces: int | None = None,
) -> TexturedMesh:
    """Return a mesh with a texture; texels are made wider where it would not fit into 8192 × 8192.

    Faces after the first `surface_faces`, which closed the mesh, share one grey texel.
    """
    with progress.task("texture", 3) as task:
        chart, axis = _charts(RawMesh(mesh.vertices, mesh.faces[:surface_faces]), _BLOCK_TEXELS * texel_m)
        grey, axis = len(axis), np.append(axis, 0)
        chart = np.append(chart, np.full(len(mesh.faces) - len(chart), grey))
        # A vertex of two charts becomes two.
        total = max(len(mesh.vertices), 1)
        corner, member = np.unique(np.repeat(chart, 3) * total + mesh.faces.ravel(), return_inverse=True)
        (of_chart, shown), faces = np.divmod(corner, total), member.reshape(-1, 3)
        vertices = mesh.vertices[shown]
        plane = np.array([[1, 2], [0, 2], [0, 1]])[axis[of_chart]]
        flat = np.take_along_axis(vertices, plane, axis=1)
        flat[of_chart == grey] = 0
        low, high = (np.full((len(axis), 2), sign * np.inf) for sign in (1, -1))
        low[grey] = high[grey] = 0
        np.minimum.at(low, of_chart, flat)
        np.maximum.at(high, of_chart, flat)
        while True:
            size = np.ceil((high - low) / texel_m).astype(np.int64) + 1 + 2 * _PADDING
            place, side = _packed(size)
            if side <= _LARGEST:
                break
            texel_m *= _COARSER
        at = place[of_chart] + _PADDING + 0.5 + (flat - low[of_chart]) / texel_m  # in texels: column, row
        task.advance()
        normal = vertex_normals(mesh)[shown]
        image, empty = np.full((side * side, 3), _GREY, np.uint8), np.ones(side * side, dtype=bool)
        column, row = place[grey] + _PADDING
        empty[row * side + column] = False
        for part in _batches(at, faces[:surface_faces]):
            face, weight, texel = _texels(at, part, side)
            places, towards = (np.einsum("nk,nkj->nj", weight, of[part[face]]) for of in (vertices, normal))
            rgb, known = photographed_colours(places, towards, views, frame_from_model)
            image[texel[known]], empty[texel[known]] = rgb[known], False
        task.advance()
        if not empty.all():
            nearest = distance_transform_edt(empty.reshape(side, side), return_distances=False, return_indices=True)
            image = image.reshape(side, side, 3)[nearest[0], nearest[1]]
        task.advance()
    return TexturedMesh(RawMesh(vertices, faces), at / side, image.reshape(side, side, 3), texel_m)


def _charts(mesh: RawMesh, block_m: float) -> tuple[IntArray, IntArray]:
    """Return the chart (F,) of each face, and the axis (C,) along which each chart is projected."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    axis = np.abs(normal).argmax(axis=1)
    side = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0
    block = np.floor((a + b + c) / (3 * block_m)).astype(np.int64)
    kind = row_numbers(np.column_stack([block, axis, side]))
    # Faces of one kind that share an edge belong together.
    edge, _ = edges_of(mesh.faces)
    owner, order = np.repeat(np.arange(len(mesh.faces)), 3), np.argsort(edge, kind="stable")
    shared = edge[order[1:]] == edge[order[:-1]]
    first, second = owner[order[:-1]][shared], owner[order[1:]][shared]
    same = kind[first] == kind[second]
    links = coo_array((np.ones(int(same.sum())), (first[same], second[same])), (len(owner) // 3,) * 2)
    count, chart = connected_components(links, directed=False)
    of_chart = np.zeros(count, np.int64)
    of_chart[chart] = axis
    return chart, of_chart


def _packed(size: IntArray) -> tuple[IntArray, int]:
    """Return the places (C, 2) of rectangles (C, 2) in a square, and its side: in rows, the highest first."""
    side = int(max(np.sqrt(size.prod(axis=1).sum()), size.max()))
    order = np.argsort(-size[:, 1], kind="stable")
    while True:
        place, column, row, height = np.zeros_like(size), 0, 0, 0
        for chart, (wide, high) in zip(order.tolist(), size[order].tolist(), strict=True):
            if column + wide > side:
                column, row, height = 0, row + height, 0
            place[chart] = column, row
            column, height = column + wide, max(height, high)
        if row + height <= side:
            return place, side
        side = int(1.05 * side) + 1


def _batches(at: FloatArray, faces: IntArray) -> list[IntArray]:
    """Return the faces in parts of about `_BATCH` texels of their bounding boxes, in their order in space."""
    size = np.prod(np.ptp(at[faces], axis=1) + 2, axis=1)
    part = (np.cumsum(size) / _BATCH).astype(np.int64)
    return np.split(faces, np.flatnonzero(np.diff(part)) + 1)


def _texels(at: FloatArray, faces: IntArray, side: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Return the face, the weights (K, 3) of its corners, and the number, of each texel whose middle is covered."""
    corner = at[faces]
    low, high = np.floor(corner.min(axis=1) - 0.5).astype(np.int64), np.ceil(corner.max(axis=1)).astype(np.int64)
    span = high - low + 1
    count = span.prod(axis=1)
    face = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column, row = low[face, 0] + within % span[face, 0], low[face, 1] + within // span[face, 0]
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    x, y = column + 0.5 - a[face, 0], row + 0.5 - a[face, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = (x * (c - a)[face, 1] - y * (c - a)[face, 0]) / area[face]
        third = (y * (b - a)[face, 0] - x * (b - a)[face, 1]) / area[face]
    weight = np.column_stack([1 - second - third, second, third])
    inside = (weight >= -1e-9).all(axis=1)
    return face[inside], weight[inside], (row * side + column)[inside]
