"""Choice of the views and planes to compare a view with, from the SfM points that views share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.stereo.sweep import Planes
from pipelines.stereo.views import StereoCamera

# Smaller angles give no depth, larger angles another picture of the same place. After Yao et al.,
# doi 10.1007/978-3-030-01237-3_47, section 4.1, adapted to the wider angles of flights.
_BEST_ANGLE_DEG, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG = 12.0, 4.0, 10.0
_MOST_POINTS = 400  # of a view
_LEAST_SHARED = 5

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL = np.sin(np.radians(15.0))  # a view that looks down by less sees walls rather than ground
_NEAREST = 0.3  # of the distance of most points
_RANGE = (0.5, 99.5)  # percentiles of the points
_MARGIN = 0.25  # of their range, on either side: ground without texture has no points
_STEP_PX = 1.0  # between two planes in the neighbours
_LEAST_PLANES, _MOST_PLANES = 16, 256


@dataclass(frozen=True)
class PointVisibility:
    """Observations of N points in n views.

    Attributes:
        point_in_world: (N, 3) metres.
        center_in_world: (n, 3) metres.
        obs_point, obs_view: (M,) indices.
    """

    point_in_world: FloatArray
    center_in_world: FloatArray
    obs_point: IntArray
    obs_view: IntArray

    def points_in_view(self, view: int) -> IntArray:
        """Return ascending indices of the points that a view sees."""
        return np.unique(self.obs_point[self.obs_view == view])


def best_neighbours(visibility: PointVisibility, view: int, among: IntArray, count: int) -> list[int]:
    """Return at most `count` views that share most points with `view` under good angles, best first.

    Args:
        visibility: of the SfM points.
        view: index of the view.
        among: indices of the views to choose from.
        count: most views.
    """
    seen = visibility.points_in_view(view)
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), _MOST_POINTS)).astype(np.int64)]
    rows = np.isin(visibility.obs_point, seen) & np.isin(visibility.obs_view, among) & (visibility.obs_view != view)
    point, other = visibility.obs_point[rows], visibility.obs_view[rows]
    from_view = visibility.point_in_world[point] - visibility.center_in_world[view]
    from_other = visibility.point_in_world[point] - visibility.center_in_world[other]
    cosine = (from_view * from_other).sum(axis=1) / np.maximum(
        np.linalg.norm(from_view, axis=1) * np.linalg.norm(from_other, axis=1), 1e-12
    )
    away = np.degrees(np.arccos(np.clip(cosine, -1, 1))) - _BEST_ANGLE_DEG
    sigma = np.where(away < 0, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG)
    worth = np.bincount(other, np.exp(-0.5 * (away / sigma) ** 2), minlength=len(visibility.center_in_world))
    worth[np.bincount(other, minlength=len(worth)) < _LEAST_SHARED] = 0
    order = np.argsort(-worth, kind="stable")[:count]
    return [int(index) for index in order if worth[index] > 0]


def planes_for(view: StereoCamera, neighbours: list[StereoCamera], points: FloatArray) -> list[Planes]:
    """Return planes through points (P, 3) that the view sees, by direction; none if the points are too few.

    Level planes suit ground and roofs; upright planes across the view suit walls. A view that hardly looks down
    needs planes across its axis alone.
    """
    if len(points) < _LEAST_SHARED:
        return []
    axis = view.cam_from_world[2]
    ahead = axis * [1.0, 1.0, 0.0]
    forward = float(np.linalg.norm(ahead))
    if -axis[2] <= _LEVEL:
        candidates = [_planes_across(view, neighbours, points, axis)]
    elif forward <= _LEVEL:  # from straight above walls are not seen
        candidates = [_level_planes(view, neighbours, points)]
    else:
        candidates = [
            _level_planes(view, neighbours, points),
            _planes_across(view, neighbours, points, ahead / forward, height_m=_range(points @ _UP)),
        ]
    return [planes for planes in candidates if planes is not None]


def _level_planes(view: StereoCamera, neighbours: list[StereoCamera], points: FloatArray) -> Planes | None:
    low, high = _range(points @ _UP)
    if not high > low:
        return None
    return Planes(_UP, np.linspace(low, high, _count(view, neighbours, points, _UP, high - low)))


def _planes_across(
    view: StereoCamera,
    neighbours: list[StereoCamera],
    points: FloatArray,
    normal: FloatArray,
    height_m: tuple[float, float] = (-np.inf, np.inf),
) -> Planes | None:
    """Return planes at distances with evenly spaced inverses, which are evenly spaced in pixels."""
    away = points @ normal - normal @ view.center_in_world
    low, high = _range(away)
    low = max(low, _NEAREST * float(np.median(away)))
    if not high > low > 0:
        return None
    count = _count(view, neighbours, points, normal, high - low)
    offset = normal @ view.center_in_world + 1 / np.linspace(1 / low, 1 / high, count)
    return Planes(normal, offset, height_m)


def _range(along: FloatArray) -> tuple[float, float]:
    low, high = np.percentile(along, _RANGE)
    margin = _MARGIN * (high - low)
    return float(low - margin), float(high + margin)


def _count(
    view: StereoCamera, neighbours: list[StereoCamera], points: FloatArray, normal: FloatArray, range_m: float
) -> int:
    """Return the number of planes that lie `_STEP_PX` apart in the neighbours."""
    middle = points[np.argsort(points @ normal)[len(points) // 2]]
    step = _STEP_PX / max(_pixels_a_metre(view, neighbours, middle, normal), 1e-9)
    return int(np.clip(np.ceil(range_m / step), _LEAST_PLANES, _MOST_PLANES))


def _pixels_a_metre(
    view: StereoCamera, neighbours: list[StereoCamera], point: FloatArray, normal: FloatArray
) -> float:
    """Return the pixels by which a point moves in the neighbours (median) if its plane moves by a metre."""
    ray = point - view.center_in_world
    ray = ray / max(abs(float(normal @ ray)), 1e-9)
    speeds = []
    for other in neighbours:
        ends = (point + np.outer([-0.05, 0.05], ray) - other.center_in_world) @ other.cam_from_world.T
        if (ends[:, 2] > 0).all():
            on_image = ends[:, :2] / ends[:, 2:] * [other.pinhole.fx, other.pinhole.fy]
            speeds.append(float(np.linalg.norm(on_image[1] - on_image[0])) / 0.1)
    return float(np.median(speeds)) if speeds else 0.0
