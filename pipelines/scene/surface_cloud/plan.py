"""Plan of the work: squares whose candidates fit into the memory, and the views that show each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.similarity import Similarity
from pipelines.scene.surface_cloud.candidates import Square
from pipelines.scene.surface_views import SurfaceView, SurfaceViews

# Memory: candidates of one square, of about 100 bytes each, with the copies that sorting them makes.
_MOST_CANDIDATES = 4_000_000
_LOOK_PX = 8  # between the pixels from which sizes and extent are estimated
_LEAST_VOXELS = 16  # along the side of a square


@dataclass(frozen=True)
class PlannedSquare:
    """Square of the plan with the numbers of the views that may show it."""

    square: Square
    views: IntArray


def pixel_on_surface_m(views: SurfaceViews, geo_from_model: Similarity) -> float:
    """Return the median width of a pixel on the surface in metres, over the views' medians.

    Raises:
        DegenerateGeometryError: no view shows a surface.
    """
    medians = []
    for view in map(views.view, range(len(views))):
        depth = view.depth_m[::_LOOK_PX, ::_LOOK_PX]
        if (depth > 0).any():
            medians.append(geo_from_model.scale * float(np.median(depth[depth > 0])) / view.pinhole.fx)
    if not medians:
        raise DegenerateGeometryError(
            f"none of {len(views)} training views shows a surface on which the others agree: train longer, or with "
            "--dense"
        )
    return float(np.median(medians))


def plan_squares(
    views: SurfaceViews, geo_from_model: Similarity, spacing_m: float, coarsest_m: float, step: int
) -> list[PlannedSquare]:
    """Return the squares that hold the surface, none with more candidates than memory has room for.

    Args:
        views: surface of the training views.
        geo_from_model: similarity.
        spacing_m: side of the voxels; squares consist of whole voxels, so that no voxel is cut.
        coarsest_m: pixels that are wider on the surface do not count.
        step: every `step`-th row and column of a view gives candidates.
    """
    look = max(_LOOK_PX, step)
    unit_m = _LEAST_VOXELS * spacing_m
    shown = [_cells(views.view(number), geo_from_model, unit_m, coarsest_m, look) for number in range(len(views))]
    cells = np.concatenate([cell for cell, _ in shown]) if shown else np.zeros((0, 2), np.int64)
    if not len(cells):
        return []
    counts = np.concatenate([count for _, count in shown])
    owner = np.repeat(np.arange(len(shown)), [len(cell) for cell, _ in shown])
    candidates = counts * (look / step) ** 2  # what the pixels of the look stand for
    level = int(np.ptp(cells, axis=0).max()).bit_length()
    while True:
        squares, member = np.unique(cells >> level, axis=0, return_inverse=True)
        if level == 0 or np.bincount(member.ravel(), candidates).max() <= _MOST_CANDIDATES:
            break
        level -= 1
    side_m = float(unit_m * 2**level)
    # A margin around a square is narrower than a cell: views of the neighbouring cells may show it too.
    low, high = ((cells - 1) >> level, (cells + 1) >> level)
    return [
        PlannedSquare(
            Square((float(place[0] * side_m), float(place[1] * side_m)), side_m),
            np.unique(owner[((low <= place) & (place <= high)).all(axis=1)]),
        )
        for place in squares
    ]


def _cells(
    view: SurfaceView, geo_from_model: Similarity, unit_m: float, coarsest_m: float, look: int
) -> tuple[IntArray, IntArray]:
    """Return the cells (K, 2) of the plan, of `unit_m`, that a view shows, and the number of its pixels in each."""
    rows, columns = np.nonzero(view.depth_m[look // 2 :: look, look // 2 :: look])
    rows, columns = look * rows + look // 2, look * columns + look // 2
    fine = geo_from_model.scale * view.depth_m[rows, columns] / view.pinhole.fx < coarsest_m
    position: FloatArray = geo_from_model.apply(view.points(rows[fine], columns[fine]))
    cell, count = np.unique(np.floor(position[:, :2] / unit_m).astype(np.int64), axis=0, return_counts=True)
    return cell, count
