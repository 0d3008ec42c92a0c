"""Confidence in the points of a LiDAR cloud, and the places that have changed since it was measured.

1. A photograph whose depth map lies behind a point looks through it. Where photographs look through a point
   consistently, what the cloud shows there is gone.
2. Where the photographs show a surface above all points of the cloud, something was added: from the air, the
   scanner would have met it.
3. The neighbours of a point decide with it. A single contradiction is noise, of stereo or cloud.
4. The confidence of the other points is a product of factors from 0 to 1: stated accuracy against that of stereo,
   flatness and density of the neighbours, incidence of the beam, and agreement with the photographs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.depth_support import DepthViews, Support, support
from pipelines.train.lidar.cloud import LidarCloud
from pipelines.train.lidar.registration import UP

_TOLERANCE = 0.005  # of the distance: photographs that differ by less agree
_LEAST_LOOKS = 2  # through a point, that contradict it
_NEIGHBOURS = 16
_ADDED_M = 1.0  # height of a surface that the cloud lacks
_CELL_M = 0.5  # least side of cells in plan
_CELL_PX = 2.0  # least side in pixels, where the photographs decide
_CELL_POINTS = 1.5  # least side in distances between points, where the cloud decides
_LEAST_AREA_M2 = 4.0  # that is listed
_MOSTLY = 0.6  # share of its points: at edges of roofs and in front of walls, about half of the points agree
_STEREO_PX = 0.3  # σ of stereo, in pixels of the depth maps
_GRAZING = 0.1  # cosine of incidence: beams that graze a surface mix it with what lies behind
_SPARSE = 4.0  # distances between points, to the furthest neighbour on a well-scanned surface


@dataclass(frozen=True)
class ChangedArea:
    """Area where cloud and photographs contradict each other.

    Attributes:
        kind: `removed`: the photographs look through the cloud; `added`: they show a surface above it.
        area_m2: in plan.
        points: of the cloud.
        center_in_model: (3,) mean of these points.
        cell_m: side of its cells in plan.
        cells: (C, 2) south-western corners of its cells in `model`, for maps.
    """

    kind: Literal["removed", "added"]
    area_m2: float
    points: int
    center_in_model: FloatArray
    cell_m: float
    cells: FloatArray


@dataclass(frozen=True)
class CloudVerdict:
    """What the photographs say of a cloud.

    Attributes:
        removed, added: (P,) whether a point contradicts the photographs.
        confidence: (P,) in the points, 0 … 1; 0 where they contradict the photographs.
        agreeing: (P,) number of photographs that show a surface at the point.
        areas: that have changed, the largest first.
    """

    removed: BoolArray
    added: BoolArray
    confidence: FloatArray
    agreeing: IntArray
    areas: tuple[ChangedArea, ...]

    @property
    def rejected(self) -> BoolArray:
        """Points that contradict the photographs (P,)."""
        return np.asarray(self.removed | self.added)


def verdict(
    cloud: LidarCloud,
    views: DepthViews,
    surface_in_model: FloatArray,
    *,
    sigma_m: float,
    pixel_m: float,
) -> CloudVerdict:
    """Return confidence and contradictions of a cloud's points.

    Args:
        cloud: P points, registered.
        views: depth maps of the training photographs.
        surface_in_model: (S, 3) surface that the photographs show together.
        sigma_m: stated σ of the points.
        pixel_m: size of a pixel of the depth maps on the surface.
    """
    found = support(cloud.position_in_model, views, UP, _TOLERANCE, cloud.normal_in_model)
    _, nearest = cKDTree(cloud.position_in_model).query(cloud.position_in_model, k=min(_NEIGHBOURS, len(cloud)))
    votes = found.views + found.seen_through > 0
    through = (found.seen_through >= _LEAST_LOOKS) & (found.seen_through > found.views)
    removed = _majority(through, votes, nearest)
    below = _below_surface(cloud, surface_in_model, pixel_m) & (found.views == 0)
    added = _majority(below, np.ones_like(votes), nearest) & ~removed
    confidence = _confidence(cloud, found, sigma_m, pixel_m)
    confidence[removed | added] = 0.0
    areas = (*_areas(cloud, removed, "removed"), *_areas(cloud, added, "added"))
    ordered = tuple(sorted(areas, key=lambda area: -area.area_m2))
    return CloudVerdict(removed, added, confidence, found.views, ordered)


def _majority(mark: BoolArray, votes: BoolArray, nearest: IntArray) -> BoolArray:
    """Return whether most neighbours that vote are marked (P,)."""
    voting = votes[nearest].sum(axis=1)
    return np.asarray((voting > 0) & (2 * (mark & votes)[nearest].sum(axis=1) > voting))


def _below_surface(cloud: LidarCloud, surface: FloatArray, pixel_m: float) -> BoolArray:
    """Return whether the photographs show a surface well above all points of the cloud in a point's cell (P,)."""
    side_m = max(_CELL_M, _CELL_PX * pixel_m)
    low = np.minimum(cloud.position_in_model.min(axis=0), surface.min(axis=0))[:2]
    mine, theirs = (
        np.floor((points[:, :2] - low) / side_m).astype(np.int64) for points in (cloud.position_in_model, surface)
    )
    shape = np.maximum(mine.max(axis=0), theirs.max(axis=0)) + 1
    highest = np.full(shape, -np.inf)
    np.maximum.at(highest, (mine[:, 0], mine[:, 1]), cloud.position_in_model[:, 2])
    count, total = np.zeros(shape), np.zeros(shape)
    np.add.at(count, (theirs[:, 0], theirs[:, 1]), 1)
    np.add.at(total, (theirs[:, 0], theirs[:, 1]), surface[:, 2])
    with np.errstate(invalid="ignore"):
        above = total / count > highest + _ADDED_M
    return np.asarray(above[mine[:, 0], mine[:, 1]])


def _confidence(cloud: LidarCloud, found: Support, sigma_m: float, pixel_m: float) -> FloatArray:
    views, through, incidence = found.views, found.seen_through, cloud.incidence()
    stereo2, own2 = (_STEREO_PX * pixel_m) ** 2, sigma_m**2
    stated = stereo2 / (stereo2 + own2)
    flat = np.exp(-0.5 * (cloud.roughness_m**2 / (own2 + (0.1 * cloud.voxel_m) ** 2)) / 4)
    dense = np.minimum(1.0, _SPARSE * cloud.voxel_m / np.maximum(cloud.reach_m, 1e-9))
    beam = np.where(np.isfinite(incidence), 1 - np.exp(-incidence / _GRAZING), 1.0)
    agreement = np.where(views + through > 0, (views + 0.5) / (views + through + 1.0), 0.5)
    off2 = np.nan_to_num(found.mean_normal_m) ** 2 / (9 * (stereo2 + own2))
    return np.asarray(stated * flat * dense * beam * agreement / (1.0 + off2))


def _areas(cloud: LidarCloud, marked: BoolArray, kind: Literal["removed", "added"]) -> list[ChangedArea]:
    """Return the connected areas of marked points in plan that are large enough to be listed.

    An area is not listed if the photographs agree with much of the cloud in its cells.
    """
    points = cloud.position_in_model[marked]
    if not len(points):
        return []
    side_m = max(_CELL_M, _CELL_POINTS * cloud.voxel_m)
    cell = np.floor(points[:, :2] / side_m).astype(np.int64)
    low = cell.min(axis=0) - 1
    grid = np.zeros(cell.max(axis=0) - low + 2, dtype=bool)
    place = cell - low
    grid[place[:, 0], place[:, 1]] = True
    closed = ndimage.binary_closing(grid)
    labels, count = ndimage.label(closed | grid, structure=np.ones((3, 3)))
    of_point = labels[place[:, 0], place[:, 1]]
    size = np.bincount(labels.ravel(), minlength=count + 1) * side_m**2
    every = np.floor(cloud.position_in_model[:, :2] / side_m).astype(np.int64) - low
    every = every[((every >= 0) & (every < grid.shape)).all(axis=1)]
    all_points = np.bincount(labels[every[:, 0], every[:, 1]], minlength=count + 1)
    areas = []
    for label in np.flatnonzero(size >= _LEAST_AREA_M2):
        mine = points[of_point == label]
        if label == 0 or len(mine) < max(_MOSTLY * all_points[label], 1):
            continue
        cells = (np.argwhere(labels == label) + low) * side_m
        areas.append(ChangedArea(kind, float(size[label]), len(mine), mine.mean(axis=0), side_m, cells))
    return areas
