"""Depth maps of the training photographs as one set, against which a LiDAR cloud is compared."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.depth_support import DepthViews
from pipelines.train.depth_maps import DepthMaps


def depth_views(maps: DepthMaps) -> DepthViews:
    """Return the depth maps of all training views, in `model`."""
    train, poses = [int(index) for index in maps.scene.train], maps.scene.poses
    cameras = [maps.camera(index) for index in train]
    depths = [np.asarray(maps.depth(index)).ravel() for index in train]
    return DepthViews(
        cam_from_world=poses.cam_from_model[train],
        center_in_world=poses.cam_center_in_model[train],
        intrinsics_px=np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]),
        size_px=np.array([(camera.width, camera.height) for camera in cameras], dtype=np.int64),
        start=np.concatenate([[0], np.cumsum([len(depth) for depth in depths])[:-1]]).astype(np.int64),
        depth_m=np.concatenate(depths),
    )


def pixel_size_m(maps: DepthMaps) -> float:
    """Return the size of a pixel of the depth maps on the surface, the median over all training views."""
    sizes = []
    for index in map(int, maps.scene.train):
        depth = maps.depth(index)[::8, ::8]
        if (depth > 0).any():
            sizes.append(float(np.median(depth[depth > 0])) / maps.camera(index).fx)
    return float(np.median(sizes)) if sizes else 0.1
