"""Surface of stereo and LiDAR together: points of stereo moved onto the planes of the LiDAR that is trusted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.lidar.cloud import LidarCloud
from pipelines.train.surface import SceneSurface, SurfacePoints

_LEAST_CONFIDENCE = 0.1
_REACH = 2.0  # distances between points, from a point of stereo to the LiDAR
_OFF_PIXELS = 2.0  # of the depth maps: a point of stereo further from the plane lies on another surface
_WEIGHT = 4.0  # of a trusted LiDAR point's pull, relative to that of stereo
_CELL_PX = 4  # cells in which the nearest LiDAR point hides the others
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
        confidence: (P,) in its points.
        pixel_m: size of a pixel of the depth maps on the surface.
    """

    def __init__(self, maps: DepthMaps, cloud: LidarCloud, confidence: FloatArray, pixel_m: float) -> None:
        super().__init__(maps)
        self.planes = LidarPlanes(cloud, confidence, pixel_m)
        self.cloud, self.confidence = self.planes.cloud, self.planes.confidence

    def held(self, index: int, stride: int) -> tuple[FloatArray, Float32Array]:
        """Return the points (P, 3) that a training view is held to, and the weight of each (P,)."""
        points, _, confidence = self.planes.onto(super().points(index, stride))
        alone = self._alone_in_view(index)
        weight = np.concatenate([1.0 + (_WEIGHT - 1.0) * confidence, _WEIGHT * self.confidence[alone]])
        return np.concatenate([points, self.cloud.position_in_model[alone]]), weight.astype(np.float32)

    def sample(
        self, count: int, seed: int, inside: Callable[[FloatArray], BoolArray] | None = None
    ) -> SurfacePoints:
        """Return points of the whole surface as `SceneSurface.sample`, with LiDAR where stereo found none."""
        drawn = super().sample(count, seed, inside)
        points, normal, confidence = self.planes.onto(drawn.point_in_model)
        normals = np.where((confidence > 0)[:, None], normal, drawn.normal_in_model)
        stereo = SurfacePoints(points, drawn.rgb, normals)
        return SurfacePoints.concatenate([stereo, self._start_alone(stereo, max(count - len(stereo.rgb), 0), seed)])

    def _alone_in_view(self, index: int) -> np.ndarray:
        """Return the rows of the LiDAR points that a view sees at pixels without a depth of stereo."""
        camera, poses = self._maps.camera(index), self._poses
        in_cam = (self.cloud.position_in_model - poses.cam_center_in_model[index]) @ poses.cam_from_model[index].T
        ahead = np.flatnonzero(in_cam[:, 2] > 1e-3)
        z = in_cam[ahead, 2]
        column = np.floor(camera.fx * in_cam[ahead, 0] / z + camera.cx).astype(np.int64)
        row = np.floor(camera.fy * in_cam[ahead, 1] / z + camera.cy).astype(np.int64)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        ahead, z, column, row = ahead[inside], z[inside], column[inside], row[inside]
        nearest = np.full((camera.height // _CELL_PX + 1, camera.width // _CELL_PX + 1), np.inf)
        cell = (row // _CELL_PX, column // _CELL_PX)
        np.minimum.at(nearest, cell, z)
        visible = z <= (1 + _SAME) * nearest[cell]
        unknown = np.asarray(self._maps.depth(index))[row, column] == 0
        return np.asarray(ahead[visible & unknown])

    def _start_alone(self, stereo: SurfacePoints, room: int, seed: int) -> SurfacePoints:
        """Return LiDAR points that no point of stereo is near, with the colours of photographs that see them."""
        cloud, colours = self.cloud, np.zeros((len(self.cloud), 3), dtype=np.uint8)
        seen = np.zeros(len(cloud), dtype=bool)
        for index in map(int, self._train):
            rows = self._alone_in_view(index)
            rows = rows[~seen[rows]]
            colours[rows] = self._colours(index, rows)
            seen[rows] = True
        rows = np.flatnonzero(seen)
        if len(stereo.rgb) and len(rows):
            gap, _ = cKDTree(stereo.point_in_model).query(cloud.position_in_model[rows])
            rows = rows[gap > _REACH * cloud.voxel_m]
        if len(rows) > room:
            rows = np.sort(np.random.default_rng(seed).choice(rows, room, replace=False))
        return SurfacePoints(cloud.position_in_model[rows], colours[rows], cloud.normal_in_model[rows])

    def _colours(self, index: int, rows: np.ndarray) -> ByteArray:
        camera, poses = self._maps.camera(index), self._poses
        place = self.cloud.position_in_model[rows] - poses.cam_center_in_model[index]
        in_cam = place @ poses.cam_from_model[index].T
        column = np.clip(camera.fx * in_cam[:, 0] / in_cam[:, 2] + camera.cx, 0, camera.width - 1).astype(int)
        row = np.clip(camera.fy * in_cam[:, 1] / in_cam[:, 2] + camera.cy, 0, camera.height - 1).astype(int)
        return np.asarray(self._maps.rgb(index)[row, column])
