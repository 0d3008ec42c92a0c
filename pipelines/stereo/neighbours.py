"""Which views to compare with which, and on which planes, from the SfM points that they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.products import FloatArray
from pipelines.stereo.sweep import Planes, StereoCamera

IntArray = NDArray[np.int64]

# Smaller angles give no depth, larger ones another picture of the same place (after Yao et al.,
# doi 10.1007/978-3-030-01237-3_47, section 4.1, for the wider angles of flights).
_BEST_ANGLE_DEG, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG = 12.0, 4.0, 10.0
_MOST_POINTS = 400  # of a view, to judge by
_LEAST_SHARED = 5

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL = np.sin(np.radians(15.0))  # a view that looks down less than this sees walls rather than ground
_RANGE = (0.5, 99.5)  # percentiles of the points
_MARGIN = 0.25  # of their range, on either side: ground without texture has no points
_STEP_PX = 0.75  # between two planes in the neighbours
_LEAST_PLANES, _MOST_PLANES = 16, 256


@dataclass(frozen=True)
class Sightings:
    """Which of N points is seen in which of n views.

    Attributes:
        point_in_world: (N, 3) metres.
        center_in_world: (n, 3) metres.
        obs_point, obs_view: (M,) indices.
    """

    point_in_world: FloatArray
    center_in_world: FloatArray
    obs_point: IntArray
    obs_view: IntArray

    def seen_by(self, view: int) -> IntArray:
        """Points that a view sees."""
        return np.unique(self.obs_point[self.obs_view == view])


def best_neighbours(sightings: Sightings, view: int, among: IntArray, count: int) -> list[int]:
    """The views that share most points with `view` under good angles, best first; at most `count`."""
    seen = sightings.seen_by(view)
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), _MOST_POINTS)).astype(np.int64)]
    rows = np.isin(sightings.obs_point, seen) & np.isin(sightings.obs_view, among) & (sightings.obs_view != view)
    point, other = sightings.obs_point[rows], sightings.obs_view[rows]
    here = sightings.point_in_world[point] - sightings.center_in_world[view]
    there = sightings.point_in_world[point] - sightings.center_in_world[other]
    cosine = (here * there).sum(axis=1) / np.maximum(
        np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1), 1e-12
    )
    away = np.degrees(np.arccos(np.clip(cosine, -1, 1))) - _BEST_ANGLE_DEG
    sigma = np.where(away < 0, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG)
    worth = np.bincount(other, np.exp(-0.5 * (away / sigma) ** 2), minlength=len(sightings.center_in_world))
    worth[np.bincount(other, minlength=len(worth)) < _LEAST_SHARED] = 0
    order = np.argsort(-worth, kind="stable")[:count]
    return [int(index) for index in order if worth[index] > 0]


def planes_for(view: StereoCamera, neighbours: list[StereoCamera], points: FloatArray) -> Planes | None:
    """Planes through points (P, 3) that the view sees: level ones, or across a view that hardly looks down.

    Level planes suit ground and roofs seen at a slant, where planes across the view do not. None where the points
    are too few or too near each other.
    """
    axis = view.cam_from_world[2]
    level = -axis[2] > _LEVEL
    normal = _UP if level else axis
    along = points @ normal
    if len(points) < _LEAST_SHARED:
        return None
    low, high = np.percentile(along, _RANGE)
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    own = float(normal @ view.center_in_world)
    if not level:
        nearest = own + 0.5 * max(float(np.percentile(along, _RANGE[0])) - own, 1e-6)
        low = max(low, nearest)
    middle = points[np.argsort(along)[len(points) // 2]]
    step = _STEP_PX / max(_pixels_a_metre(view, neighbours, middle, normal), 1e-9)
    count = int(np.clip(np.ceil((high - low) / step), _LEAST_PLANES, _MOST_PLANES))
    if not high > low:
        return None
    if level:
        return Planes(normal, np.linspace(low, high, count))
    return Planes(normal, own + 1 / np.linspace(1 / (low - own), 1 / (high - own), count))


def _pixels_a_metre(
    view: StereoCamera, neighbours: list[StereoCamera], point: FloatArray, normal: FloatArray
) -> float:
    """How fast the neighbours see a point move that moves along the ray of `view`, by a metre of its plane."""
    ray = point - view.center_in_world
    ray = ray / max(abs(float(normal @ ray)), 1e-9)
    speeds = []
    for other in neighbours:
        ends = (point + np.outer([-0.05, 0.05], ray) - other.center_in_world) @ other.cam_from_world.T
        if (ends[:, 2] > 0).all():
            on_image = ends[:, :2] / ends[:, 2:] * [other.pinhole.fx, other.pinhole.fy]
            speeds.append(float(np.linalg.norm(on_image[1] - on_image[0])) / 0.1)
    return float(np.median(speeds)) if speeds else 0.0
