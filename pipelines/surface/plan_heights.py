"""Heights of the surface at many places in plan: each view's depth is rendered once, over all of them.

`picking.SurfaceReader` reads one line of sight with twelve small renders. Here, the pixels of a view are brought
into `geo` and fall to the nearest place; the views' heights must agree there as they must along a line of sight.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.splat.rasterizer.api import Window
from pipelines.surface.picking import (
    EDGE_STEP,
    LEAST_VIEWS,
    MOST_THROUGH,
    MOST_VIEWS,
    variance_of_rays,
)
from pipelines.surface.surface_views import SAME_SURFACE, ModelRenderer

_PIXELS_BY_PLACE = 4.0  # of a view across the reach of a place, at most
# Of the variance of a view's height about the middle of all: what views have in common, and so the middle too; the
# variance of a median over that of a mean; of the variance across a ray what is left where pixels of a place are
# averaged. Share and average fit profiles on simulated flights (examples/benchmarks/clicks.py).
_SHARED, _OF_MEDIAN, _OF_AVERAGE = 0.1, np.pi / 2, 0.3
_RELIEF_M, _RELIEF = 5.0, 0.25  # by which the surface may lie above or below the given level: least, and by extent


@dataclass(frozen=True)
class PlanHeights:
    """Surface at N places in plan.

    Attributes:
        height_m: (N,) in `geo`; NaN: fewer than two views agree.
        sigma_m: (N,) of the surface alone; NaN as well.
        shown_by: (N, C) which cameras of the model agree on it.
    """

    height_m: FloatArray
    sigma_m: FloatArray
    shown_by: BoolArray

    @property
    def known(self) -> BoolArray:
        return np.isfinite(self.height_m)


def heights_in_plan(
    renderer: ModelRenderer,
    plan: FloatArray,
    level_m: float,
    reach_m: float,
    *,
    most_views: int = MOST_VIEWS,
    advance: Callable[[float], None] = lambda _share: None,
) -> PlanHeights:
    """Return the surface at places (N, 2), east and north of `geo`.

    A place takes the mean height of a view's pixels within its reach. The highest surface counts on which two views
    or more agree, and through which no more than half as many look.

    Args:
        level_m: height about which the surface lies.
        most_views: that read a place: the most detailed ones.
        advance: called with the share that is done; an exception of it ends the work.
    """
    extent_m = float(np.ptp(plan, axis=0).max())
    levels = level_m + np.array([0.0, -1.0, 1.0]) * max(_RELIEF_M, _RELIEF * extent_m)
    reads = _readers(renderer, np.column_stack([plan, np.full(len(plan), level_m)]), most_views)
    by_use = [int(camera) for camera in np.argsort(-reads.sum(axis=0), kind="stable") if reads[:, camera].any()]
    tree, around, count = cKDTree(plan), _Around(plan, reach_m), len(renderer.sparse.image_name)
    height = np.full((len(plan), count), np.nan)
    for number, camera in enumerate(by_use):
        points = _seen_points(renderer, camera, plan[reads[:, camera]], levels, reach_m)
        points = points[around.holds(points)]
        if len(points):
            distance, place = tree.query(points[:, :2], distance_upper_bound=reach_m)
            near = np.isfinite(distance)
            place, up = place[near], points[near, 2]
            pixels = np.bincount(place, minlength=len(plan))
            with np.errstate(invalid="ignore"):
                mean = np.bincount(place, up, len(plan)) / pixels
            height[:, camera] = np.where(reads[:, camera], mean, np.nan)
        advance((number + 1) / len(by_use))
    return _agreed(renderer, plan, height)


_MOST_CELLS = 2048  # along an axis


class _Around:
    """Cells of the plan around places (N, 2): of the pixels of whole views, few are within reach of one."""

    def __init__(self, plan: FloatArray, reach_m: float) -> None:
        low, high = plan.min(axis=0), plan.max(axis=0)
        self._cell_m = max(reach_m, float((high - low).max()) / _MOST_CELLS)
        self._low = low - 2 * self._cell_m
        cell = np.floor((plan - self._low) / self._cell_m).astype(np.int64)
        self._near = np.zeros(cell.max(axis=0) + 3, dtype=bool)
        for east, north in np.ndindex(3, 3):
            self._near[cell[:, 0] + east - 1, cell[:, 1] + north - 1] = True

    def holds(self, points: FloatArray) -> BoolArray:
        """Return which of points (P, 2 or 3) may lie within reach of a place: all that do, and a few more."""
        cell = np.floor((points[:, :2] - self._low) / self._cell_m)
        inside = ((cell >= 0) & (cell < self._near.shape)).all(axis=1)
        east, north = np.where(inside[:, None], cell, 0).astype(np.int64).T
        return np.asarray(inside & self._near[east, north])


def _readers(renderer: ModelRenderer, points: FloatArray, most_views: int) -> BoolArray:
    """Return which cameras (N, C) read points (N, 3) in `geo`: the most detailed training views that hold them."""
    in_model = renderer.geo_from_model.inverse().apply(points)
    detail = np.full((len(points), len(renderer.sparse.image_name)), np.inf)
    for camera in renderer.model.indices("train"):
        pinhole = renderer.images.pinhole(camera)
        in_cam = (in_model - renderer.poses.cam_center_in_model[camera]) @ renderer.poses.cam_from_model[camera].T
        ahead = in_cam[:, 2] > 0
        pixel = pinhole.project(np.where(ahead[:, None], in_cam, [0.0, 0.0, 1.0]))
        detail[:, camera] = np.where(ahead & pinhole.contains(pixel), in_cam[:, 2] / pinhole.fx, np.inf)
    if detail.shape[1] <= most_views:
        return np.asarray(np.isfinite(detail))
    limit = np.partition(detail, most_views - 1, axis=1)[:, most_views - 1 : most_views]
    return np.asarray(np.isfinite(detail) & (detail <= limit))


def _seen_points(
    renderer: ModelRenderer, camera: int, plan: FloatArray, levels: FloatArray, reach_m: float
) -> FloatArray:
    """Return places (P, 3) in `geo` of the surface as a camera sees it around places in plan, without edges."""
    pose = renderer.pose(camera)
    pinhole = pose.pinhole
    corners = np.concatenate([np.column_stack([plan, np.full(len(plan), level)]) for level in levels])
    in_cam = (renderer.geo_from_model.inverse().apply(corners) - pose.center_in_model) @ pose.cam_from_model.T
    in_cam = in_cam[in_cam[:, 2] > 0]
    if not len(in_cam):
        return np.zeros((0, 3))
    pixel = pinhole.project(in_cam)
    reach_px = reach_m * pinhole.fx / float(np.median(in_cam[:, 2])) / renderer.geo_from_model.scale
    size = np.array([pinhole.width, pinhole.height])
    left, top = np.clip(np.floor(pixel.min(axis=0) - reach_px), 0, size - 1).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixel.max(axis=0) + reach_px), 1, size).astype(int).tolist()
    if right - left < 3 or bottom - top < 3:
        return np.zeros((0, 3))
    depth = renderer.depth_m(pose, Window(left, top, right - left, bottom - top)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    broken = cv2.dilate(depth, kernel) > (1 + EDGE_STEP) * cv2.erode(depth, kernel)
    step = max(int(2 * reach_px / _PIXELS_BY_PLACE), 1)
    rows, columns = np.nonzero(((depth > 0) & ~broken)[::step, ::step])
    z = depth[::step, ::step][rows, columns].astype(np.float64)
    ray = pinhole.rays(np.column_stack([left + step * columns, top + step * rows]) + 0.5)
    in_model = (z[:, None] * ray) @ pose.cam_from_model + pose.center_in_model
    return renderer.geo_from_model.apply(in_model)


def _agreed(renderer: ModelRenderer, plan: FloatArray, height: FloatArray) -> PlanHeights:
    """Return the surface on which the views' heights (N, C) agree."""
    centers = renderer.geo_from_model.apply(renderer.poses.cam_center_in_model)
    middle_of_place = np.full(len(plan), np.nan)
    used = np.isfinite(height)
    for _ in range(LEAST_VIEWS + 1):  # a single view that is higher than the others is left out, and the next taken
        top = np.where(used, height, -np.inf)
        highest = top.max(axis=1)
        alike = used & (np.abs(height - highest[:, None]) < _tolerance(plan, height, centers))
        through = (used & ~alike).sum(axis=1)
        good = (alike.sum(axis=1) >= LEAST_VIEWS) & (through <= MOST_THROUGH * alike.sum(axis=1))
        taken = good & np.isnan(middle_of_place)
        middle_of_place[taken] = np.nanmedian(np.where(alike, height, np.nan)[taken], axis=1)
        used &= ~(alike & ~good[:, None])
    agree = np.isfinite(height) & (np.abs(height - middle_of_place[:, None]) < _tolerance(plan, height, centers))
    number = np.maximum(agree.sum(axis=1), 1)
    square = np.where(agree, (height - middle_of_place[:, None]) ** 2, 0.0).sum(axis=1) / number
    known = np.flatnonzero(np.isfinite(middle_of_place))
    sigma = np.full(len(plan), np.nan)
    focal = np.array([renderer.images.pinhole(camera).fx for camera in range(len(centers))])
    for row in known:
        cameras = np.flatnonzero(agree[row])
        arm = np.append(plan[row], middle_of_place[row]) - centers[cameras]
        of_middle = _SHARED + (1 - _SHARED) * _OF_MEDIAN / len(cameras)
        of_rays = _OF_AVERAGE * variance_of_rays(arm, focal[cameras])
        sigma[row] = np.sqrt(of_middle * square[row] + of_rays)
    return PlanHeights(middle_of_place, sigma, agree & np.isfinite(middle_of_place)[:, None])


def _tolerance(plan: FloatArray, height: FloatArray, centers: FloatArray) -> FloatArray:
    """Return the largest difference (N, C) of heights of one surface."""
    plan_m = np.linalg.norm(plan[:, None] - centers[None, :, :2], axis=2)
    return np.asarray(SAME_SURFACE * np.hypot(plan_m, np.nan_to_num(height - centers[None, :, 2])))


def cameras_of(heights: PlanHeights, rows: IntArray) -> list[IntArray]:
    """Return the cameras that show each of the places of some rows."""
    return [np.flatnonzero(heights.shown_by[row]) for row in rows]
