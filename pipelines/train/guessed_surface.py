"""Points for parts of the photographs whose depth stereo does not know: crowns in wind, water, smooth ground.

Without Gaussians to start from, density control would have to split the few that reach into such a part, again and
again. Points on the rays of its pixels, at the height of the SfM points around them, start as dense as the surface.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.footprints import PointSurface, ground_points
from pipelines.scene.scene import Scene
from pipelines.train.surface import SceneSurface, SurfacePoints, spread_evenly

_CANDIDATES = 4  # drawn for each wanted point
_COLUMNS = 64  # along the longer side of a view: neighbouring rays meet neighbouring ground


def guessed_points(
    scene: Scene,
    surface: SceneSurface,
    count: int,
    seed: int,
    inside: Callable[[FloatArray], BoolArray],
) -> SurfacePoints:
    """Return points, without normals, at pixels of the training views whose depth is not known.

    Each lies where the ray of its pixel meets the surface through the SfM points, z up. Sky has none.

    Args:
        scene: cameras and SfM points.
        surface: with the known depths.
        count: limit of the points, which are spread as evenly as the photographs resolve them.
        seed: of the choice of pixels.
        inside: returns which of points (N, 3) count, as a mask (N,).
    """
    if count < 1:
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))
    ground, random = PointSurface(scene.point_in_model), np.random.default_rng(seed)
    each = -(-_CANDIDATES * count // max(len(scene.train), 1))
    points, colours, sizes = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0)]
    for index in map(int, scene.train):
        camera = surface.camera(index)
        unknown = surface.depth(index) == 0
        depth = _ground_depth(scene, index, camera, ground, unknown)
        rows, columns = np.nonzero(unknown & np.isfinite(depth))
        chosen = random.permutation(len(rows))[:each]
        rows, columns = rows[chosen], columns[chosen]
        in_cam = depth[rows, columns, None] * camera.rays(np.stack([columns, rows], axis=1) + 0.5)
        points.append(in_cam @ scene.poses.cam_from_model[index] + scene.poses.cam_center_in_model[index])
        colours.append(surface.rgb(index)[rows, columns])
        sizes.append(depth[rows, columns] / camera.fx)
    place, rgb, size_m = np.concatenate(points), np.concatenate(colours), np.concatenate(sizes)
    counted = np.flatnonzero(inside(place))
    kept = counted[spread_evenly(place[counted], size_m[counted], count)]
    return SurfacePoints(place[kept], rgb[kept], np.full((len(kept), 3), np.nan))


def _ground_depth(scene: Scene, index: int, camera: Pinhole, ground: PointSurface, wanted: BoolArray) -> FloatArray:
    """Return the depth (H, W) of the ground in a view, in metres, from a few rays around the wanted pixels.

    It is NaN where a ray meets no ground, and away from the wanted pixels.
    """
    center, coarse = scene.poses.cam_center_in_model[index], camera.limited(_COLUMNS)
    around = cv2.resize(wanted.astype(np.float32), (coarse.width, coarse.height), interpolation=cv2.INTER_AREA) > 0
    near = cv2.dilate(around.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # pixels are between four rays
    rays = coarse.points_at(np.ones(near.shape))[near.ravel()] @ scene.poses.cam_from_model[index]
    place = ground_points(rays, center, ground)
    along = np.full(near.shape, np.nan)
    along[near] = np.linalg.norm(place - center, axis=1) / np.linalg.norm(rays, axis=1)
    size = camera.width, camera.height
    return np.asarray(cv2.resize(along, size, interpolation=cv2.INTER_LINEAR))
