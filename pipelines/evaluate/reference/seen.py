"""Which points of a reference the photographs saw: those that no other point of the reference hides.

The model has no say: a surface that training missed was seen all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import minimum_filter

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.depth_support import DepthViews, support

LEAST_VIEWS = 3  # as many as must agree on a point of the model's cloud
_CELL_VOXELS = 1.5  # width of a pixel of the maps on the surface: none stays empty between the points
_TOLERANCE_VOXELS = 4.0  # a map shows the nearest point of three pixels: on a slope of 45° the others lie behind
_NEAR_M = 0.1
_BLOCK_M = 40.0  # side of the blocks of points that a view shows or not
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Viewpoints:
    """Cameras of V photographs in `geo`.

    Attributes:
        cam_from_geo: (V, 3, 3) rotations.
        center_in_geo: (V, 3) metres.
        pinholes: V, of undistorted photographs.
    """

    cam_from_geo: FloatArray
    center_in_geo: FloatArray
    pinholes: tuple[Pinhole, ...]


@dataclass(frozen=True)
class SeenSurface:
    """Depth maps of a reference from the photographs.

    Attributes:
        views: the maps.
        tolerance: largest difference of depths of one surface, as a part of the depth.
    """

    views: DepthViews
    tolerance: float

    def sees(self, position_in_geo: FloatArray) -> BoolArray:
        """Return whether enough photographs saw points (P, 3)."""
        return np.asarray(support(position_in_geo, self.views, _UP, self.tolerance).views >= LEAST_VIEWS)


def seen_surface(
    viewpoints: Viewpoints, position_in_geo: FloatArray, voxel_m: float, progress: Progress = SILENT
) -> SeenSurface:
    """Return the depth maps of a reference.

    Args:
        viewpoints: cameras.
        position_in_geo: (P, 3) points of the reference, one a voxel.
        voxel_m: side of the voxels.
        progress: shows the photographs.
    """
    blocks = _blocks(position_in_geo)
    maps: list[Float32Array] = []
    intrinsics, sizes, depths = [], [], []
    with progress.task("photographs of the reference", len(viewpoints.pinholes)) as task:
        for rotation, center, pinhole in zip(
            viewpoints.cam_from_geo, viewpoints.center_in_geo, viewpoints.pinholes, strict=True
        ):
            shown = _in_view(blocks, rotation, center, pinhole)
            depths.append(float(np.median(shown[:, 2])) if len(shown) else np.inf)
            # Never larger than the photograph, and one pixel if nothing is in view.
            shrink = float(np.clip(_CELL_VOXELS * voxel_m * pinhole.fx / depths[-1], 1, pinhole.width))
            coarse = _coarse(pinhole, shrink if len(shown) else float(pinhole.width))
            maps.append(_depth_map(shown, coarse, pinhole.fx / coarse.fx))
            intrinsics.append([coarse.fx, coarse.fy, coarse.cx, coarse.cy])
            sizes.append([coarse.width, coarse.height])
            task.advance()
    start = np.concatenate([[0], np.cumsum([depth.size for depth in maps])])[:-1]
    typical_m = float(np.median(depths))
    return SeenSurface(
        DepthViews(
            viewpoints.cam_from_geo,
            viewpoints.center_in_geo,
            np.array(intrinsics),
            np.array(sizes),
            start.astype(np.int64),
            np.concatenate([depth.ravel() for depth in maps]),
        ),
        _TOLERANCE_VOXELS * voxel_m / typical_m,
    )


def _blocks(position: FloatArray) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return points by blocks of the plan: the points, the middle and the radius of each block."""
    cell = np.floor(position[:, :2] / _BLOCK_M).astype(np.int64)
    order = np.lexsort(cell.T)
    starts = np.flatnonzero(np.any(np.diff(cell[order], axis=0, prepend=cell[order][:1] - 1), axis=1))
    parts = [position[rows] for rows in np.split(order, starts[1:])]
    middles = [(part.min(axis=0) + part.max(axis=0)) / 2 for part in parts]
    radii = [float(np.linalg.norm(np.ptp(part, axis=0))) / 2 for part in parts]
    return list(zip(parts, middles, radii, strict=True))


def _in_view(
    blocks: list[tuple[FloatArray, FloatArray, float]],
    rotation: FloatArray,
    center: FloatArray,
    pinhole: Pinhole,
) -> FloatArray:
    """Return pixel coordinates and depth (K, 3) of the points in a view."""
    corner = max(pinhole.cx, pinhole.width - pinhole.cx), max(pinhole.cy, pinhole.height - pinhole.cy)
    half = np.arctan(np.hypot(corner[0] / pinhole.fx, corner[1] / pinhole.fy))
    near = []
    for part, middle, radius in blocks:
        arm = middle - center
        distance = float(np.linalg.norm(arm))
        off = np.arccos(np.clip(rotation[2] @ arm / max(distance, 1e-9), -1, 1))
        if distance <= radius or off <= half + np.arcsin(min(radius / distance, 1.0)):
            near.append(part)
    in_cam = (np.concatenate(near) - center) @ rotation.T if near else np.zeros((0, 3))
    in_cam = in_cam[in_cam[:, 2] > _NEAR_M]
    xy = pinhole.project(in_cam)
    return np.column_stack([xy, in_cam[:, 2]])[pinhole.holds(xy)]


def _coarse(pinhole: Pinhole, shrink: float) -> Pinhole:
    """Return the pinhole of an image that is `shrink` times smaller."""
    width, height = max(int(np.ceil(pinhole.width / shrink)), 1), max(int(np.ceil(pinhole.height / shrink)), 1)
    return Pinhole(
        width, height, pinhole.fx / shrink, pinhole.fy / shrink, pinhole.cx / shrink, pinhole.cy / shrink
    )


def _depth_map(shown: FloatArray, coarse: Pinhole, shrink: float) -> Float32Array:
    """Return the least depth (H, W) of the points in and beside each pixel; 0: none."""
    depth = np.full((coarse.height, coarse.width), np.inf, dtype=np.float32)
    column = np.minimum((shown[:, 0] / shrink).astype(np.int64), coarse.width - 1)
    row = np.minimum((shown[:, 1] / shrink).astype(np.int64), coarse.height - 1)
    np.minimum.at(depth, (row, column), shown[:, 2].astype(np.float32))
    nearest = minimum_filter(depth, size=3, mode="nearest")
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)
