"""Measured points that are held out of a training, and the error of the photographs' surface at them before it.

Whole squares of the plan are held out, since a point's neighbours would tell the training its place. The surface
that a depth map shows is compared with a point's plane, along its normal: half a pixel beside the point counts for
nothing.
"""

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, rows_of
from pipelines.surface.crossings import seen_surfels
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.lidar_cloud import LidarCloud, joined_clouds
from pipelines.survey.held_out import HeldOutPoints
from pipelines.train.lidar_surface import surfels_of


def held_out_points(
    held: LidarCloud, changed: BoolArray, used: LidarCloud, maps: DepthMaps, share: float
) -> HeldOutPoints:
    """Return the held-out points that a training view shows, with the error of its depth map of stereo at each.

    Left out are those that have changed (P,). What `used` and `held` points hide from a view, it does not show. A
    point belongs to the view that is nearest along its axis, whether or not stereo found a depth there.
    """
    standing = rows_of(held, ~changed)
    both, poses = joined_clouds(standing, used), maps.scene.poses
    surfels, count = surfels_of(both), len(standing)
    nearest_m = np.full(count, np.inf)
    view, before_m, normal = np.full(count, -1, np.int64), np.full(count, np.nan), standing.normal_in_model.copy()
    for index in map(int, maps.scene.train):
        rotation, center, camera = poses.cam_from_model[index], poses.cam_center_in_model[index], maps.camera(index)
        seen = seen_surfels(surfels, rotation, center, camera)
        seen = rows_of(seen, seen.rows < count)
        seen = rows_of(seen, seen.depth_m < nearest_m[seen.rows])
        rows, depth_m = seen.rows, np.asarray(maps.depth(index))[seen.row, seen.column].astype(np.float64)
        nearest_m[rows], view[rows] = seen.depth_m, index
        towards = _towards(standing.position_in_model[rows], standing.normal_in_model[rows], center)
        ray = camera.rays(np.stack([seen.column, seen.row], axis=1) + 0.5) @ rotation
        shown = center + depth_m[:, None] * ray
        off_m = np.einsum("pi,pi->p", shown - standing.position_in_model[rows], towards)
        normal[rows], before_m[rows] = towards, np.where(depth_m > 0, off_m, np.nan)
    shown_rows = view >= 0
    return HeldOutPoints(
        point_in_model=standing.position_in_model[shown_rows],
        normal_in_model=normal[shown_rows],
        view=view[shown_rows],
        before_m=before_m[shown_rows],
        share=np.array(share),
        changed=np.array(changed.sum()),
        unseen=np.array((~shown_rows).sum()),
    )


def _towards(point: FloatArray, normal: FloatArray, eye: FloatArray) -> FloatArray:
    """Return normals (P, 3) turned to the side of an eye (3,)."""
    side = np.einsum("pi,pi->p", eye - point, normal)
    return np.where(side[:, None] < 0, -normal, normal)
