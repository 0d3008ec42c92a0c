"""The scene that training starts from, and its first Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.core.types import IntArray
from pipelines.scene.photographs import ImageCache
from pipelines.scene.scene import Scene
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.initialise import InitialisationOptions, gaussians_from_points, gaussians_of_size
from pipelines.train.background import background
from pipelines.train.surface import SceneSurface, SurfacePoints

_SURFACE_SHARE = 0.8  # of the Gaussians that there may be start on the surface; density control places the others
_MOSTLY_KNOWN = 0.6  # of the pixels: where less is known of the surface, more Gaussians are needed elsewhere
_STRIDE = 3  # every third pixel of a depth map is enough to hold Gaussians, which are wider
_KEPT_VIEWS = 128  # views whose points stay on the device
_OFF_SURFACE = 3.0  # gaps between points of the surface: an SfM point so near to one lies on it


@dataclass(frozen=True)
class TrainingScene:
    """Cameras and SfM points, photographs, and the surface, if it was looked for."""

    scene: Scene
    images: ImageCache
    surface: SceneSurface | None = None


def initial_gaussians(training: TrainingScene, options: InitialisationOptions, most: int, seed: int) -> Gaussians:
    """On the surface as densely as photographs show it, at SfM points where none is known, and in the background.

    Where the surface is known its discs are the better start: an SfM point says nothing of where it faces, and a
    ball reaches as far behind a wall as the wall's next point is away.

    Args:
        training: cameras, photographs and surface.
        options: how each of them starts.
        most: how many there may be.
        seed: of the choice of points.

    Raises:
        DegenerateGeometryError: too few points.
    """
    scene = training.scene
    start = SurfacePoints(scene.point_in_model, scene.sparse.point_rgb, np.full_like(scene.point_in_model, np.nan))
    if training.surface is not None:
        share = _SURFACE_SHARE * min(1.0, training.surface.known() / _MOSTLY_KNOWN)
        surface = training.surface.sample(int(share * most), seed)
        start = SurfacePoints.concatenate([start.part(_off_surface(start, surface)), surface])
    near = gaussians_from_points(start.point_in_model, start.rgb, options, start.normal_in_model)
    behind = background(scene, training.images, start.point_in_model)
    far = gaussians_of_size(behind.point_in_model, behind.rgb, behind.sigma_m, options)
    room = max(most - len(near), 0)
    keep = torch.linspace(0, max(len(far) - 1, 0), min(room, len(far))).long()
    return Gaussians.concatenate([near, far.select(keep)])


def _off_surface(points: SurfacePoints, surface: SurfacePoints) -> IntArray:
    """Rows of the points that no point of the surface is near to."""
    if len(surface.rgb) < 2:
        return np.arange(len(points.rgb))
    tree = cKDTree(surface.point_in_model)
    gap, _ = tree.query(surface.point_in_model, k=2)
    distance, nearest = tree.query(points.point_in_model)
    return np.flatnonzero(distance > _OFF_SURFACE * gap[nearest, 1])


def points_to_hold(training: TrainingScene, device: torch.device) -> Callable[[int], Tensor]:
    """By image, the points (K, 3) in `model`, float32, of SfM and of the surface that it shows."""
    scene = training.scene
    shown = set(map(int, scene.train))

    @lru_cache(maxsize=_KEPT_VIEWS)
    def points(index: int) -> Tensor:
        shown_points = scene.point_in_model[scene.sparse.points_in(index)]
        if training.surface is not None and index in shown:
            shown_points = np.concatenate([shown_points, training.surface.points(index, _STRIDE)])
        return torch.from_numpy(shown_points).float().to(device)

    return points
