"""Windows in which large photographs are trained, so that memory and time of an iteration stay bounded."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import Window

_SHIFT = 1 / 8  # of a window's side: cuts move to either side by up to this, so that no pixel is always beside one


@dataclass(frozen=True)
class Crops:
    """Windows of photographs, as a grid of equal cells whose inner cuts are shifted by chance in each round.

    Each round of visits to a photograph shows all of its windows once, in an order by chance: each pixel is seen
    equally often.

    Attributes:
        size_px: a photograph with more pixels than a square of this side is seen in windows of so many pixels.
        seed: of shifts and orders.
    """

    size_px: int
    seed: int = 0

    def grid(self, width: int, height: int) -> tuple[int, int]:
        """Return the columns and rows of cells that are small enough, with the shortest cuts."""
        most_px, grids = self.size_px**2, []
        for columns in range(1, -(-width * height // most_px) + 1):
            cell_height = most_px // -(-width // columns)
            if cell_height > 0:
                grids.append((columns, -(-height // min(cell_height, height))))
        return min(grids, key=lambda grid: (grid[0] - 1) * height + (grid[1] - 1) * width)

    def count(self, width: int, height: int) -> int:
        """Return the number of windows in which an image is seen."""
        columns, rows = self.grid(width, height)
        return columns * rows

    def largest_of(self, camera: Pinhole) -> Pinhole:
        """Return a camera of the size of the largest window of an image."""
        columns, rows = self.grid(camera.width, camera.height)
        return Window(0, 0, _longest(camera.width, columns), _longest(camera.height, rows)).of(camera)

    def shrink(self, width: int, height: int) -> int:
        """Return the least factor by which an image is to be shrunken, to be seen as a whole."""
        shrink = 1
        while (width // shrink) * (height // shrink) > self.size_px**2:
            shrink += 1
        return shrink

    def windows(self, index: int, whole: Window, turn: int) -> list[Window]:
        """Return the windows of one round, which cover `whole` without overlap.

        Args:
            index: of the photograph.
            whole: part of the photograph to cover.
            turn: number of the round, from 0.
        """
        random = np.random.default_rng([self.seed, index, turn])
        columns, rows = self.grid(whole.width, whole.height)
        across, down = (
            _cuts(side, cells, random) for side, cells in ((whole.width, columns), (whole.height, rows))
        )
        cells = [
            Window(whole.left + left, whole.top + top, right - left, bottom - top)
            for (top, bottom), (left, right) in product(pairwise(down), pairwise(across))
        ]
        return [cells[place] for place in random.permutation(len(cells))]


def _cuts(side: int, cells: int, random: np.random.Generator) -> list[int]:
    shift = random.uniform(-_SHIFT, _SHIFT)
    return [0, *(round((cell + shift) * side / cells) for cell in range(1, cells)), side]


def _longest(side: int, cells: int) -> int:
    return side if cells == 1 else min(side, int(np.ceil((1 + _SHIFT) * side / cells)) + 1)
