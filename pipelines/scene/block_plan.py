"""Product of the division of a survey into blocks: cells in `model`, and what each block trains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipelines.core.errors import InputError
from pipelines.core.products import ImageName, Product
from pipelines.core.types import BoolArray, FloatArray

Bound = tuple[float | None, float | None]


class BlockCell(Product):
    """Vertical prism in `model`, half-open: a point on its western or southern side is inside.

    Attributes:
        low: east and north of the sides in the west and south, metres; None: without end.
        high: of the sides in the east and north.
    """

    low: Bound = (None, None)
    high: Bound = (None, None)

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which of points (N, 2 or more), east first, lie inside: a mask (N,)."""
        inside = np.ones(len(points), dtype=bool)
        for axis in (0, 1):
            low, high = self.low[axis], self.high[axis]
            if low is not None:
                inside &= points[:, axis] >= low
            if high is not None:
                inside &= points[:, axis] < high
        return inside

    def widened(self, margin_m: ArrayLike) -> BlockCell:
        """Return the cell with each side moved outwards by the margin (2,), east and north."""
        margin = np.asarray(margin_m, dtype=np.float64)
        return BlockCell(low=_moved(self.low, -margin), high=_moved(self.high, margin))

    def cut(self, axis: int, place: float) -> tuple[BlockCell, BlockCell]:
        """Return the parts below and from a place on an axis (0: east, 1: north)."""
        below, above = list(self.high), list(self.low)
        below[axis] = above[axis] = place
        return BlockCell(low=self.low, high=(below[0], below[1])), BlockCell(
            low=(above[0], above[1]), high=self.high
        )

    def common(self, other: BlockCell) -> BlockCell | None:
        """Return the part that two cells have in common; None: they have none."""
        if not self.meets(other):
            return None
        low = [_outermost(self.low[axis], other.low[axis], max) for axis in (0, 1)]
        high = [_outermost(self.high[axis], other.high[axis], min) for axis in (0, 1)]
        return BlockCell(low=(low[0], low[1]), high=(high[0], high[1]))

    def meets(self, other: BlockCell) -> bool:
        """Return whether the cells have points in common."""
        bounds = [
            (low, high)
            for axis in (0, 1)
            for low, high in ((self.low[axis], other.high[axis]), (other.low[axis], self.high[axis]))
        ]
        return all(low is None or high is None or low < high for low, high in bounds)


class PlannedBlock(Product):
    """Block of the plan.

    Attributes:
        id: number, from 0.
        cell: of the Gaussians that the merged model takes from this block.
        margin_m: width of the overlap beyond the cell, east and north.
        cameras: training images that see the block.
        share: of the survey's load that lies in the cell.
        gaussians: limit of the Gaussians in training, those of the overlap among them.
        visible: predicted number of the block's Gaussians in a view.
        view_px: predicted number of the block's pixels in a view.
        peak_bytes: predicted peak of the memory of the process that trains it.
    """

    id: int = Field(ge=0)
    cell: BlockCell
    margin_m: tuple[float, float]
    cameras: tuple[ImageName, ...]
    share: float = Field(ge=0, le=1)
    gaussians: int = Field(gt=0)
    visible: float = Field(ge=0)
    view_px: float = Field(ge=0)
    peak_bytes: int = Field(ge=0)

    @property
    def region(self) -> BlockCell:
        """Cell with its overlap: where the block is trained."""
        return self.cell.widened(self.margin_m)


class BlockPlan(Product):
    """Division of a survey into blocks, whose cells share the plane out among them.

    Attributes:
        format_version: version of the format.
        blocks: in the order of their numbers.
        gaussians: limit of the Gaussians of the whole.
        scaffold_gaussians: limit of the Gaussians of the coarse model of the whole.
        photographs: number of training images.
        memory_bytes: of a worker, for which the plan was made; None: the number of blocks was given.
    """

    format_version: Literal[1] = 1
    blocks: tuple[PlannedBlock, ...] = Field(min_length=1)
    gaussians: int
    scaffold_gaussians: int
    photographs: int
    memory_bytes: int | None = None

    def block(self, number: int) -> PlannedBlock:
        """Return the block of a number.

        Raises:
            InputError: there is no such block.
        """
        for block in self.blocks:
            if block.id == number:
                return block
        raise InputError(f"there is no block {number}: the plan has 0 … {len(self.blocks) - 1}", field="--id")


def _outermost(one: float | None, other: float | None, choose: Callable[[float, float], float]) -> float | None:
    """Return one of two bounds; None has no end."""
    if one is None or other is None:
        return other if one is None else one
    return choose(one, other)


def _moved(bound: Bound, by: FloatArray) -> Bound:
    east, north = (None if value is None else value + float(step) for value, step in zip(bound, by, strict=True))
    return east, north
