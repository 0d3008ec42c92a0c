"""Surveyed points found again in the model: by its cameras, and by its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole, undistort
from pipelines.geometry.intersection import intersect_rays
from pipelines.geometry.rays import Rays, UncertainCameras
from pipelines.robust.statistics import spatial_median
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained import Trained

# Rays of a mark are held to agree within their mark's σ and this much of the cameras' own error.
_SIGMA_CENTER_M = 0.02
_SIGMA_ATTITUDE_RAD = 2e-4
_REACH_PX = 1  # of what is looked at around a mark
_EDGE_STEP = 0.04  # of the depth; ground seen under 30° changes by 0.6 % within the reach
_SAME_SURFACE = 0.01  # of the depth


@dataclass(frozen=True)
class Sights:
    """K image marks of J surveyed points, in registered images.

    Attributes:
        point: (K,) index into the points, ascending.
        camera: (K,) index into the cameras.
        xy: (K, 2) undistorted x/z and y/z.
        sigma: (K,) σ of xy.
    """

    point: IntArray
    camera: IntArray
    xy: FloatArray
    sigma: FloatArray

    def part(self, chosen: IntArray) -> Sights:
        """Some of them."""
        return Sights(self.point[chosen], self.camera[chosen], self.xy[chosen], self.sigma[chosen])


def sights(trained: Trained, points: tuple[SurveyedPoint, ...]) -> Sights:
    """The marks of `points` in images that SfM has registered."""
    index = trained.sparse.image_index()
    rows = []
    for j, point in enumerate(points):
        for mark in point.marks:
            if (i := index.get(mark.image)) is not None:
                camera = trained.sparse.camera_of(i)
                xy = undistort(camera, np.array([mark.x_px, mark.y_px]))
                rows.append((j, i, xy, mark.sigma_px / float(camera.params[0])))
    return Sights(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 2),
        np.array([row[3] for row in rows], dtype=np.float64),
    )


def points_by_camera(trained: Trained, seen: Sights, count: int) -> FloatArray:
    """Points (J, 3) in `geo` where the rays of their marks meet; NaN with fewer than two rays."""
    n = len(trained.poses.cam_center_in_model)
    sigma = np.full(n, 1e-3)
    sigma[seen.camera] = seen.sigma
    views = UncertainCameras(
        trained.poses.cam_center_in_model,
        np.swapaxes(trained.poses.cam_from_model, 1, 2),
        np.tile(_SIGMA_CENTER_M**2 * np.eye(3), (n, 1, 1)),
        np.full(n, _SIGMA_ATTITUDE_RAD),
        sigma,
    )
    found = intersect_rays(Rays(seen.point, seen.camera, seen.xy), views, count)
    return trained.geo_from_model.apply(found.position_in_geo)


def points_by_model(
    trained: Trained, seen: Sights, depth_m: dict[int, FloatArray], pinholes: dict[int, Pinhole], count: int
) -> FloatArray:
    """Points (J, 3) in `geo` where the model's surface lies behind their marks: spatial median of the views.

    Where a mark lies beside an edge of the surface, a fraction of a pixel decides between roof and ground: such
    views do not count for a point that two or more others show on unbroken surface.

    Args:
        depth_m: depth (H, W) of the surface along z by camera, 0 where there is none.
        pinholes: cameras of these depth maps.
        count: J.
    """
    clear: list[list[FloatArray]] = [[] for _ in range(count)]
    beside: list[list[FloatArray]] = [[] for _ in range(count)]
    for j, i, xy in zip(seen.point, seen.camera, seen.xy, strict=True):
        depth = _depth_at(depth_m[int(i)], pinholes[int(i)], xy)
        if depth > 0:
            ray = depth * np.append(xy, 1.0)
            kind = beside if _at_edge(depth_m[int(i)], pinholes[int(i)], xy) else clear
            kind[j].append(trained.poses.cam_from_model[i].T @ ray + trained.poses.cam_center_in_model[i])
    hits = [good if len(good) >= 2 else good + poor for good, poor in zip(clear, beside, strict=True)]
    middle = np.array([spatial_median(hit) if len(hit) >= 2 else np.full(3, np.nan) for hit in hits])
    return trained.geo_from_model.apply(middle.reshape(-1, 3))


def _at_edge(depth_m: FloatArray, camera: Pinhole, xy: FloatArray) -> bool:
    """Whether the depth around a ray changes by more than a slope does."""
    around = _around(depth_m, *_pixel(camera, xy))
    return bool(around.size == 0 or around.max() > (1 + _EDGE_STEP) * around.min())


def _depth_at(depth_m: FloatArray, camera: Pinhole, xy: FloatArray) -> float:
    """Depth at a ray, of a plane through what lies around it on the same surface; 0 where there is none.

    Gaussians make the surface rough from pixel to pixel, which a plane through some of them evens out. Its inverse
    depth is linear on the image.
    """
    x, y = _pixel(camera, xy)
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return 0.0
    here = float(depth_m[int(y), int(x)])
    around = np.asarray(_around(depth_m, x, y), dtype=np.float64)
    rows, columns = np.nonzero((np.abs(around - here) < _SAME_SURFACE * here) & (around > 0))
    right = columns + max(int(x) - _REACH_PX, 0) + 0.5 - x
    down = rows + max(int(y) - _REACH_PX, 0) + 0.5 - y
    if len(rows) < 3 or np.ptp(rows) == 0 or np.ptp(columns) == 0:  # no plane
        return here
    design = np.stack([np.ones(len(rows)), right, down], axis=1)
    return float(1.0 / np.linalg.lstsq(design, 1.0 / around[rows, columns])[0][0])


def _pixel(camera: Pinhole, xy: FloatArray) -> tuple[float, float]:
    return camera.fx * float(xy[0]) + camera.cx, camera.fy * float(xy[1]) + camera.cy


def _around(depth_m: FloatArray, x: float, y: float) -> FloatArray:
    """The depths within the reach of a place on the image."""
    top, left = max(int(y) - _REACH_PX, 0), max(int(x) - _REACH_PX, 0)
    return depth_m[top : int(y) + _REACH_PX + 1, left : int(x) + _REACH_PX + 1]
