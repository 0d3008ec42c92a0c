"""Surveyed points on the rendered surface: places of the Gaussians' surface behind their marks.

This is the accuracy for a reader who intersects the rendered surface. A viewer that picks the centres of Gaussians
measures other points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole
from pipelines.robust.statistics import spatial_median
from pipelines.scene.marks import MarkRays
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.trained_survey import TrainedSurvey
from pipelines.splat.rasterizer.api import Window

REACH_PX = 1  # around the pixel of a mark
LEAST_VIEWS = 2  # that must show a point
_EDGE_STEP = 0.04  # of the depth; on ground seen under 30° the depth changes by 0.6 % within the reach
_SAME_SURFACE = 0.01  # of the depth: largest difference between pixels of one surface


@dataclass(frozen=True)
class DepthMap:
    """Depth of the surface as one camera sees it: the whole view, or a window of it.

    Attributes:
        pinhole: of the whole view.
        depth_m: (h, w) along the camera's z axis; 0: no surface.
        left, top: pixels of the view to the left of the window, and above it.
    """

    pinhole: Pinhole
    depth_m: FloatArray
    left: int = 0
    top: int = 0

    def holds(self, xy: FloatArray) -> bool:
        """Return whether the pixel of a ray (2,) is here."""
        x, y = self._pixel(xy)
        rows, columns = self.depth_m.shape
        return bool(self.left <= x < self.left + columns and self.top <= y < self.top + rows)

    def around(self, x: float, y: float) -> FloatArray:
        """Return the depths of the pixels within the reach of a place on the image."""
        column, row = int(x) - self.left, int(y) - self.top
        top, left = max(row - REACH_PX, 0), max(column - REACH_PX, 0)
        return np.asarray(self.depth_m[top : row + REACH_PX + 1, left : column + REACH_PX + 1])

    def depth_at(self, xy: FloatArray) -> float:
        """Return the depth at a ray, on a plane through the pixels of the same surface around it; 0: no surface.

        Gaussians make the surface rough from pixel to pixel, and a plane through several pixels evens that out. The
        inverse depth of a plane is linear on the image.

        Args:
            xy: (2,) x/z and y/z of the ray.
        """
        x, y = self._pixel(xy)
        if not self.holds(xy):
            return 0.0
        own_depth_m = float(self.depth_m[int(y) - self.top, int(x) - self.left])
        around = np.asarray(self.around(x, y), dtype=np.float64)
        rows, columns = np.nonzero((np.abs(around - own_depth_m) < _SAME_SURFACE * own_depth_m) & (around > 0))
        right = columns + max(int(x) - REACH_PX, self.left) + 0.5 - x
        down = rows + max(int(y) - REACH_PX, self.top) + 0.5 - y
        if len(rows) < 3 or np.ptp(rows) == 0 or np.ptp(columns) == 0:  # these pixels determine no plane
            return own_depth_m
        design = np.stack([np.ones(len(rows)), right, down], axis=1)
        return float(1.0 / np.linalg.lstsq(design, 1.0 / around[rows, columns])[0][0])

    def is_at_edge(self, xy: FloatArray) -> bool:
        """Return whether the depth around a ray (2,) changes by more than on a slope."""
        around = self.around(*self._pixel(xy))
        return bool(around.size == 0 or around.max() > (1 + _EDGE_STEP) * around.min())

    def _pixel(self, xy: FloatArray) -> tuple[float, float]:
        camera = self.pinhole
        return camera.fx * float(xy[0]) + camera.cx, camera.fy * float(xy[1]) + camera.cy


@dataclass(frozen=True)
class SurfaceHits:
    """Places of the surface on K rays, each as the ray's own view shows it.

    Attributes:
        position_in_model: (K, 3) metres; NaN: no surface.
        at_edge: (K,) whether the surface ends within a pixel of the ray.
    """

    position_in_model: FloatArray
    at_edge: BoolArray

    def counted(self, rows: IntArray) -> IntArray:
        """Return the rows that count for one point, among its own: those on unbroken surface, if two or more are.

        Beside an edge of the surface, a fraction of a pixel decides between roof and ground.
        """
        rows = rows[np.isfinite(self.position_in_model[rows]).all(axis=1)]
        unbroken = rows[~self.at_edge[rows]]
        return unbroken if len(unbroken) >= LEAST_VIEWS else rows


def depth_around(renderer: ModelRenderer, camera: int, xy: FloatArray, reach_px: int = REACH_PX) -> DepthMap:
    """Return the depth within some pixels of a ray; empty if the ray misses the image.

    Everybody who measures renders the same small windows. Where the Gaussians of a pixel nearly lie on one surface,
    rounding decides how its depth is taken, and another window would round in another way.

    Args:
        renderer: of the trained model.
        camera: index of the camera.
        xy: (2,) x/z and y/z of the ray.
        reach_px: pixels to each side of the ray's.
    """
    pose = renderer.pose(camera)
    pinhole = pose.pinhole
    place = np.floor([pinhole.fx * xy[0] + pinhole.cx, pinhole.fy * xy[1] + pinhole.cy])
    column, row = np.clip(place, -reach_px - 1, [pinhole.width + reach_px, pinhole.height + reach_px]).astype(int)
    left, top = max(int(column) - reach_px, 0), max(int(row) - reach_px, 0)
    width = min(int(column) + reach_px + 1, pinhole.width) - left
    height = min(int(row) + reach_px + 1, pinhole.height) - top
    if width < 1 or height < 1:
        return DepthMap(pinhole, np.zeros((0, 0)))
    return DepthMap(pinhole, renderer.depth_from(pose, Window(left, top, width, height)), left, top)


def surface_hits(trained: TrainedSurvey, rays: MarkRays, maps: Sequence[DepthMap]) -> SurfaceHits:
    """Return where the rays of marks meet the surface of their own views.

    Args:
        trained: the trained model.
        rays: of K marks.
        maps: K, the depth around each mark in its view.
    """
    position, at_edge = np.full((len(rays), 3), np.nan), np.zeros(len(rays), dtype=bool)
    for row, (camera, xy, view) in enumerate(zip(rays.camera, rays.xy, maps, strict=True)):
        depth = view.depth_at(xy)
        if depth > 0:
            in_cam = depth * np.append(xy, 1.0)
            position[row] = (
                trained.poses.cam_from_model[camera].T @ in_cam + trained.poses.cam_center_in_model[camera]
            )
            at_edge[row] = view.is_at_edge(xy)
    return SurfaceHits(position, at_edge)


def points_by_model(trained: TrainedSurvey, rays: MarkRays, maps: Sequence[DepthMap]) -> FloatArray:
    """Return the points (J, 3) in `geo` at which the model's surface lies behind their marks.

    The result is the spatial median of the views that count (`SurfaceHits.counted`); NaN for a point with fewer
    than two.

    Args:
        trained: the trained model.
        rays: K marks of J points.
        maps: K, the depth around each mark in its view.
    """
    hits = surface_hits(trained, rays, maps)
    middle = np.full((len(rays.point_id), 3), np.nan)
    for point in range(len(middle)):
        counted = hits.counted(np.flatnonzero(rays.point == point))
        if len(counted) >= LEAST_VIEWS:
            middle[point] = spatial_median(hits.position_in_model[counted])
    return trained.geo_from_model.apply(middle)
