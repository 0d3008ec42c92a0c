"""Surface of stereo and LiDAR together: points of stereo moved onto the planes of the LiDAR that is trusted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.surfel_visibility import SeenSurfels, Surfels, seen_surfels
from pipelines.splat.free_space import FreeSpace, FreeSpaceLoss
from pipelines.splat.plane_attraction import MeasuredPlanes, PlaneAttraction
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.lidar.changes import CloudVerdict
from pipelines.train.lidar.cloud import LidarCloud
from pipelines.train.lidar.options import LidarPull
from pipelines.train.surface import GaussianLoss, SceneSurface, SurfacePoints, spread_evenly

_LEAST_CONFIDENCE = 0.1
_REACH = 2.0  # distances between points, from a point of stereo to the LiDAR
_OFF_PIXELS = 2.0  # of the depth maps: a point of stereo further from the plane lies on another surface
_WEIGHT = 4.0  # of a trusted LiDAR point's pull, relative to that of stereo
_WEIGHT_ALONE = 1.0  # the same where stereo found nothing: what a view sees there is less certain
_MOST_ALONE = 0.15  # of the points to start from: LiDAR where stereo found none
_FREE_SPACE = 0.1  # weight of the mean opacity of Gaussians in free space
_ATTRACTION = 0.01  # weight of the loss of Gaussians beside their planes
_SCALE_PX = 0.3  # distance from its plane, in pixels, at which a Gaussian's confidence is a half
_GAP = 0.5  # radius of a point's disc, in distances to its furthest neighbour of twelve: discs overlap on a surface
_LEAST_GAP, _MOST_GAP = 0.75, 3.0  # limits of that radius, in distances between points
_RIM_PX = 2  # around a pixel: nearer surface of stereo there may hide the point
_SAME = 0.01  # of the depth


class LidarPlanes:
    """Planes of the LiDAR that is trusted.

    Args:
        cloud: registered LiDAR.
        confidence: (P,) in its points.
        pixel_m: size of a pixel of the depth maps on the surface.
    """

    def __init__(self, cloud: LidarCloud, confidence: FloatArray, pixel_m: float) -> None:
        trusted = np.flatnonzero(confidence >= _LEAST_CONFIDENCE)
        self.cloud, self.confidence = cloud.part(trusted), confidence[trusted]
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


class FusedSurface(SceneSurface):
    """Surface of stereo, corrected by LiDAR, and continued by LiDAR where stereo found none.

    Args:
        maps: depth maps, already built.
        cloud: registered LiDAR.
        judged: verdict of the photographs on it.
        pixel_m: size of a pixel of the depth maps on the surface.
        pull: what is held to the LiDAR.
        free: where its beams met nothing; None: not known.
    """

    def __init__(
        self,
        maps: DepthMaps,
        cloud: LidarCloud,
        judged: CloudVerdict,
        pixel_m: float,
        *,
        pull: LidarPull = "both",
        free: FreeSpace | None = None,
    ) -> None:
        super().__init__(maps)
        self._pull, self._free, self._pixel_m = pull, free, pixel_m
        self.planes = LidarPlanes(cloud, judged.confidence, pixel_m)
        # All points hide what lies behind them, those that training does not trust too, but none that are gone.
        standing = np.flatnonzero(~judged.rejected)
        self._cloud, self._confidence = cloud.part(standing), judged.confidence[standing]
        radius_m = np.clip(_GAP * self._cloud.reach_m, _LEAST_GAP * cloud.voxel_m, _MOST_GAP * cloud.voxel_m)
        self._surfels = Surfels(self._cloud.position_in_model, self._cloud.normal_in_model, radius_m)

    def held(self, index: int, stride: int) -> tuple[FloatArray, Float32Array]:
        """Return the points (P, 3) that a training view is held to, and the weight of each (P,)."""
        if self._pull == "gaussians":
            return super().held(index, stride)
        stereo, by_contrast = super().held(index, stride)
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
        return SurfacePoints.concatenate([SurfacePoints(points, drawn.rgb, normals), alone])

    def gaussian_loss(self, device: torch.device) -> GaussianLoss | None:
        """Return the loss of Gaussians in free space, and beside the LiDAR's planes if those are to hold them."""
        planes = self.planes
        losses: list[tuple[float, GaussianLoss]] = []
        if self._free is not None:
            losses.append((_FREE_SPACE, FreeSpaceLoss(self._free, device)))
        if self._pull != "depth" and len(planes.confidence):
            cloud, scale_m = planes.cloud, _SCALE_PX * self._pixel_m
            measured = MeasuredPlanes(
                cloud.position_in_model, cloud.normal_in_model, planes.confidence, scale_m, _REACH * cloud.voxel_m
            )
            losses.append((_ATTRACTION, PlaneAttraction(measured, device)))
        if not losses:
            return None
        return lambda gaussians, visible: torch.stack([w * loss(gaussians, visible) for w, loss in losses]).sum()

    def _alone_in_view(self, index: int) -> SeenSurfels:
        """Return the trusted LiDAR points that a view sees at pixels without a depth of stereo."""
        poses, depth = self._poses, np.asarray(self._maps.depth(index))
        rotation, center = poses.cam_from_model[index], poses.cam_center_in_model[index]
        seen = seen_surfels(self._surfels, rotation, center, self._maps.camera(index))
        nearest = ndimage.minimum_filter(np.where(depth > 0, depth, np.inf), size=2 * _RIM_PX + 1)
        unknown = depth[seen.row, seen.column] == 0
        before = seen.depth_m < (1 + _SAME) * nearest[seen.row, seen.column]
        trusted = self._confidence[seen.rows] >= _LEAST_CONFIDENCE
        return seen.part(unknown & before & trusted & self._faces(seen.rows, center))

    def _faces(self, rows: IntArray, center: FloatArray) -> BoolArray:
        """Return whether a camera looks on the side of planes (K,) that the scanner saw; True where unknown."""
        cloud = self._cloud
        if cloud.scanner_in_model is None:
            return np.ones(len(rows), dtype=bool)
        place, normal = cloud.position_in_model[rows], cloud.normal_in_model[rows]
        sides = [np.einsum("pi,pi->p", eye - place, normal) for eye in (cloud.scanner_in_model[rows], center)]
        return np.asarray(~(sides[0] * sides[1] < 0))

    def _start_alone(
        self, stereo: FloatArray, most: int, inside: Callable[[FloatArray], BoolArray] | None
    ) -> SurfacePoints:
        """Return LiDAR points that no point of stereo is near, with the colours of the nearest photograph.

        Args:
            stereo: (S, 3) points of stereo.
            most: limit of the points.
            inside: as of `sample`.
        """
        colours = np.zeros((len(self._cloud), 3), dtype=np.uint8)
        size_m = np.full(len(self._cloud), np.inf)  # of a pixel of the nearest view
        for index in map(int, self._train):
            seen, focal_px = self._alone_in_view(index), self._maps.camera(index).fx
            seen = seen.part(seen.depth_m < focal_px * size_m[seen.rows])
            size_m[seen.rows] = seen.depth_m / focal_px
            colours[seen.rows] = self._maps.rgb(index)[seen.row, seen.column]
        rows = np.flatnonzero(np.isfinite(size_m))
        if len(stereo) and len(rows):
            gap, _ = cKDTree(stereo).query(self._cloud.position_in_model[rows])
            rows = rows[gap > _REACH * self._cloud.voxel_m]
        if inside is not None:
            rows = rows[inside(self._cloud.position_in_model[rows])]
        rows = rows[spread_evenly(self._cloud.position_in_model[rows], size_m[rows], most)]
        return SurfacePoints(self._cloud.position_in_model[rows], colours[rows], self._cloud.normal_in_model[rows])
