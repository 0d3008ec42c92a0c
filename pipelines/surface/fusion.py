"""Fusion of the depth maps to a point cloud: one point a voxel, on the mean surface of the views that agree.

Candidates are the pixels of the maps with their normals, where a surface is smooth. Work goes square by square of
the plan, so that the candidates of one fit into the memory.
"""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.machine import thread_count
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray, joined_rows
from pipelines.geometry.footprints import voxel_keys
from pipelines.geometry.similarity import Similarity
from pipelines.surface.fusion_kernels import PixelLimits, chosen_pixels, voxel_means
from pipelines.surface.surface_views import SurfaceView, SurfaceViews
from pipelines.surface.visibility import Support

REACH_PX = 2  # from a pixel to those whose differences give its normal
BEND = 0.01  # limit of |z/z₁ + z/z₂ − 2| for a depth z between opposite neighbours z₁, z₂ on a smooth surface
_LOOK_PX = 8  # between the pixels that are tested for lying in a square
GRAZING = 0.17  # least cosine between ray and normal (80°): blurred edges bridge two surfaces along the rays
# Memory: candidates of one square, of about 100 bytes each, with the copies that sorting them makes.
_MOST_CANDIDATES = 4_000_000
_SAMPLE_PX = 8  # between the pixels from which sizes and extent are estimated
_LEAST_VOXELS = 16  # along the side of a square
_MARGIN = 4  # spacings around a square: fusion moves points by less, mostly
MOST_THROUGH = 0.5  # largest number of views that look through a point, over the number of those that agree
# σ of a ray through a photograph, in pixels of the training size: on simulated flights, this and the views' own
# disagreement explain the distances to the true surface at 68 of 100 points.
_SIGMA_PX = 0.25
# A point is left out if its σ exceeds this part of a pixel's width: beyond, one point in five was a floater on
# simulated flights.
_RESOLVED = 1.0
COARSEST = 2.0  # largest width of a used pixel over the median: wider ones show background that few rays determine


@dataclass(frozen=True)
class FusionSettings:
    """Settings of the fusion."""

    spacing_m: float  # side of the voxels
    coarsest_m: float  # wider pixels are left out
    min_views: int  # least number of views that agree on a point


@dataclass(frozen=True)
class SurfaceCloud:
    """P points of the surface in `geo`."""

    position: FloatArray  # (P, 3) metres
    normal: FloatArray  # (P, 3) unit vectors towards the cameras
    rgb: ByteArray  # (P, 3) uint8
    sigma_m: FloatArray  # (P,) σ of the surface along the normal, without that of the georeference


def pixel_on_surface_m(views: SurfaceViews, geo_from_model: Similarity) -> float:
    """Return the median pixel width on the surface in metres, over the views; a DegenerateGeometryError: none."""
    medians = []
    for view in map(views.view, range(len(views))):
        depth = view.depth_m[::_SAMPLE_PX, ::_SAMPLE_PX]
        if (depth > 0).any():
            medians.append(geo_from_model.scale * float(np.median(depth[depth > 0])) / view.pinhole.fx)
    if not medians:
        raise DegenerateGeometryError(
            "no-common-surface",
            f"In none of the {len(views)} training views do rendered depths agree with those of other views.",
            remedy="Train with more --iterations, or with --dense.",
        )
    return float(np.median(medians))


def fusion_settings(
    views: SurfaceViews, geo_from_model: Similarity, min_views: int, spacing_m: float | None = None
) -> FusionSettings:
    """Return the settings for a cloud; without `spacing_m`, voxels are as wide as a pixel on the surface."""
    pixel_m = pixel_on_surface_m(views, geo_from_model)
    return FusionSettings(spacing_m or pixel_m, COARSEST * pixel_m, min_views)


def fused_squares(
    views: SurfaceViews, geo_from_model: Similarity, settings: FusionSettings, progress: Progress = SILENT
) -> Iterator[SurfaceCloud]:
    """Yield the cloud square by square of the plan, in bounded memory, from views with colours.

    1. Pixels of all views that show a smooth surface are the candidates.
    2. Candidates of a voxel are replaced by their mean, with the mean of their normals and colours.
    3. Points on which fewer than `min_views` views agree are dropped, those that too many views look through, and
       those whose σ exceeds a pixel.
    4. Each point moves along its normal to the mean surface of the views that agree.
    5. The moved points are thinned again, since layers of one surface meet.
    """
    step = max(1, int(settings.spacing_m / pixel_on_surface_m(views, geo_from_model)))
    squares = _plan(views, geo_from_model, settings, step)
    with (
        progress.task("squares", len(squares)) as task,
        ThreadPoolExecutor(thread_count()) as pool,
        ThreadPoolExecutor(1) as beside,
    ):
        gathered = partial(_gathered, views, geo_from_model, settings, step=step, pool=pool)
        # Much of this is on one core: the next square's meanwhile keeps the others busy.
        coming = [beside.submit(gathered, each) for each in squares[:1]]
        for number, (square, _) in enumerate(squares):
            candidates = coming.pop().result()
            coming += [beside.submit(gathered, each) for each in squares[number + 1 : number + 2]]
            if len(candidates.position):
                yield _fuse(candidates, views, geo_from_model, square, settings)
            task.advance()


@dataclass(frozen=True)
class _Candidates:
    """As `SurfaceCloud`, or the means of voxels, with the width (P,) of a pixel at the point."""

    position: FloatArray
    normal: FloatArray
    rgb: ByteArray | FloatArray
    pixel_m: FloatArray


@dataclass(frozen=True)
class _Square:
    """Square of the plan, east and north in `geo`, half open towards north and east."""

    corner_m: tuple[float, float]
    side_m: float

    def covers(self, position: FloatArray) -> BoolArray:
        """Return which points (P, 3) lie in the square."""
        offset = position[:, :2] - self.corner_m
        return np.asarray(((offset >= 0) & (offset < self.side_m)).all(axis=1))


def _gathered(
    views: SurfaceViews,
    geo_from_model: Similarity,
    settings: FusionSettings,
    shown: tuple[_Square, IntArray],
    *,
    step: int,
    pool: Executor,
) -> _Candidates:
    """Return the means over the voxels of the candidates in a square and its margin of the views that show it."""
    square, shown_by = shown
    in_square = partial(_candidates, views, geo_from_model, square, settings)
    pixels = joined_rows(list(pool.map(in_square, [(int(number), step) for number in shown_by])))
    return _Candidates(*voxel_means(settings.spacing_m, pixels.position, *vars(pixels).values()))


def _candidates(
    views: SurfaceViews,
    geo_from_model: Similarity,
    square: _Square,
    settings: FusionSettings,
    which: tuple[int, int],
) -> _Candidates:
    """Return the candidates in a square and its margin of a view: its number, and of how many rows one is used."""
    number, step = which
    view = views.view(number)
    assert view.rgb is not None
    margin_m, pinhole = _MARGIN * settings.spacing_m, view.pinhole
    low = np.array(square.corner_m) - margin_m
    return _Candidates(
        *chosen_pixels(
            view.depth_m,
            view.rgb,
            np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy]),
            geo_from_model.scale * geo_from_model.rotation @ view.cam_from_model.T,
            geo_from_model.apply(view.cam_center_in_model),
            geo_from_model.scale,
            np.concatenate([low, low + square.side_m + 2 * margin_m]),
            PixelLimits(REACH_PX, BEND, GRAZING, settings.coarsest_m, step, _LOOK_PX),
        )
    )


def _plan(
    views: SurfaceViews, geo_from_model: Similarity, settings: FusionSettings, step: int
) -> list[tuple[_Square, IntArray]]:
    """Return the squares that contain the surface, and the numbers of the views that may show each.

    Squares have at most about `_MOST_CANDIDATES` candidates. They consist of whole voxels, so that none is cut.
    """
    look, unit_m = max(_SAMPLE_PX, step), _LEAST_VOXELS * settings.spacing_m
    shown = [
        _cells(view, geo_from_model, unit_m, settings.coarsest_m, look)
        for view in map(views.view, range(len(views)))
    ]
    cells = np.concatenate([cell for cell, _ in shown]) if shown else np.zeros((0, 2), np.int64)
    if not len(cells):
        return []
    counts = np.concatenate([count for _, count in shown])
    owner = np.repeat(np.arange(len(shown)), [len(cell) for cell, _ in shown])
    candidates = counts * (look / step) ** 2  # estimated from every `look`-th pixel
    level = int(np.ptp(cells, axis=0).max()).bit_length()
    while True:
        keys = voxel_keys(cells.astype(np.float64), 2.0**level)
        _, first, member = np.unique(keys, return_index=True, return_inverse=True)
        if level == 0 or np.bincount(member, candidates).max() <= _MOST_CANDIDATES:
            break
        level -= 1
    side_m = float(unit_m * 2**level)
    # A margin around a square is narrower than a cell: views of the neighbouring cells may show it too.
    low, high = ((cells - 1) >> level, (cells + 1) >> level)
    return [
        (
            _Square((float(place[0] * side_m), float(place[1] * side_m)), side_m),
            np.unique(owner[((low <= place) & (place <= high)).all(axis=1)]),
        )
        for place in cells[first] >> level
    ]


def _cells(
    view: SurfaceView, geo_from_model: Similarity, unit_m: float, coarsest_m: float, look: int
) -> tuple[IntArray, IntArray]:
    """Return the cells (K, 2) of the plan, of `unit_m`, that a view shows, and the number of its pixels in each."""
    rows, columns = np.nonzero(view.depth_m[look // 2 :: look, look // 2 :: look])
    rows, columns = look * rows + look // 2, look * columns + look // 2
    fine = geo_from_model.scale * view.depth_m[rows, columns] / view.pinhole.fx < coarsest_m
    position: FloatArray = geo_from_model.apply(view.points(rows[fine], columns[fine]))
    if not len(position):
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    _, first, count = np.unique(voxel_keys(position[:, :2], unit_m), return_index=True, return_counts=True)
    return np.floor(position[first, :2] / unit_m).astype(np.int64), count


def _fuse(
    candidates: _Candidates,
    views: SurfaceViews,
    geo_from_model: Similarity,
    square: _Square,
    settings: FusionSettings,
) -> SurfaceCloud:
    position, normal, pixel_m = candidates.position, _unit(candidates.normal), candidates.pixel_m
    support = views.support(geo_from_model.inverse().apply(position), normal @ geo_from_model.rotation)
    sigma_m = surface_sigma(support, pixel_m)
    moved = position + support.mean_normal_m[:, None] * normal
    with np.errstate(invalid="ignore"):
        good = (support.views >= settings.min_views) & (support.seen_through <= MOST_THROUGH * support.views)
        good &= (sigma_m < _RESOLVED * pixel_m) & square.covers(moved)
    rows = np.flatnonzero(good)
    position, normal, rgb, variance = voxel_means(
        settings.spacing_m, moved[rows], moved[rows], normal[rows], candidates.rgb[rows], sigma_m[rows] ** 2
    )
    return SurfaceCloud(position, _unit(normal), np.round(rgb).astype(np.uint8), np.sqrt(variance))


def surface_sigma(support: Support, pixel_m: FloatArray) -> FloatArray:
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
