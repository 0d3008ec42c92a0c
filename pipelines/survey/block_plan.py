"""Division of a survey into blocks: cells in `model`, what each block trains, and the records of what was trained.

The scaffold is the coarse model of the whole survey that stands in for the world around a block.
"""

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

    `low` and `high` are the sides, east and north in metres; None: without end.
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
        """Return the parts below and from a coordinate in metres on an axis (0: east, 1: north)."""
        below, above = list(self.high), list(self.low)
        below[axis] = above[axis] = place
        return BlockCell(low=self.low, high=(below[0], below[1])), BlockCell(
            low=(above[0], above[1]), high=self.high
        )

    def common(self, other: BlockCell) -> BlockCell | None:
        """Return the part that two cells have in common; None: they have none."""
        if not self.meets(other):
            return None
        low = [_chosen_bound(self.low[axis], other.low[axis], max) for axis in (0, 1)]
        high = [_chosen_bound(self.high[axis], other.high[axis], min) for axis in (0, 1)]
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
        cell: where the merged model takes its Gaussians from this block.
        margin_m: width of the overlap beyond the cell, east and north.
        cameras: training images that see the block.
        share: of the survey's load that lies in the cell.
        gaussians: limit in training, those of the overlap among them.
        visible, view_px: predicted numbers of the block's Gaussians and pixels in a view.
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
    """Division of a survey into blocks, whose cells divide the plane.

    Attributes:
        gaussians, scaffold_gaussians: limits for the whole, and for the coarse model of the whole.
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
        raise InputError(
            "unknown-block",
            f"There is no block {number}; the plan has blocks 0 to {len(self.blocks) - 1}.",
            field="--id",
        )


def _chosen_bound(one: float | None, other: float | None, choose: Callable[[list[float]], float]) -> float | None:
    """Return the bound that `choose` (min or max) takes of two; None is no bound."""
    known = [bound for bound in (one, other) if bound is not None]
    return choose(known) if known else None


def _moved(bound: Bound, by: FloatArray) -> Bound:
    east, north = (None if value is None else value + float(step) for value, step in zip(bound, by, strict=True))
    return east, north


class BlockTraining(Product):
    """Training of one block, as measured: for the merged product, and to fit the model of time and memory.

    Attributes:
        gaussians_in_cell: those that the merged model takes.
        seconds: of the iterations.
        processor_s: of all processors together, for one iteration; None: unknown.
        mean_gaussians, mean_visible: mean numbers during the training, and in a view, surroundings among these.
        mean_px: mean number of the pixels of a view that were rendered.
        surroundings: number of frozen Gaussians around the block, of the scaffold.
        peak_bytes: peak of the process's memory; None: not measured on this system.
        train_psnr: mean of the last iterations, decibels.
    """

    id: int = Field(ge=0)
    iterations: int
    gaussians: int
    gaussians_in_cell: int
    photographs: int
    seconds: float
    processor_s: float | None
    mean_gaussians: float
    mean_visible: float
    mean_px: float
    surroundings: int
    peak_bytes: int | None
    threads: int
    backend: Literal["cpu", "cuda"]
    train_psnr: float


class Seam(Product):
    """Disagreement of two neighbouring blocks in their overlap, which both have trained.

    Attributes:
        depth_median_m: median of the difference in depth, second less first.
        depth_nmad_m: 1.4826 × the median absolute deviation of the differences in depth.
        colour_rms: root mean square of the differences in colour, of colours from 0 to 1.
    """

    blocks: tuple[int, int]
    views: int
    pixels: int
    depth_median_m: float
    depth_nmad_m: float
    colour_rms: float


class MergedBlock(Product):
    """Block of a merged model: its cell in `model`, and its training."""

    cell: BlockCell
    training: BlockTraining


class BlockRecord(Product):
    """Record of a model that was trained in blocks, with the seams whose overlap some view shows."""

    format_version: Literal[1] = 1
    blocks: tuple[MergedBlock, ...]
    seams: tuple[Seam, ...]


# Number of the scaffold's Gaussians: share of the survey's limit, least and largest number.
_SCAFFOLD_SHARE, _LEAST_SCAFFOLD, _MOST_SCAFFOLD = 0.1, 2_000, 200_000
SCAFFOLD_IMAGE_PX = 320  # longest side of the photographs that it is trained on, at most


def scaffold_gaussians(most: int) -> int:
    """Return the limit of the scaffold's Gaussians for a survey with a limit of `most`."""
    return min(max(int(_SCAFFOLD_SHARE * most), _LEAST_SCAFFOLD), _MOST_SCAFFOLD, most)
