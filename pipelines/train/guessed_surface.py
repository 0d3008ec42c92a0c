"""Points for parts of the photographs whose depth stereo does not know: crowns in wind, water, smooth ground.

Without Gaussians to start from, density control would have to split the few that reach into such a part, again and
again. Points on the rays of its pixels, at the height of the SfM points around them, start as dense as the surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.geometry.footprints import PointSurface, ground_points
from pipelines.scene.scene import Scene
from pipelines.train.surface import SceneSurface, SurfacePoints, spread_evenly

_CANDIDATES = 4  # drawn for each wanted point


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
        rows, columns = np.nonzero(surface.depth(index) == 0)
        chosen = random.permutation(len(rows))[:each]
        place, rgb, size_m = _on_ground(scene, surface, index, np.stack([rows[chosen], columns[chosen]]), ground)
        points.append(place)
        colours.append(rgb)
        sizes.append(size_m)
    place, rgb, size_m = np.concatenate(points), np.concatenate(colours), np.concatenate(sizes)
    counted = np.flatnonzero(inside(place))
    kept = counted[spread_evenly(place[counted], size_m[counted], count)]
    return SurfacePoints(place[kept], rgb[kept], np.full((len(kept), 3), np.nan))


def _on_ground(
    scene: Scene, surface: SceneSurface, index: int, pixels: np.ndarray, ground: PointSurface
) -> tuple[FloatArray, ByteArray, FloatArray]:
    """Return points (P, 3) of pixels (2, K) of a view, their colours, and the width of a pixel there in metres."""
    camera, center = surface.camera(index), scene.poses.cam_center_in_model[index]
    rows, columns = pixels
    rays = camera.rays(np.stack([columns, rows], axis=1) + 0.5) @ scene.poses.cam_from_model[index]
    place = ground_points(rays, center, ground)
    met = np.isfinite(place).all(axis=1)
    along = np.linalg.norm(place - center, axis=1) / np.linalg.norm(rays, axis=1)
    return place[met], surface.rgb(index)[rows[met], columns[met]], along[met] / camera.fx
