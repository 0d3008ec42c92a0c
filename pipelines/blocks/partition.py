"""Division of the plane into cells of equal load: a kd-tree (doi 10.1145/361002.361007) that halves the load."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.scene.block_plan import BlockCell

_OUTER = 0.01  # of the load lies beyond either end of a cell's extent: a stray point makes no cell long
MOST_BLOCKS = 4096


def cells_of_number(points: FloatArray, load: FloatArray, count: int) -> list[BlockCell]:
    """Return cells that share the plane out among them, with loads as equal as the points allow.

    Args:
        points: (P, 2 or more) east and north, metres.
        load: (P,) of each point, ≥ 0.
        count: number of cells.

    Raises:
        DegenerateGeometryError: the points lie at fewer places than cells are wanted.
    """
    return _divided(BlockCell(), points, load, count)


def cells_that_fit(
    points: FloatArray, load: FloatArray, fits: Callable[[BlockCell, FloatArray], bool]
) -> list[BlockCell]:
    """Return cells that share the plane out among them, halved until each fits.

    Args:
        points: (P, 2 or more) east and north, metres.
        load: (P,) of each point, ≥ 0.
        fits: returns whether a cell, with its extent (2,) in metres, is small enough.

    Raises:
        DegenerateGeometryError: a cell that does not fit cannot be cut, or there would be more than 4096.
    """
    waiting, done = [BlockCell()], list[BlockCell]()
    while waiting:
        cell = waiting.pop()
        inside = cell.contains(points)
        if fits(cell, extent_of(points[inside], load[inside])):
            done.append(cell)
        else:
            waiting += reversed(_halves(cell, points[inside], load[inside], 0.5))
        if len(waiting) + len(done) > MOST_BLOCKS:
            raise DegenerateGeometryError(
                f"more than {MOST_BLOCKS} blocks would be needed: give a smaller --max-gaussians, a smaller "
                "--max-image-size or workers with more memory (--block-memory)"
            )
    return done


def extent_of(points: FloatArray, load: FloatArray) -> FloatArray:
    """Return the extent (2,) in metres, east and north, in which most of the load lies."""
    if not len(points):
        return np.zeros(2)
    ends = [[_quantile(points[:, axis], load, share) for share in (_OUTER, 1 - _OUTER)] for axis in (0, 1)]
    return np.array([high - low for low, high in ends])


def _divided(cell: BlockCell, points: FloatArray, load: FloatArray, count: int) -> list[BlockCell]:
    if count == 1:
        return [cell]
    inside = cell.contains(points)
    below, above = _halves(cell, points[inside], load[inside], (count // 2) / count)
    return [*_divided(below, points, load, count // 2), *_divided(above, points, load, count - count // 2)]


def _halves(cell: BlockCell, points: FloatArray, load: FloatArray, share: float) -> tuple[BlockCell, BlockCell]:
    """Return the cell cut across its longer axis, with a share of the load in its first part."""
    for axis in np.argsort(-extent_of(points, load), kind="stable"):
        values = points[:, axis]
        if len(values) and values.max() > values.min():
            # No part may be empty: a cut at the lowest value has nothing below it.
            place = max(_quantile(values, load, share), float(np.nextafter(values.min(), np.inf)))
            return cell.cut(int(axis), min(place, float(values.max())))
    raise DegenerateGeometryError("the survey has too few points for so many blocks: give fewer --blocks")


def _quantile(values: FloatArray, load: FloatArray, share: float) -> float:
    """Return the value below which a share of the load lies."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(load[order])
    place = int(np.searchsorted(summed, share * summed[-1]))
    return float(values[order[min(place, len(order) - 1)]])
