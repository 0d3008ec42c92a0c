"""Fusion of the candidates: one point a voxel, on the mean surface of the views that agree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.depth_support import Support
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.thinning import voxel_keys
from pipelines.scene.surface_cloud.candidates import Candidates, Look, Square, candidates_in
from pipelines.scene.surface_cloud.plan import pixel_on_surface_m, plan_squares
from pipelines.scene.surface_views import SurfaceViews

_MARGIN = 4  # spacings around a square: fusion moves points by less, mostly
_MOST_THROUGH = 0.5  # largest number of views that look through a point, as a part of those that agree
# σ of a ray through a photograph, in pixels of the training size: on simulated flights, this and the views' own
# disagreement explain the distances to the true surface at 68 of 100 points.
_SIGMA_PX = 0.25
# A point is left out if its σ exceeds this part of the pixel: beyond, one point in five was a floater on simulated
# flights.
_RESOLVED = 1.0
_COARSEST = 2.0  # width of the pixels that are used, in medians: beyond lies the background, which few rays fix


@dataclass(frozen=True)
class FusionSettings:
    """Settings of the fusion.

    Attributes:
        spacing_m: side of the voxels.
        coarsest_m: wider pixels are left out.
        min_views: least number of views that agree on a point.
    """

    spacing_m: float
    coarsest_m: float
    min_views: int


@dataclass(frozen=True)
class SurfaceCloud:
    """P points of the surface in `geo`.

    Attributes:
        position: (P, 3) metres.
        normal: (P, 3) unit vectors towards the cameras.
        rgb: (P, 3) uint8.
        sigma_m: (P,) σ of the surface along the normal, without that of the georeference.
    """

    position: FloatArray
    normal: FloatArray
    rgb: ByteArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position)


def fusion_settings(
    views: SurfaceViews, geo_from_model: Similarity, min_views: int, spacing_m: float | None = None
) -> FusionSettings:
    """Return the settings for a cloud.

    Args:
        views: surface of the training views.
        geo_from_model: similarity.
        min_views: least number of views that agree on a point.
        spacing_m: side of the voxels; None: the width of a pixel on the surface.
    """
    pixel_m = pixel_on_surface_m(views, geo_from_model)
    return FusionSettings(spacing_m or pixel_m, _COARSEST * pixel_m, min_views)


def fused_squares(
    views: SurfaceViews, geo_from_model: Similarity, settings: FusionSettings, progress: Progress = SILENT
) -> Iterator[SurfaceCloud]:
    """Yield the cloud square by square of the plan, in bounded memory.

    1. Pixels of all views that show a smooth surface are the candidates.
    2. Candidates of a voxel are replaced by their mean, with the mean of their normals and colours.
    3. Points on which fewer than `min_views` views agree are dropped, those that too many views look through, and
       those whose σ exceeds a pixel.
    4. Each point moves along its normal to the mean surface of the views that agree.
    5. The moved points are thinned again, since layers of one surface meet.

    Args:
        views: surface of the training views, with colours.
        geo_from_model: similarity.
        settings: spacing, and what counts.
        progress: shows the squares.
    """
    step = max(1, int(settings.spacing_m / pixel_on_surface_m(views, geo_from_model)))
    squares = plan_squares(views, geo_from_model, settings.spacing_m, settings.coarsest_m, step)
    with progress.task("squares", len(squares)) as task:
        for planned in squares:
            look = Look(planned.square, _MARGIN * settings.spacing_m, settings.coarsest_m, step)
            found = (candidates_in(views.view(int(number)), geo_from_model, look) for number in planned.views)
            parts = [part for part in found if part is not None]
            if parts:
                yield fuse(Candidates.concatenate(parts), views, geo_from_model, planned.square, settings)
            task.advance()


def fuse(
    candidates: Candidates,
    views: SurfaceViews,
    geo_from_model: Similarity,
    square: Square,
    settings: FusionSettings,
) -> SurfaceCloud:
    """Return the cloud of a square from the candidates in it and in its margin."""
    side_m = settings.spacing_m
    position, normal, rgb, pixel_m = _voxel_means(side_m, candidates.position, *vars(candidates).values())
    normal = _unit(normal)
    support = views.support(geo_from_model.inverse().apply(position), normal @ geo_from_model.rotation)
    sigma_m = _sigma(support, pixel_m)
    moved = position + support.mean_normal_m[:, None] * normal
    with np.errstate(invalid="ignore"):
        good = (support.views >= settings.min_views) & (support.seen_through <= _MOST_THROUGH * support.views)
        good &= (sigma_m < _RESOLVED * pixel_m) & square.holds(moved)
    rows = np.flatnonzero(good)
    position, normal, rgb, variance = _voxel_means(
        side_m, moved[rows], moved[rows], normal[rows], rgb[rows], sigma_m[rows] ** 2
    )
    return SurfaceCloud(position, _unit(normal), np.round(rgb).astype(np.uint8), np.sqrt(variance))


def _sigma(support: Support, pixel_m: FloatArray) -> FloatArray:
    """Return σ (P,) of the surface along the normal; NaN without agreeing views.

    1. The views disagree about the surface. Their errors have a common cause, the Gaussians: a mean over more views
       is no better.
    2. All views may agree on a wrong surface where the photographs' rays meet at small angles. The intersection of
       rays with independent errors bounds that.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        between = np.maximum(support.rms_normal_m**2 - support.mean_normal_m**2, 0)
        intersection = _SIGMA_PX * pixel_m / (support.spread_rad * np.sqrt(support.views))
        return np.asarray(np.sqrt(between + intersection**2))


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (P, 3) of length one; NaN for a zero vector."""
    with np.errstate(invalid="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _voxel_means(side_m: float, position: FloatArray, *values: NDArray[Any]) -> list[FloatArray]:
    """Return the means of values (P, …) over the voxels that hold points (P, 3): (V, …) each."""
    if not len(position):
        return [np.zeros(value.shape) for value in values]
    key = voxel_keys(position, side_m)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(first, append=len(key))
    return [
        np.add.reduceat(value[order].astype(np.float64), first) / count.reshape(-1, *(1,) * (value.ndim - 1))
        for value in values
    ]
