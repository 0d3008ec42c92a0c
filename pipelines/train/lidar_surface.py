"""LiDAR as training uses it: confidence in its points, places that have changed, and its surface with stereo's.

1. A photograph whose depth map lies behind a point looks through it. Where photographs look through a point
   consistently, what the cloud shows there is gone.
2. Where the photographs show a surface above all points of the cloud, something was added: from the air, the
   scanner would have met it.
3. The neighbours of a point decide with it. A single inconsistent point is noise, of stereo or cloud.
4. The confidence of the other points is a product of factors from 0 to 1: stated accuracy against that of stereo,
   flatness and density of the neighbours, incidence of the beam, and agreement with the photographs.
5. Points of stereo are moved onto the planes of the LiDAR that is trusted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray, joined_rows, rows_of
from pipelines.splat.losses import FreeSpace, FreeSpaceLoss, MeasuredPlanes, PlaneAttraction
from pipelines.surface.crossings import SeenSurfels, Surfels, seen_surfels
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.lidar_cloud import LidarCloud
from pipelines.surface.registration import UP
from pipelines.surface.visibility import DepthViews, Support, support
from pipelines.train.losses import Loss
from pipelines.train.options import LidarLoss
from pipelines.train.surface import SceneSurface, SurfacePoints, spread_evenly

_TOLERANCE = 0.005  # of the distance: photographs that differ by less agree
_LEAST_LOOKS = 2  # through a point, for it to be inconsistent
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
    """Area where cloud and photographs are inconsistent."""

    # `removed`: the photographs look through the cloud; `added`: they show a surface above it
    kind: Literal["removed", "added"]
    area_m2: float  # in plan
    points: int  # number of points of the cloud
    center_in_model: FloatArray  # (3,) their mean
    cell_m: float  # side of the area's cells in plan
    cells: FloatArray  # (C, 2) their south-western corners in `model`, for maps


@dataclass(frozen=True)
class CloudVerdict:
    """Verdict of the photographs on a cloud."""

    rejected: BoolArray  # (P,) inconsistent with the photographs
    confidence: FloatArray  # (P,) 0 … 1; 0 where the point is inconsistent with the photographs
    areas: tuple[ChangedArea, ...]  # that have changed, the largest first


def verdict(
    cloud: LidarCloud,
    views: DepthViews,
    surface_in_model: FloatArray,
    *,
    sigma_m: float,
    pixel_m: float,
) -> CloudVerdict:
    """Return confidence and inconsistencies of the P points of a registered cloud, of a stated σ.

    The photographs show the depth maps, with pixels of `pixel_m` on the surface, and together the surface (S, 3).
    """
    seen = support(cloud.position_in_model, views, UP, _TOLERANCE, cloud.normal_in_model)
    _, nearest = cKDTree(cloud.position_in_model).query(cloud.position_in_model, k=min(_NEIGHBOURS, len(cloud)))
    votes = seen.views + seen.seen_through > 0
    through = (seen.seen_through >= _LEAST_LOOKS) & (seen.seen_through > seen.views)
    removed = _majority(through, votes, nearest)
    below = _below_surface(cloud, surface_in_model, pixel_m) & (seen.views == 0)
    added = _majority(below, np.ones_like(votes), nearest) & ~removed
    confidence = _confidence(cloud, seen, sigma_m, pixel_m)
    rejected = removed | added
    confidence[rejected] = 0.0
    areas = (*_areas(cloud, removed, "removed"), *_areas(cloud, added, "added"))
    return CloudVerdict(rejected, confidence, tuple(sorted(areas, key=lambda area: -area.area_m2)))


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


def _confidence(cloud: LidarCloud, seen: Support, sigma_m: float, pixel_m: float) -> FloatArray:
    views, through, incidence = seen.views, seen.seen_through, cloud.incidence()
    stereo2, own2 = (_STEREO_PX * pixel_m) ** 2, sigma_m**2
    stated = stereo2 / (stereo2 + own2)
    flat = np.exp(-0.5 * (cloud.roughness_m**2 / (own2 + (0.1 * cloud.voxel_m) ** 2)) / 4)
    dense = np.minimum(1.0, _SPARSE * cloud.voxel_m / np.maximum(cloud.reach_m, 1e-9))
    beam = np.where(np.isfinite(incidence), 1 - np.exp(-incidence / _GRAZING), 1.0)
    agreement = np.where(views + through > 0, (views + 0.5) / (views + through + 1.0), 0.5)
    off2 = np.nan_to_num(seen.mean_normal_m) ** 2 / (9 * (stereo2 + own2))
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


_LEAST_CONFIDENCE = 0.1
_REACH = 2.0  # distances between points, from a point of stereo to the LiDAR
_OFF_PIXELS = 2.0  # of the depth maps: a point of stereo further from the plane lies on another surface
_WEIGHT = 4.0  # of a trusted LiDAR point's depth loss, relative to that of stereo
_WEIGHT_ALONE = 1.0  # the same where stereo found nothing: what a view sees there is less certain
_MOST_ALONE = 0.15  # of the points to start from: LiDAR where stereo found none
_FREE_SPACE = 0.1  # weight of the mean opacity of Gaussians in free space
_ATTRACTION = 0.01  # weight of the loss of Gaussians beside their planes
_SCALE_PX = 0.3  # distance from its plane, in pixels, at which a Gaussian's confidence is a half
_GAP = 0.5  # radius of a point's disc, in distances to its furthest neighbour of twelve: discs overlap on a surface
_LEAST_GAP, _MOST_GAP = 0.75, 3.0  # limits of that radius, in distances between points
_RIM_PX = 2  # around a pixel: nearer surface of stereo there may hide the point
_SAME = 0.01  # of the depth


class TrustedLidar:
    """Planes of the registered LiDAR that is trusted, of P points with a confidence (P,)."""

    def __init__(self, cloud: LidarCloud, confidence: FloatArray, pixel_m: float) -> None:
        trusted = np.flatnonzero(confidence >= _LEAST_CONFIDENCE)
        self.cloud, self.confidence = rows_of(cloud, trusted), confidence[trusted]
        self._pixel_m = pixel_m
        self._tree = cKDTree(self.cloud.position_in_model) if len(trusted) else None

    def onto(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points (P, 3) on the planes near them, the planes' normals, and the confidence; 0: not moved."""
        normal, confidence = np.zeros_like(points), np.zeros(len(points))
        if self._tree is None or not len(points):
            return points, normal, confidence
        distance, nearest = self._tree.query(points, distance_upper_bound=_REACH * self.cloud.voxel_m)
        rows = np.flatnonzero(np.isfinite(distance))
        plane = nearest[rows]
        axis = self.cloud.normal_in_model[plane]
        off = np.einsum("pi,pi->p", points[rows] - self.cloud.position_in_model[plane], axis)
        near = np.abs(off) < _OFF_PIXELS * self._pixel_m
        rows, plane, axis, off = rows[near], plane[near], axis[near], off[near]
        moved = points.copy()
        moved[rows] -= off[:, None] * axis
        normal[rows], confidence[rows] = axis, self.confidence[plane]
        return moved, normal, confidence


def surfels_of(cloud: LidarCloud) -> Surfels:
    """Return discs at the points of a cloud that leave no gap between neighbours."""
    radius_m = np.clip(_GAP * cloud.reach_m, _LEAST_GAP * cloud.voxel_m, _MOST_GAP * cloud.voxel_m)
    return Surfels(cloud.position_in_model, cloud.normal_in_model, radius_m)


class FusedSurface(SceneSurface):
    """Surface of stereo, corrected by registered LiDAR, and continued by it where stereo found none.

    Args:
        maps: depth maps, already built.
        judged: verdict of the photographs on the LiDAR.
        pixel_m: size of a pixel of the depth maps on the surface.
        free: where its beams met nothing; None: unknown.
    """

    def __init__(
        self,
        maps: DepthMaps,
        cloud: LidarCloud,
        judged: CloudVerdict,
        pixel_m: float,
        *,
        loss: LidarLoss = "both",
        free: FreeSpace | None = None,
    ) -> None:
        super().__init__(maps)
        self._loss, self._free, self._pixel_m = loss, free, pixel_m
        self.planes = TrustedLidar(cloud, judged.confidence, pixel_m)
        # All points hide what lies behind them, those that training does not trust too, but none that are gone.
        standing = np.flatnonzero(~judged.rejected)
        self._cloud, self._confidence = rows_of(cloud, standing), judged.confidence[standing]
        self._surfels = surfels_of(self._cloud)

    def depth_loss_points(self, index: int, stride: int) -> tuple[FloatArray, Float32Array]:
        """Return the points (P, 3) of a training view's depth loss, and the weight of each (P,)."""
        if self._loss == "gaussians":
            return super().depth_loss_points(index, stride)
        stereo, by_contrast = super().depth_loss_points(index, stride)
        points, _, confidence = self.planes.onto(stereo)
        seen = self._alone_in_view(index)
        _, first = np.unique(np.stack([seen.row, seen.column]) // stride, axis=1, return_index=True)
        alone = seen.rows[first]
        by_lidar = 1.0 + (_WEIGHT - 1.0) * confidence
        weight = np.concatenate([np.maximum(by_contrast, by_lidar), _WEIGHT_ALONE * self._confidence[alone]])
        return np.concatenate([points, self._cloud.position_in_model[alone]]), weight.astype(np.float32)

    def sample(
        self, count: int, seed: int, inside: Callable[[FloatArray], BoolArray] | None = None
    ) -> SurfacePoints:
        """Return points of the whole surface as `SceneSurface.sample`, with LiDAR where stereo found none."""
        drawn = super().sample(count, seed, inside)
        alone = self._start_alone(drawn.point_in_model, int(_MOST_ALONE * count), inside)
        if len(drawn.rgb) + len(alone.rgb) > count:
            drawn = super().sample(count - len(alone.rgb), seed, inside)
        points, normal, confidence = self.planes.onto(drawn.point_in_model)
        normals = np.where((confidence > 0)[:, None], normal, drawn.normal_in_model)
        return joined_rows([SurfacePoints(points, drawn.rgb, normals), alone])

    def losses(self, device: torch.device) -> list[Loss]:
        """Return the loss of Gaussians in free space, and beside the LiDAR's planes if those count."""
        losses = []
        if self._free is not None:
            losses.append(_loss("free space", _FREE_SPACE, FreeSpaceLoss(self._free, device)))
        if self._loss != "depth" and len(self.planes.confidence):
            cloud, scale_m = self.planes.cloud, _SCALE_PX * self._pixel_m
            place, normal, reach_m = cloud.position_in_model, cloud.normal_in_model, _REACH * cloud.voxel_m
            measured = MeasuredPlanes(place, normal, self.planes.confidence, scale_m, reach_m)
            losses.append(_loss("plane attraction", _ATTRACTION, PlaneAttraction(measured, device)))
        return losses

    def _alone_in_view(self, index: int) -> SeenSurfels:
        """Return the trusted LiDAR points that a view sees at pixels without a depth of stereo."""
        poses, depth = self._poses, np.asarray(self.maps.depth(index))
        rotation, center = poses.cam_from_model[index], poses.cam_center_in_model[index]
        seen = seen_surfels(self._surfels, rotation, center, self.maps.camera(index))
        nearest = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), size=2 * _RIM_PX + 1)
        unknown = depth[seen.row, seen.column] == 0
        before = seen.depth_m < (1 + _SAME) * nearest[seen.row, seen.column]
        counts, cloud = unknown & before & (self._confidence[seen.rows] >= _LEAST_CONFIDENCE), self._cloud
        if cloud.scanner_in_model is not None:
            place, normal = cloud.position_in_model[seen.rows], cloud.normal_in_model[seen.rows]
            eyes = cloud.scanner_in_model[seen.rows], center
            sides = [np.einsum("pi,pi->p", eye - place, normal) for eye in eyes]
            counts &= ~(sides[0] * sides[1] < 0)  # on the side that the scanner saw, where that is known
        return rows_of(seen, counts)

    def _start_alone(
        self, stereo: FloatArray, most: int, inside: Callable[[FloatArray], BoolArray] | None
    ) -> SurfacePoints:
        """Return LiDAR points, `most` at most, that no point of stereo (S, 3) is near, as `sample` does.

        They have the colours of the nearest photograph.
        """
        colours = np.zeros((len(self._cloud), 3), dtype=np.uint8)
        size_m = np.full(len(self._cloud), np.inf)  # of a pixel of the nearest view
        for index in map(int, self._train):
            seen, focal_px = self._alone_in_view(index), self.maps.camera(index).fx
            seen = rows_of(seen, seen.depth_m < focal_px * size_m[seen.rows])
            size_m[seen.rows] = seen.depth_m / focal_px
            colours[seen.rows] = self.maps.rgb(index)[seen.row, seen.column]
        rows = np.flatnonzero(np.isfinite(size_m))
        if len(stereo) and len(rows):
            gap, _ = cKDTree(stereo).query(self._cloud.position_in_model[rows])
            rows = rows[gap > _REACH * self._cloud.voxel_m]
        if inside is not None:
            rows = rows[inside(self._cloud.position_in_model[rows])]
        rows = rows[spread_evenly(self._cloud.position_in_model[rows], size_m[rows], most)]
        return SurfacePoints(self._cloud.position_in_model[rows], colours[rows], self._cloud.normal_in_model[rows])


def _loss(name: str, weight: float, of: FreeSpaceLoss | PlaneAttraction) -> Loss:
    return Loss(name, lambda view: of(view.gaussians, view.stats.visible), lambda _iteration: weight)
