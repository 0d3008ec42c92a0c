"""Ground beneath the scene: what a viewer sees through a gap in the model.

No photograph shows the foot of some wall, or what stands in a narrow yard. With nothing behind it, such a gap is
a black hole, and whatever Gaussian is near grows over it. A sheet of flat Gaussians in the colours of the ground,
below all points, ends each ray that looks down. It lies only where a known surface hides it from photographs, or
none looks: elsewhere photographs decide what is there, and the sheet would count as a surface.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray
from pipelines.scene.scene import Scene
from pipelines.train.surface import SceneSurface, SurfacePoints

_STRAY = 0.01  # of the points at either end of an axis lie outside of the sheet
_LOW = 0.05  # of the points of a cell may lie below it: stereo errs
_ROOF_REACH_M = 20.0  # a cell whose points lie on a roof has ground within this distance
_DEPTH = 0.5  # below the ground, in cells
_LOOKED_AT = 16  # points near a place whose mean colour it has
_HIDDEN_SHARE = 0.5  # of the views that face a place: some know no depth before it
_COLOUR_POINTS = 40_000
_UPRIGHT = 3.0  # factor on heights, when points near a place of the sheet are looked for: not those of roofs


def underlay(points: SurfacePoints, count: int, seed: int) -> tuple[SurfacePoints, float]:
    """Return places on a sheet beneath the points, on a square grid with z up, and the side of its cells in metres.

    Each place lies half a side below the lowest ground that points show within 20 m, smoothed but never above them.

    Args:
        points: of the scene, in `model`, in metres; at least one.
        count: limit of the places; 0: none.
        seed: of the choice of points for the colours.
    """
    place = points.point_in_model
    low, high = np.quantile(place[:, :2], [_STRAY, 1 - _STRAY], axis=0)
    side_m = float(np.sqrt(np.prod(high - low) / max(count, 1)))
    if count < 1 or not side_m > 0:
        return points.part(np.zeros(0, dtype=np.int64)), 0.0
    columns, rows = (int(n) for n in np.maximum((high - low) // side_m, 1))
    cell = np.floor((place[:, :2] - low) / side_m).astype(np.int64)
    inside = np.flatnonzero(((cell >= 0) & (cell < (columns, rows))).all(axis=1))
    lowest = _low_heights(cell[inside, 1] * columns + cell[inside, 0], place[inside, 2], columns * rows)
    height = _ground(lowest.reshape(rows, columns), side_m) - _DEPTH * side_m
    row, column = np.divmod(np.arange(columns * rows), columns)
    sheet = np.column_stack([low + side_m * (np.stack([column, row], axis=1) + 0.5), height.ravel()])[:count]
    normal = np.broadcast_to([0.0, 0.0, 1.0], sheet.shape)
    return SurfacePoints(sheet, _colours(points, sheet, seed), normal), side_m


def hidden(points: FloatArray, scene: Scene, surface: SceneSurface) -> BoolArray:
    """Return which of points (K, 3) in `model` lie behind known depths in most of the training views facing them.

    A point that no view faces is hidden, too.
    """
    facing, behind = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    for index in map(int, scene.train):
        camera = surface.camera(index)
        in_cam = (points - scene.poses.cam_center_in_model[index]) @ scene.poses.cam_from_model[index].T
        xy = camera.project(in_cam)
        shown = np.flatnonzero(camera.holds(xy))
        column, row = xy[shown].astype(np.int64).T
        depth = surface.depth(index)[row, column]
        facing[shown] += 1
        behind[shown] += (depth > 0) & (depth < in_cam[shown, 2])
    return np.asarray(behind >= _HIDDEN_SHARE * facing)


def _low_heights(cell: IntArray, height: FloatArray, count: int) -> FloatArray:
    """Return the height (count,) of each cell that few of its points lie below; NaN without a point."""
    order = np.lexsort((height, cell))
    number = np.bincount(cell, minlength=count)
    first = np.cumsum(number) - number
    low = np.full(count, np.nan)
    filled = number > 0
    low[filled] = height[order[(first + (_LOW * number).astype(np.int64))[filled]]]
    return low


def _ground(lowest: FloatArray, side_m: float) -> FloatArray:
    """Return the heights (rows, columns) of ground, given the lowest points of cells; NaN: no point lies there."""
    nearest = ndimage.distance_transform_edt(np.isnan(lowest), return_distances=False, return_indices=True)
    known = lowest[tuple(nearest)]
    reach = 2 * int(np.ceil(_ROOF_REACH_M / side_m)) + 1
    smooth = ndimage.uniform_filter(ndimage.minimum_filter(known, size=reach, mode="nearest"), 3, mode="nearest")
    return np.asarray(np.minimum(smooth, known))


def _colours(points: SurfacePoints, sheet: FloatArray, seed: int) -> ByteArray:
    """Return the mean colour (K, 3) of the points near each place of the sheet."""
    drawn = np.random.default_rng(seed).permutation(len(points.rgb))[:_COLOUR_POINTS]
    stretch = np.array([1.0, 1.0, _UPRIGHT])
    tree = cKDTree(points.point_in_model[drawn] * stretch)
    _, near = tree.query(sheet * stretch, k=min(_LOOKED_AT, len(drawn)))
    return np.asarray(points.rgb[drawn][near.reshape(len(sheet), -1)].mean(axis=1).round().astype(np.uint8))
