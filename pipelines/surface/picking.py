"""Points of the trained model's surface: under a line of sight, or behind the marks of a surveyed point.

A viewer that picks the centres of Gaussians, or the depth of its own picture, measures other points. Here the depth
under a line of sight is that on which the training views agree, each read off its own render, as `evaluate` reads
it behind the marks. The accuracy is that for a reader who intersects the rendered surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import CameraPoses, Pinhole, ViewPose
from pipelines.geometry.rotations import rotation_towards
from pipelines.geometry.statistics import spatial_median
from pipelines.splat.rasterizer.api import Window
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.marks import MarkRays
from pipelines.survey.solution import Solution

REACH_PX = 1  # around the pixel of a mark
LEAST_VIEWS = 2  # that must show a point
EDGE_STEP = 0.04  # of the depth; on ground seen under 30° the depth changes by 0.6 % within the reach
_SAME_SURFACE = 0.01  # of the depth: largest difference between pixels of one surface


@dataclass(frozen=True)
class DepthMap:
    """Depth of the surface as one camera sees it: the whole view, or a window of it."""

    pinhole: Pinhole  # of the whole view
    depth_m: FloatArray  # (h, w) along the camera's z axis; 0: no surface
    left: int = 0  # pixels of the view to the left of the window, and above it
    top: int = 0  # pixels of the view to the left of the window, and above it

    def contains(self, xy: FloatArray) -> bool:
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
        """Return the depth at a ray (x/z, y/z), on a plane through pixels of the same surface; 0: no surface.

        Gaussians make the surface rough from pixel to pixel, and a plane through several pixels evens that out. The
        inverse depth of a plane is linear on the image.
        """
        x, y = self._pixel(xy)
        if not self.contains(xy):
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
        return bool(around.size == 0 or around.max() > (1 + EDGE_STEP) * around.min())

    def _pixel(self, xy: FloatArray) -> tuple[float, float]:
        camera = self.pinhole
        return camera.fx * float(xy[0]) + camera.cx, camera.fy * float(xy[1]) + camera.cy


def depth_around(renderer: ModelRenderer, camera: int, xy: FloatArray, reach_px: int = REACH_PX) -> DepthMap:
    """Return the depth of a camera within some pixels of a ray (x/z, y/z); empty if the ray misses the image.

    Everybody who measures renders the same small windows. Where the Gaussians of a pixel nearly lie on one surface,
    rounding decides how its depth is taken, and another window would round in another way.
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
    return DepthMap(pinhole, renderer.depth_m(pose, Window(left, top, width, height)), left, top)


def points_on_surface(solution: Solution, rays: MarkRays, maps: Sequence[DepthMap]) -> FloatArray:
    """Return the points (J, 3) in `geo` at which the model's surface lies behind their marks, by K maps.

    Each map is the depth around a mark in its view. The result is the spatial median of the views that count; NaN
    for a point with fewer than two.
    """
    poses, middle = solution.poses, np.full((len(rays.point_name), 3), np.nan)
    for point in range(len(middle)):
        _, place = _counted_hits(poses, rays, maps, np.flatnonzero(rays.point == point))
        if len(place) >= LEAST_VIEWS:
            middle[point] = spatial_median(place)
    return solution.similarity.apply(middle)


def _counted_hits(
    poses: CameraPoses, rays: MarkRays, maps: Sequence[DepthMap], rows: IntArray
) -> tuple[IntArray, FloatArray]:
    """Return the marks of one point that count, and where (V, 3) in `model` their rays meet the views' own surface.

    Rays on unbroken surface count, if two or more are: beside an edge of the surface, a fraction of a pixel decides
    between roof and ground.
    """
    slopes = rays.xy[rows]
    position, at_edge = np.full((len(rows), 3), np.nan), np.zeros(len(rows), dtype=bool)
    for index, (camera, xy) in enumerate(zip(rays.camera[rows], slopes, strict=True)):
        view = maps[rows[index]]
        depth = view.depth_at(xy)
        if depth > 0:
            in_cam = depth * np.append(xy, 1.0)
            position[index] = poses.cam_from_model[camera].T @ in_cam + poses.cam_center_in_model[camera]
            at_edge[index] = view.is_at_edge(xy)
    known = np.isfinite(position).all(axis=1)
    unbroken = known & ~at_edge
    counted = unbroken if unbroken.sum() >= LEAST_VIEWS else known
    return rows[counted], position[counted]


MOST_VIEWS = 12  # that read a point: the most detailed of those that hold its place
_WINDOW_PX = 8  # around the first guess, to each side
_AROUND = 0.04  # of the depth: a view that differs more looks at something before or behind the point
_AGREEMENT = 0.01  # of the depth, between the views of one surface (`surface.surface_views.SAME_SURFACE`)
MOST_THROUGH = 0.5  # of the number of views that agree
_SIGMA_PX = 0.15  # of a view's surface across its rays; calibrated by simulated flights (docs/deliverables.md)
_STEPS, _NEAR = 12, 1e-6  # of the search along a line, and the step that ends it, as a part of the distance
_HALF_PX = 500  # of the image around a line of sight


@dataclass(frozen=True)
class Sight:
    """Line of sight through a pixel of a view: start (3,) in metres, unit vector (3,), width of a pixel."""

    start_in_model: FloatArray
    direction_in_model: FloatArray
    pixel_rad: float

    def at(self, distance_m: float) -> FloatArray:
        """Return the place (3,) in `model` at a distance."""
        return self.start_in_model + distance_m * self.direction_in_model


@dataclass(frozen=True)
class SurfacePoint:
    """Measured point of the surface."""

    position_in_geo: FloatArray  # (3,) metres
    cov_of_surface: FloatArray  # (3, 3) m² of the surface alone: errors of similarity, cameras and lens come on top
    cameras: IntArray  # (V,) indices of the cameras that show it


@dataclass(frozen=True)
class NoSurface:
    """Nothing to measure, with the reason for the user."""

    reason: str


class SurfaceReader:
    """Reader of the surface of a trained model."""

    def __init__(self, renderer: ModelRenderer) -> None:
        self.renderer, self._train = renderer, renderer.model.indices("train")

    def focal_px(self, camera: int) -> float:
        """Return the focal length of a camera's depth map."""
        return self.renderer.images.pinhole(camera).fx

    def under(self, sight: Sight) -> SurfacePoint | NoSurface:
        """Return the point of the surface under a line of sight, or why there is none to measure.

        1. The render along the line gives a first distance.
        2. Each of the most detailed training views of that place gives the distance at which the line meets the
           surface of its own depth map. Views with an edge there count only if fewer than two have none.
        3. The result is the median of those that agree. There is none where more than half as many look through
           it: the model has something there that the photographs do not show.

        σ along the line is the RMS difference of these views, which does not fall with their number because their
        errors correlate, and what 0.15 px across their rays are along it.
        """
        first = self.rendered_distance(sight)
        if first is None:
            return NoSurface("nothing of the model lies under this pixel")
        cameras = self._most_detailed(sight.at(first))
        views = {
            camera: depth_around(self.renderer, camera, self._slope(camera, sight.at(first)), _WINDOW_PX)
            for camera in cameras
        }
        unbroken: list[tuple[float, int]] = []
        at_edge: list[tuple[float, int]] = []
        for camera, view in views.items():
            distance = self._crossing(view, camera, sight, first)
            if distance is not None:
                broken = view.is_at_edge(self._slope(camera, sight.at(distance)))
                (at_edge if broken else unbroken).append((distance, camera))
        point = self._agreed(sight, unbroken if len(unbroken) >= LEAST_VIEWS else unbroken + at_edge)
        if isinstance(point, SurfacePoint):
            place = self.renderer.geo_from_model.inverse().apply(point.position_in_geo[None])[0]
            through = sum(self._looks_through(view, camera, place) for camera, view in views.items())
            if through > MOST_THROUGH * len(point.cameras):
                return NoSurface(f"{through} photographs look through this place, {len(point.cameras)} show it")
        return point

    def behind_marks(self, rays: MarkRays) -> SurfacePoint | NoSurface:
        """Return the surface behind the marks of one point, as `evaluate` measures it on the rendered surface.

        σ is the RMS difference of the views.
        """
        maps = [
            depth_around(self.renderer, int(camera), xy) for camera, xy in zip(rays.camera, rays.xy, strict=True)
        ]
        counted, place = _counted_hits(self.renderer.poses, rays, maps, np.arange(len(rays.point)))
        if len(place) < LEAST_VIEWS:
            return NoSurface("fewer than two photographs show a surface behind the marks")
        middle = spatial_median(place)
        geo_from_model = self.renderer.geo_from_model
        apart = (place - middle) @ geo_from_model.rotation.T * geo_from_model.scale
        distance = np.linalg.norm(apart, axis=1)
        near = apart[distance <= 3 * np.median(distance)]  # the median leaves the others out, too
        cov = near.T @ near / max(len(near) - 1, 1)
        return SurfacePoint(geo_from_model.apply(middle[None])[0], cov, rays.camera[counted])

    def rendered_distance(self, sight: Sight) -> float | None:
        """Return the distance of the surface that a render along the line shows."""
        size, focal = 2 * _HALF_PX + 1, 1.0 / sight.pixel_rad
        pinhole = Pinhole(size, size, focal, focal, size / 2, size / 2)
        pose = ViewPose(pinhole, rotation_towards(sight.direction_in_model), sight.start_in_model)
        depth = self.renderer.depth_m(pose, Window(_HALF_PX, _HALF_PX, 1, 1))
        return float(depth[0, 0]) or None

    def _most_detailed(self, place: FloatArray) -> list[int]:
        """Return the training cameras that hold a place in their image, the most detailed ones first."""
        detail = []
        for camera in self._train:
            pinhole = self.renderer.images.pinhole(camera)
            in_cam = self._in_cam(camera, place)
            if pinhole.contains(pinhole.project(in_cam)):
                detail.append((float(in_cam[2]) / pinhole.fx, camera))
        return [camera for _, camera in sorted(detail)[:MOST_VIEWS]]

    def _in_cam(self, camera: int, place: FloatArray) -> FloatArray:
        poses = self.renderer.poses
        return np.asarray(poses.cam_from_model[camera] @ (place - poses.cam_center_in_model[camera]))

    def _slope(self, camera: int, place: FloatArray) -> FloatArray:
        """Return x/z and y/z (2,) of a place before a camera."""
        x, y, z = self._in_cam(camera, place)
        return np.array([x / z, y / z])

    def _looks_through(self, view: DepthMap, camera: int, place: FloatArray) -> bool:
        """Return whether the surface of a view lies behind a place."""
        in_cam = self._in_cam(camera, place)
        return bool(view.depth_at(in_cam[:2] / in_cam[2]) > (1 + _AGREEMENT) * in_cam[2])

    def _crossing(self, view: DepthMap, camera: int, sight: Sight, first: float) -> float | None:
        """Return the distance at which the line meets the surface of a view; None: not near the first guess.

        The secant finds it in one step on a plane.
        """
        distance = first
        before: tuple[float, float] | None = None
        for _ in range(_STEPS):
            in_cam = self._in_cam(camera, sight.at(distance))
            depth = view.depth_at(in_cam[:2] / in_cam[2]) if in_cam[2] > 0 else 0.0
            behind = depth - float(in_cam[2])
            if depth <= 0 or abs(behind) > _AROUND * in_cam[2]:
                return None
            slope = 1.0 if before is None else (behind - before[1]) / (distance - before[0])
            step = behind * (1.0 if before is None else -1.0 / min(slope, -0.1))
            if abs(step) < _NEAR * first:
                return distance
            limited = float(np.clip(step, -_AROUND * first, _AROUND * first))
            before, distance = (distance, behind), distance + limited
        return None

    def _agreed(self, sight: Sight, counted: list[tuple[float, int]]) -> SurfacePoint | NoSurface:
        distance = np.array([each for each, _ in counted])
        cameras = np.array([camera for _, camera in counted], dtype=np.int64)
        if len(counted) >= LEAST_VIEWS:
            alike = np.abs(distance - np.median(distance)) < _AGREEMENT * np.median(distance)
            distance, cameras = distance[alike], cameras[alike]
        if len(distance) < LEAST_VIEWS:
            return NoSurface("fewer than two photographs agree on the surface here")
        middle = float(np.median(distance))
        geo_from_model = self.renderer.geo_from_model
        variance = float(np.mean((distance - middle) ** 2)) + self._variance_of_rays(sight.at(middle), cameras)
        axis = geo_from_model.rotation @ sight.direction_in_model * geo_from_model.scale
        return SurfacePoint(
            geo_from_model.apply(sight.at(middle)[None])[0], variance * np.outer(axis, axis), cameras
        )

    def _variance_of_rays(self, place: FloatArray, cameras: IntArray) -> float:
        arm = place - self.renderer.poses.cam_center_in_model[cameras]
        return variance_of_rays(arm, np.array([self.renderer.images.pinhole(int(camera)).fx for camera in cameras]))


def variance_of_rays(arm: FloatArray, focal_px: FloatArray) -> float:
    """Return the variance along views that 0.15 px across their rays amount to, in the square of the arms' unit.

    The arms (V, 3) lead from the cameras to the place.
    """
    length = np.linalg.norm(arm, axis=1)
    ray = arm / length[:, None]
    mean = ray.mean(axis=0) / np.linalg.norm(ray.mean(axis=0))
    spread_rad = float(np.sqrt(np.mean(np.arccos(np.clip(ray @ mean, -1.0, 1.0)) ** 2)))
    across = _SIGMA_PX * float(np.mean(length / focal_px)) / np.sqrt(len(arm))
    return float((across / max(spread_rad, 1e-6)) ** 2)
