"""Surface of the scene, from the depth maps of its training photographs, and weights of its points.

Training starts from this surface, and its depth loss compares with it. On ground with little texture, Gaussians
would otherwise float metres above the ground, and their renders would fit the photographs as well.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray, joined_rows, rows_of
from pipelines.geometry.footprints import count_voxels, thin_to_voxels
from pipelines.surface.agreement import bends
from pipelines.surface.depth_maps import DepthMaps

_WINDOW_PX = 5  # side of the window that contrast is averaged over
_MEDIAN_WEIGHT = 2.5  # at the median contrast of the known surface
_MOST = 12.0
_BROKEN = 0.3  # weight where the surface bends or ends
_SAMPLE = 4  # of rows and columns, for the median
_REACH_PX = 3  # of the test for an unbroken surface
_PLANE_BEND = 0.005  # limit of a surface's bend to either side


def depth_loss_weights(rgb: ByteArray, depth_m: Float32Array) -> Float32Array:
    """Return weights (H, W) of the depth loss, 0.3 … 12, proportional to the contrast of the photograph (H, W, 3).

    Gaussians are blended in the order of their centres. The photometric loss therefore draws the Gaussians of a
    slanted surface behind it, with a force that grows with the contrast: most of all those of small details, such
    as windows and survey targets. Stereo is most exact at these places. Where the surface bends, or ends within
    `_REACH_PX`, stereo is least exact, and the weight is smallest. Depths along the optical axis are 0 if unknown.
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
    return np.asarray(np.all([np.abs(bend) < _PLANE_BEND for bend in bends(depth_m, _REACH_PX)], axis=0))


_NORMAL_REACH_PX = 3
_BEND = 0.02  # limit of a smooth surface's bend to either side
_CANDIDATES = 8  # drawn for each wanted point, so that they cover places that few views see


@dataclass(frozen=True)
class SurfacePoints:
    """P points of the surface."""

    point_in_model: FloatArray  # (P, 3) metres
    rgb: ByteArray  # (P, 3) uint8
    normal_in_model: FloatArray  # (P, 3) unit vectors with an arbitrary sign; NaN where unknown


class SceneSurface:
    """Surface that the depth maps of all training views, already built, show together."""

    def __init__(self, maps: DepthMaps) -> None:
        self.maps = maps
        self._train, self._poses = maps.scene.train, maps.scene.poses

    def points(self, index: int, stride: int = 1) -> FloatArray:
        """Return the points (P, 3) in `model` that a training view sees at every `stride`-th pixel, in metres."""
        rows, columns = np.nonzero(self.maps.depth(index)[::stride, ::stride])
        return self._points(index, stride * rows, stride * columns)

    def depth_loss_points(self, index: int, stride: int) -> tuple[FloatArray, Float32Array]:
        """Return the points (P, 3) in `model` of a training view's depth loss, and the weight of each (P,).

        The points are those of `points`, with the weights of `depth_loss_weights`.
        """
        depth = self.maps.depth(index)
        rows, columns = np.nonzero(depth[::stride, ::stride])
        weight = depth_loss_weights(self.maps.rgb(index), depth)[stride * rows, stride * columns]
        return self._points(index, stride * rows, stride * columns), weight

    def known_share(self) -> float:
        """Return the fraction of the training photographs' pixels whose depth is known, 0 … 1."""
        depths = (self.maps.depth(index) for index in map(int, self._train))
        return float(np.mean([np.mean(depth > 0) for depth in depths]))

    def sample(
        self, count: int, seed: int, inside: Callable[[FloatArray], BoolArray] | None = None
    ) -> SurfacePoints:
        """Return points of the whole surface, as dense as the photographs resolve it, at most `count`.

        Those that count are `inside`, which returns a mask (N,) of points (N, 3); None: all.
        """
        rng = np.random.default_rng(seed)
        share = -(-_CANDIDATES * count // max(len(self._train), 1))
        views, sizes = [], []
        for index in map(int, self._train):
            rows, columns = np.nonzero(self.maps.depth(index))
            chosen = rng.permutation(len(rows))[:share]
            rows, columns = rows[chosen], columns[chosen]
            normals = self._normals(index, rows, columns)
            rgb = self.maps.rgb(index)[rows, columns]
            views.append(SurfacePoints(self._points(index, rows, columns), rgb, normals))
            sizes.append(self.maps.depth(index)[rows, columns].astype(np.float64) / self.maps.camera(index).fx)
        candidates, size_m = joined_rows(views), np.concatenate(sizes)
        if inside is not None:
            kept = np.flatnonzero(inside(candidates.point_in_model))
            candidates, size_m = rows_of(candidates, kept), size_m[kept]
        return rows_of(candidates, spread_evenly(candidates.point_in_model, size_m, count))

    def _normals(self, index: int, rows: IntArray, columns: IntArray) -> FloatArray:
        """Return unit normals (P, 3) of the surface at pixels of a view; NaN at the edges of surface and image."""
        depth = self.maps.depth(index)
        inside = (rows >= _NORMAL_REACH_PX) & (rows < depth.shape[0] - _NORMAL_REACH_PX)
        inside &= (columns >= _NORMAL_REACH_PX) & (columns < depth.shape[1] - _NORMAL_REACH_PX)
        normals = np.full((len(rows), 3), np.nan)
        inner = np.flatnonzero(inside)
        places = [
            (rows[inner] + _NORMAL_REACH_PX * down, columns[inner] + _NORMAL_REACH_PX * right)
            for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        bent = bends(depth, _NORMAL_REACH_PX, ((0, 1), (1, 0)))
        smooth = np.all([np.abs(bend[rows[inner], columns[inner]]) < _BEND for bend in bent], axis=0)
        right, left, below, above = (self._points(index, *place) for place in places)
        normal = np.cross(right - left, below - above)[smooth]
        normals[inner[smooth]] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return normals

    def _points(self, index: int, rows: IntArray, columns: IntArray) -> FloatArray:
        depth, poses = self.maps.depth(index)[rows, columns].astype(np.float64), self._poses
        ray = self.maps.camera(index).rays(np.stack([columns, rows], axis=1) + 0.5)
        turned = (depth[:, None] * ray) @ poses.cam_from_model[index]
        return np.asarray(poses.cam_center_in_model[index] + turned)


_ALIKE = 1.01  # ratio of cubes' sides that make no difference


def spread_evenly(points: FloatArray, size_m: FloatArray, count: int) -> IntArray:
    """Return the indices of evenly spread points (P, 3), of sizes (P,) in metres, at most `count` of them.

    One is in each cube, whose side is proportional to the point's size. If there are no more points, all are kept.
    """
    if len(points) <= count:
        return np.arange(len(points))
    fine, coarse = 2.0**-4, 2.0**12
    above = points - points.min(axis=0)
    while coarse > _ALIKE * fine:
        middle = float(np.sqrt(fine * coarse))
        if count_voxels(above, middle * size_m) > count:
            fine = middle
        else:
            coarse = middle
    return thin_to_voxels(above, coarse * size_m)
