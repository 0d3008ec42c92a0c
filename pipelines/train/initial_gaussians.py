"""Initial Gaussians of a training, and the points that its surface losses hold them to."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.scene.photographs import ImageCache
from pipelines.scene.scene import Scene
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.initialise import InitialisationOptions, gaussians_from_points, gaussians_of_size
from pipelines.splat.surface import ObservedPoints
from pipelines.train.background import background
from pipelines.train.guessed_surface import guessed_points
from pipelines.train.region import TrainingRegion
from pipelines.train.surface import SceneSurface, SurfacePoints
from pipelines.train.underlay import hidden, underlay

_SURFACE_SHARE = 0.8  # of the limit of Gaussians starts on the surface; density control places the others
_MOSTLY_KNOWN = 0.6  # of the pixels: with fewer known depths, more Gaussians are needed off the surface
_UNKNOWN_SHARE = 0.05  # of the limit starts where no depth is known, at least: density control finds corners late
_BENEATH_SHARE = 0.02  # of the limit lies beneath the scene
_BENEATH_SIGMA = 0.6  # in cells of the sheet: it has no gaps
_BENEATH_THICKNESS = 0.2
_BENEATH_OPACITY = 0.7
_STRIDE = 3  # of rows and columns of a depth map: Gaussians are wider than its pixels
_KEPT_VIEWS = 128  # views whose points stay on the device
_OFF_SURFACE = 3.0  # gaps between points of the surface: an SfM point nearer than that lies on it


@dataclass(frozen=True)
class TrainingScene:
    """Inputs of a training.

    Attributes:
        scene: cameras and SfM points.
        images: undistorted photographs.
        surface: surface from depth maps; None: the training goes without.
        region: part of the scene that is trained; None: all of it.
    """

    scene: Scene
    images: ImageCache
    surface: SceneSurface | None = None
    region: TrainingRegion | None = None

    def in_region(self, points: FloatArray) -> BoolArray:
        """Return which of points (N, 3) in `model` are trained, as a mask (N,)."""
        return np.ones(len(points), dtype=bool) if self.region is None else self.region.cell.contains(points)


def initial_gaussians(training: TrainingScene, options: InitialisationOptions, most: int, seed: int) -> Gaussians:
    """Return the Gaussians that a training starts from.

    1. Discs lie on the surface, as dense as the photographs resolve it.
    2. Balls lie at SfM points where no surface is known. On a surface discs are better: an SfM point has no normal,
       and a ball reaches as far behind a wall as the gap to the wall's next point.
    3. Balls lie at the height of the SfM points where photographs show no known surface: the more of it, the more.
    4. A sheet lies beneath the surface: what photographs do not show is no hole.
    5. Balls lie in the background, as far as the limit leaves room. In a region, the sky is that of the model which
       stands in for the rest: all blocks of a survey then have the same.

    Args:
        training: cameras, photographs and surface.
        options: settings of the Gaussians.
        most: limit of the Gaussians.
        seed: seed of the choice of surface points.

    Raises:
        DegenerateGeometryError: fewer than two different points.
    """
    scene = training.scene
    start = SurfacePoints(scene.point_in_model, scene.sparse.point_rgb, np.full_like(scene.point_in_model, np.nan))
    if training.surface is not None:
        share = _SURFACE_SHARE * min(1.0, training.surface.known_share() / _MOSTLY_KNOWN)
        surface = training.surface.sample(int(share * most), seed, training.in_region)
        start = SurfacePoints.concatenate([start.part(_off_surface(start, surface)), surface])
        unknown = int(max(_SURFACE_SHARE - share, _UNKNOWN_SHARE) * most)
        guessed = guessed_points(scene, training.surface, unknown, seed, training.in_region)
        start = SurfacePoints.concatenate([start, guessed])
    behind = background(scene, training.images, start.point_in_model)
    beneath = _sheet(training, start, options, int(_BENEATH_SHARE * most), seed)
    start = start.part(np.flatnonzero(training.in_region(start.point_in_model)))
    near = gaussians_from_points(start.point_in_model, start.rgb, options, start.normal_in_model)
    far = gaussians_of_size(behind.point_in_model, behind.rgb, behind.sigma_m, options)
    if training.region is not None:
        within = training.in_region(behind.point_in_model) & training.region.box.contains(behind.point_in_model)
        far = Gaussians.concatenate([far.select(torch.from_numpy(within)), training.region.sky])
    if len(near) + len(beneath) <= most:
        near = Gaussians.concatenate([near, beneath])
    room = max(most - len(near), 0)
    keep = torch.linspace(0, max(len(far) - 1, 0), min(room, len(far))).long()
    return Gaussians.concatenate([near, far.select(keep)])


def _sheet(
    training: TrainingScene, start: SurfacePoints, options: InitialisationOptions, count: int, seed: int
) -> Gaussians:
    """Return flat Gaussians beneath the points that a training starts from; none where no surface hides them."""
    sheet, side_m = underlay(start, count, seed)
    kept = np.zeros(len(sheet.rgb), dtype=bool)
    if training.surface is not None:
        place = sheet.point_in_model
        kept = training.in_region(place) & hidden(place, training.scene, training.surface)
    sheet = sheet.part(np.flatnonzero(kept))
    sigma_m = np.full(len(sheet.rgb), _BENEATH_SIGMA * side_m)
    discs = gaussians_of_size(sheet.point_in_model, sheet.rgb, sigma_m, replace(options, opacity=_BENEATH_OPACITY))
    discs.log_scales[:, 2] += math.log(_BENEATH_THICKNESS)
    return discs


def _off_surface(points: SurfacePoints, surface: SurfacePoints) -> IntArray:
    """Return the rows of the points that are not near any point of the surface."""
    if len(surface.rgb) < 2:
        return np.arange(len(points.rgb))
    tree = cKDTree(surface.point_in_model)
    gap, _ = tree.query(surface.point_in_model, k=2)
    distance, nearest = tree.query(points.point_in_model)
    return np.flatnonzero(distance > _OFF_SURFACE * gap[nearest, 1])


def points_to_hold(training: TrainingScene, device: torch.device) -> Callable[[int], ObservedPoints]:
    """Return a function of an image's index that gives the points in `model`, float32, that the image shows.

    These are SfM points and, in training images, points of the surface.

    Args:
        training: SfM points and surface.
        device: holds the points.
    """
    scene = training.scene
    shown = set(map(int, scene.train))

    @lru_cache(maxsize=_KEPT_VIEWS)
    def points(index: int) -> ObservedPoints:
        known = scene.point_in_model[scene.sparse.points_in(index)]
        weight = np.ones(len(known), dtype=np.float32)
        if training.surface is not None and index in shown:
            of_surface, its_weight = training.surface.held(index, _STRIDE)
            known, weight = np.concatenate([known, of_surface]), np.concatenate([weight, its_weight])
        inside = training.in_region(known)
        known, weight = known[inside], weight[inside]
        return ObservedPoints(torch.from_numpy(known).float().to(device), torch.from_numpy(weight).to(device))

    return points
