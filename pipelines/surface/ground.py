"""The ground below a cloud of the surface: a cloth that falls on the cloud turned upside down.

After Zhang et al. (doi 10.3390/rs8060501), by the authors' library. Houses, trees and cars are what the cloth does
not reach into; below them the ground is a plane through the nearest ground around.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_erosion, distance_transform_edt, map_coordinates

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.extras import require
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.footprints import rows_by_square

_CLOTH_M = 1.0  # least distance of the cloth's knots: finer ones sag into the roofs of sheds
_CLOTH_SPACINGS = 4.0  # the same, in spacings of the points
# Height of a point above the cloth up to which it is ground, in metres and in spacings: on simulated flights, one
# ground point in a thousand is missed and four others in a thousand are taken.
_ABOVE_M, _ABOVE_SPACINGS = 0.3, 1.0
_RIGIDNESS, _ITERATIONS = 2, 500  # for relief with slopes, as the paper advises
_LEVEL = 0.7  # least vertical part of a normal: slopes up to 45°
_TILE_M, _MARGIN_M = 400.0, 60.0  # the margin is wider than a house
_MOST_KNOTS = 2_000_000
_PATCH_M = 8.0  # from the nearest inner cell, beyond which small patches of known ground count too


@dataclass(frozen=True)
class GroundModel:
    """Ground over a grid in plan of `geo`: rows from the south, columns from the west.

    Attributes:
        corner: south-western corner of the first cell, east and north.
        height: (R, C) in `geo`, in the middle of each cell.
        gap_m: (R, C) distance to the nearest cell with ground points; 0 in these.
        limit_m: height above the ground, up or down, within which a point is ground.
        bend: distances (L,) in metres, and mean square error (L,) of a straight line over a gap so wide, halved.
    """

    corner: FloatArray
    cell_m: float
    height: FloatArray
    gap_m: FloatArray
    limit_m: float
    bend: tuple[FloatArray, FloatArray]

    def nodes(self) -> FloatArray:
        """Return the middles (R · C, 3) of the cells in `geo`."""
        rows, columns = self.height.shape
        east, north = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        plan = self.corner + self.cell_m * np.column_stack([east.ravel(), north.ravel()])
        return np.column_stack([plan, self.height.ravel()])

    def interpolated(self, values: FloatArray, plan: FloatArray) -> FloatArray:
        """Return values of cells (R, C) at places (N, 2), linearly between the middles of cells."""
        place = (plan - self.corner) / self.cell_m - 0.5
        return np.asarray(map_coordinates(values, place.T[::-1], order=1, mode="nearest"))

    def is_ground(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 3) in `geo` lie on the ground."""
        return np.asarray(np.abs(points[:, 2] - self.interpolated(self.height, points[:, :2])) <= self.limit_m)

    def bridged_variance(self, gap_m: FloatArray) -> FloatArray:
        """Return the variance of the ground at distances (…) from the nearest ground point.

        The foot of what stands there hides in the points within half of `limit_m`, evenly.
        """
        return np.interp(gap_m, *self.bend) + np.where(gap_m > 0, self.limit_m**2 / 12, 0.0)


def terrain_of(points: FloatArray, normal: FloatArray, spacing_m: float) -> GroundModel:
    """Return the ground of a surface's points (N, 3) and normals (N, 3) in `geo`, about one a `spacing_m`.

    Walls hold the cloth up: points on what is steep take no part, nor do cells in which something stands.

    Raises:
        BackendUnavailableError: the extra `terrain` is missing.
        DegenerateGeometryError: there is no ground among them.
    """
    require("terrain")
    cell_m = max(_CLOTH_M, _CLOTH_SPACINGS * spacing_m)
    limit_m = max(_ABOVE_M, _ABOVE_SPACINGS * spacing_m)
    points = points[np.abs(normal[:, 2]) >= _LEVEL]
    on_cloth = np.zeros(len(points), dtype=bool)
    on_cloth[_on_cloth(points, cell_m, limit_m)] = True
    message = "The surface has no ground that can be told from what stands on it."
    no_ground = DegenerateGeometryError("no-ground", message)
    if on_cloth.sum() < 4:
        raise no_ground
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cell_m = max(cell_m, float(np.sqrt(np.prod(high - low) / _MOST_KNOTS)))
    columns, rows = (np.floor((high - low) / cell_m).astype(int) + 1).tolist()
    column, row = np.floor((points[:, :2] - low) / cell_m).astype(int).T
    cell = row * columns + column
    count, above = (np.bincount(cell[chosen], minlength=rows * columns) for chosen in (on_cloth, ~on_cloth))
    is_known = (count > 0) & (above == 0)
    if is_known.sum() < 4:
        is_known = count > 0
    inner = _inner(is_known.reshape(rows, columns), _PATCH_M / cell_m).ravel()
    if _spans_plane(inner, columns):  # not those of a narrow street
        is_known = inner
    elif not _spans_plane(is_known, columns):
        raise no_ground
    ground, cell, known = points[on_cloth], cell[on_cloth], np.flatnonzero(is_known)
    mean = np.column_stack([np.bincount(cell, axis, rows * columns)[known] / count[known] for axis in ground.T])
    terrain = GroundModel(low, cell_m, np.zeros((rows, columns)), np.zeros((rows, columns)), limit_m, (low, low))
    middle = terrain.nodes()[:, :2]
    height = LinearNDInterpolator(mean[:, :2], mean[:, 2])(middle)
    outside = ~np.isfinite(height)
    height[outside] = NearestNDInterpolator(mean[:, :2], mean[:, 2])(middle[outside])
    height, is_known = height.reshape(rows, columns), is_known.reshape(rows, columns)
    gap_m = cell_m * distance_transform_edt(~is_known)
    return GroundModel(low, cell_m, height, gap_m, limit_m, _bend(np.where(is_known, height, np.nan), cell_m))


def _inner(is_known: BoolArray, apart: float) -> BoolArray:
    """Return the known cells (R, C) whose neighbours are all known, and all that are further `apart` from these.

    Beside what hides the ground, few views see it, and heights are blends of both: 0.05 to 0.1 m too high.
    """
    inner = binary_erosion(is_known, np.ones((3, 3)), border_value=1)
    if not inner.any():
        return is_known
    return np.asarray(inner | (is_known & (distance_transform_edt(~inner) > apart)))


def _spans_plane(cells: BoolArray, columns: int) -> bool:
    place = np.column_stack(np.divmod(np.flatnonzero(cells), columns))
    return len(place) > 2 and int(np.linalg.matrix_rank(place - place.mean(axis=0))) == 2


def _on_cloth(points: FloatArray, knot_m: float, limit_m: float) -> IntArray:
    """Return the rows of the points on the cloth, tile by tile of the plan."""
    import CSF

    chosen, plan = [], points[:, :2] - points[:, :2].min(axis=0, initial=np.inf)
    for square, rows in rows_by_square(plan, _TILE_M):
        low = _TILE_M * np.array(square) - _MARGIN_M
        near = ((plan >= low) & (plan <= low + _TILE_M + 2 * _MARGIN_M)).all(axis=1)
        around = np.flatnonzero(near)
        cloth = CSF.CSF()
        cloth.params.bSloopSmooth = True  # without it, one in seven ground points on a slope of 15 % is missed
        cloth.params.cloth_resolution, cloth.params.class_threshold = knot_m, limit_m
        cloth.params.rigidness, cloth.params.interations = _RIGIDNESS, _ITERATIONS
        ground, others = CSF.VecInt(), CSF.VecInt()
        with _silenced():
            cloth.setPointCloud(points[around])
            cloth.do_filtering(ground, others, False)
        chosen.append(np.intersect1d(around[np.array(ground, dtype=np.int64)], rows))
    return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.int64)


@contextmanager
def _silenced() -> Iterator[None]:
    """Keep what a library writes to stdout out of the results there."""
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _bend(height: FloatArray, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Return half gaps (L,) in metres, and the mean square error (L,) of straight lines over them."""
    gaps, squares = [0.0], [0.0]
    for lag in 2 ** np.arange(int(np.log2(max(min(height.shape) / 2, 1))) + 1):
        for turned in (height, height.T):
            error = turned[lag:-lag] - (turned[: -2 * lag] + turned[2 * lag :]) / 2
            known = error[np.isfinite(error)]
            if len(known):
                gaps.append(float(lag) * cell_m)
                squares.append(max(float(np.mean(known**2)), squares[-1]))
    return np.array(gaps), np.array(squares)
