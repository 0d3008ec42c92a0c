"""The scene's surface, from the depth maps of its training photographs.

Training starts from it and holds the Gaussians to it. On ground with little texture they would otherwise float
metres above where they belong, with the photographs none the worse for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.geometry.thinning import thin_to_voxels
from pipelines.train.depth_maps import DepthMaps

_NORMAL_REACH_PX = 3
_BEND = 0.02  # of the depth, by which a pixel departs from the middle between those on either side
_CANDIDATES = 8  # drawn for each point wanted: enough to cover what few views see


@dataclass(frozen=True)
class SurfacePoints:
    """P points of the surface.

    Attributes:
        point_in_model: (P, 3) metres.
        rgb: (P, 3) uint8.
        normal_in_model: (P, 3) unit vectors, of either sign; NaN where unknown.
    """

    point_in_model: FloatArray
    rgb: ByteArray
    normal_in_model: FloatArray

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        """All of some, one after the other; at least one."""
        return SurfacePoints(
            np.concatenate([part.point_in_model for part in parts]),
            np.concatenate([part.rgb for part in parts]),
            np.concatenate([part.normal_in_model for part in parts]),
        )

    def part(self, rows: IntArray) -> SurfacePoints:
        """Some of them."""
        return SurfacePoints(self.point_in_model[rows], self.rgb[rows], self.normal_in_model[rows])


class SceneSurface:
    """The surface that depth maps show together.

    Args:
        maps: built.
    """

    def __init__(self, maps: DepthMaps) -> None:
        self._maps = maps
        self._train, self._poses = maps.scene.train, maps.scene.poses

    def points(self, index: int, stride: int = 1) -> FloatArray:
        """Surface points (P, 3) in `model` that a training view sees, of every `stride`-th row and column."""
        rows, columns = np.nonzero(self._maps.depth(index)[::stride, ::stride])
        return self._points(index, stride * rows, stride * columns)

    def known_share(self) -> float:
        """Part of the training photographs' pixels whose surface is known, 0 … 1."""
        depths = (self._maps.depth(index) for index in map(int, self._train))
        return float(np.mean([np.mean(depth > 0) for depth in depths]))

    def sample(self, count: int, seed: int) -> SurfacePoints:
        """At most `count` points of the whole surface, as dense as the photographs show it."""
        rng = np.random.default_rng(seed)
        share = -(-_CANDIDATES * count // max(len(self._train), 1))
        views, sizes = [], []
        for index in map(int, self._train):
            rows, columns = np.nonzero(self._maps.depth(index))
            chosen = rng.permutation(len(rows))[:share]
            rows, columns = rows[chosen], columns[chosen]
            normals = self._normals(index, rows, columns)
            rgb = self._maps.rgb(index)[rows, columns]
            views.append(SurfacePoints(self._points(index, rows, columns), rgb, normals))
            sizes.append(self._maps.depth(index)[rows, columns].astype(np.float64) / self._maps.camera(index).fx)
        candidates = SurfacePoints.concatenate(views)
        return candidates.part(spread_evenly(candidates.point_in_model, np.concatenate(sizes), count))

    def _normals(self, index: int, rows: IntArray, columns: IntArray) -> FloatArray:
        """Unit vectors (P, 3) across the surface at pixels of a view; NaN at its edges."""
        depth = self._maps.depth(index)
        inside = (rows >= _NORMAL_REACH_PX) & (rows < depth.shape[0] - _NORMAL_REACH_PX)
        inside &= (columns >= _NORMAL_REACH_PX) & (columns < depth.shape[1] - _NORMAL_REACH_PX)
        normals = np.full((len(rows), 3), np.nan)
        inner = np.flatnonzero(inside)
        places = [
            (rows[inner] + _NORMAL_REACH_PX * down, columns[inner] + _NORMAL_REACH_PX * right)
            for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        # On a plane the inverse depth is linear, however steeply it is seen.
        with np.errstate(divide="ignore"):
            around = np.stack([depth[rows[inner], columns[inner]] / depth[place] for place in places])
        smooth = (np.abs(around[::2] + around[1::2] - 2) < _BEND).all(axis=0)
        right, left, below, above = (self._points(index, *place) for place in places)
        normal = np.cross(right - left, below - above)[smooth]
        normals[inner[smooth]] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return normals

    def _points(self, index: int, rows: IntArray, columns: IntArray) -> FloatArray:
        depth, poses = self._maps.depth(index)[rows, columns].astype(np.float64), self._poses
        ray = self._maps.camera(index).rays(np.stack([columns, rows], axis=1) + 0.5)
        turned = (depth[:, None] * ray) @ poses.cam_from_model[index]
        return np.asarray(poses.cam_center_in_model[index] + turned)


def spread_evenly(points: FloatArray, size_m: FloatArray, count: int) -> IntArray:
    """Indices of points (P, 3), at most `count`, one in each cube whose side is proportional to their size (P,)."""
    if len(points) <= count:
        return np.arange(len(points))
    fine, coarse = 2.0**-4, 2.0**12
    low, kept = points.min(axis=0), np.arange(1)
    for _ in range(16):
        middle = float(np.sqrt(fine * coarse))
        first = thin_to_voxels(points - low, middle * size_m)
        if len(first) > count:
            fine = middle
        else:
            coarse, kept = middle, first
    return kept
