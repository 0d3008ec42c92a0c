"""Surveyed points, measured by model: places of the Gaussians' surface behind their marks.

This is the accuracy for a reader who intersects the rendered surface. A viewer that picks the centres of Gaussians
measures other points.
"""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.robust.statistics import spatial_median
from pipelines.scene.marks import MarkRays
from pipelines.scene.trained_survey import TrainedSurvey

_REACH_PX = 1  # around the pixel of a mark
_EDGE_STEP = 0.04  # of the depth; on ground seen under 30° the depth changes by 0.6 % within the reach
_SAME_SURFACE = 0.01  # of the depth: largest difference between pixels of one surface


def points_by_model(
    trained: TrainedSurvey, rays: MarkRays, depth_m: dict[int, FloatArray], pinholes: dict[int, Pinhole]
) -> FloatArray:
    """Return the points (J, 3) in `geo` at which the model's surface lies behind their marks.

    1. In each view, the point is the place of the surface on the ray of its mark.
    2. Beside an edge of the surface, a fraction of a pixel decides between roof and ground. Views with an edge at
       the mark do not count for a point that two or more other views show on unbroken surface.
    3. The result is the spatial median of the views; NaN for a point with fewer than two.

    Args:
        trained: the trained model.
        rays: of the marks of J points.
        depth_m: by camera, depth (H, W) of the surface along z in metres; 0 where there is none.
        pinholes: by camera, pinhole of the depth map.
    """
    unbroken: list[list[FloatArray]] = [[] for _ in rays.point_id]
    at_edge: list[list[FloatArray]] = [[] for _ in rays.point_id]
    for point, camera, xy in zip(rays.point, rays.camera, rays.xy, strict=True):
        view, pinhole = depth_m[int(camera)], pinholes[int(camera)]
        depth = _depth_at(view, pinhole, xy)
        if depth > 0:
            in_cam = depth * np.append(xy, 1.0)
            in_model = trained.poses.cam_from_model[camera].T @ in_cam + trained.poses.cam_center_in_model[camera]
            (at_edge if _is_at_edge(view, pinhole, xy) else unbroken)[point].append(in_model)
    hits = [good if len(good) >= 2 else good + poor for good, poor in zip(unbroken, at_edge, strict=True)]
    middle = np.array([spatial_median(hit) if len(hit) >= 2 else np.full(3, np.nan) for hit in hits])
    return trained.geo_from_model.apply(middle.reshape(-1, 3))


def _is_at_edge(depth_m: FloatArray, camera: Pinhole, xy: FloatArray) -> bool:
    """Return whether the depth around a ray changes by more than on a slope."""
    around = _around(depth_m, *_pixel(camera, xy))
    return bool(around.size == 0 or around.max() > (1 + _EDGE_STEP) * around.min())


def _depth_at(depth_m: FloatArray, camera: Pinhole, xy: FloatArray) -> float:
    """Return the depth at a ray, on a plane through the pixels of the same surface around it; 0: no surface.

    Gaussians make the surface rough from pixel to pixel, and a plane through several pixels evens that out. The
    inverse depth of a plane is linear on the image.
    """
    x, y = _pixel(camera, xy)
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return 0.0
    own_depth_m = float(depth_m[int(y), int(x)])
    around = np.asarray(_around(depth_m, x, y), dtype=np.float64)
    rows, columns = np.nonzero((np.abs(around - own_depth_m) < _SAME_SURFACE * own_depth_m) & (around > 0))
    right = columns + max(int(x) - _REACH_PX, 0) + 0.5 - x
    down = rows + max(int(y) - _REACH_PX, 0) + 0.5 - y
    if len(rows) < 3 or np.ptp(rows) == 0 or np.ptp(columns) == 0:  # these pixels determine no plane
        return own_depth_m
    design = np.stack([np.ones(len(rows)), right, down], axis=1)
    return float(1.0 / np.linalg.lstsq(design, 1.0 / around[rows, columns])[0][0])


def _pixel(camera: Pinhole, xy: FloatArray) -> tuple[float, float]:
    return camera.fx * float(xy[0]) + camera.cx, camera.fy * float(xy[1]) + camera.cy


def _around(depth_m: FloatArray, x: float, y: float) -> FloatArray:
    """Return the depths of the pixels within the reach of a place on the image."""
    top, left = max(int(y) - _REACH_PX, 0), max(int(x) - _REACH_PX, 0)
    return depth_m[top : int(y) + _REACH_PX + 1, left : int(x) + _REACH_PX + 1]
