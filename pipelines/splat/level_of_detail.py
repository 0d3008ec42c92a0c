"""Levels of detail: a tree of tiles, each of which shows its part of the splat with few enough Gaussians.

Leaves hold the Gaussians themselves, each in exactly one leaf of an octree. A tile above merges what its children
show, by the cells of a grid, with moments kept (`merging`). Its cells are at least twice as large as theirs: a
viewer shows it from afar, and its children from near. Above the octree, further levels become coarser until a few
hundred Gaussians show the whole.

Gaussians far outside the scene, and those as large as it, form a tree of their own: in the scene's tree they would
make the boxes of its tiles so large that a viewer always stands inside, and never sees a coarse level.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.splat_ply import SplatArrays
from pipelines.splat.merging import Mixture, bounds_of, drawn, merged, mixture_of
from pipelines.splat.morton import BITS, morton_codes

# Viewers replace a tile whose error exceeds 16 pixels by default (CesiumJS). With this factor, cells are then drawn
# two to four pixels wide, and for viewers that demand 8 pixels still one to two.
_ERROR_CELLS = 4.0
_OVERVIEW = 256  # Gaussians of the coarsest level
_LEAST_REDUCTION = 2
_INNER = (0.01, 0.99)  # quantiles of the positions between which the scene lies
_OUTSKIRTS = 1.0  # the scene reaches beyond them by this part of their distance
_LEAST_EDGE_M = 1e-6
_GIANT = 0.1  # size of a Gaussian in parts of that distance


class WriteTile(Protocol):
    """Receiver of the contents of tiles, children before their parents."""

    def __call__(self, name: str, content: SplatArrays, *, is_leaf: bool) -> None:
        """Keep the content of a tile."""


@dataclass(frozen=True)
class DetailTile:
    """Tile of the tree.

    Attributes:
        name: unique, of letters and digits.
        count: number of Gaussians that it shows.
        error_m: size of the details that it does not show; 0 for a leaf.
        bounds: (2, 3) box of its Gaussians up to 3 σ, and of its children.
        children: tiles that together replace it.
    """

    name: str
    count: int
    error_m: float
    bounds: FloatArray
    children: tuple[DetailTile, ...] = ()

    def all(self) -> Iterator[DetailTile]:
        """Yield the tile and all tiles below it."""
        yield self
        for child in self.children:
            yield from child.all()


def build_tiles(splat: SplatArrays, largest_tile: int, write: WriteTile) -> DetailTile:
    """Return the root of the tree of tiles, and hand the content of each tile to `write`.

    Memory: that of the Gaussians, and of the contents of a tile and its children.

    Args:
        splat: N ≥ 1 Gaussians with finite values.
        largest_tile: largest number of Gaussians in a tile.
        write: receives the contents.
    """
    outside = _outskirts(splat)
    builder = _Builder(splat, largest_tile, write)
    parts = [("s", np.flatnonzero(~outside)), ("f", np.flatnonzero(outside))]
    trees = [_Tree(rows, builder).overview(name) for name, rows in parts if len(rows)]
    if len(trees) == 1:
        return trees[0].tile
    both = Mixture.concatenate([tree.curve.mixture for tree in trees])
    return builder.parent("r", trees, _Curve.through(both)).tile


def best_cut(root: DetailTile, most: int) -> list[DetailTile]:
    """Return tiles that together show everything, in as much detail as a number of Gaussians allows.

    The tile with the largest error is replaced by its children as long as there is room.
    """
    shown, total = [root], root.count
    while True:
        coarsest = max(shown, key=lambda tile: tile.error_m)
        total += sum(child.count for child in coarsest.children) - coarsest.count
        if total > most or not coarsest.children:
            return shown
        shown.remove(coarsest)
        shown += coarsest.children


def _outskirts(splat: SplatArrays) -> BoolArray:
    """Return which Gaussians (N,) are no part of the scene itself: far away, or as large as it."""
    low, high = np.quantile(splat.means, _INNER, axis=0)
    extent = float((high - low).max())
    margin = _OUTSKIRTS * extent
    away = ((splat.means < low - margin) | (splat.means > high + margin)).any(axis=1)
    outside: BoolArray = away | (splat.log_scales.max(axis=1) > np.log(max(_GIANT * extent, _LEAST_EDGE_M)))
    return outside if not outside.all() else np.zeros(len(splat), dtype=bool)


def _codes(points: ArrayLike) -> tuple[IntArray, float]:
    codes, edge_m = morton_codes(torch.as_tensor(points, dtype=torch.float64))
    return codes.numpy(), max(edge_m, _LEAST_EDGE_M)


@dataclass(frozen=True)
class _Curve:
    """Moments of Gaussians, sorted along a Z-order curve: a cell is a range of rows.

    Attributes:
        mixture: N rows.
        codes: (N,) ascending places along the curve.
        edge_m: edge of the curve's smallest cells; those of level k are 2^k times as large.
    """

    mixture: Mixture
    codes: IntArray
    edge_m: float

    @staticmethod
    def through(mixture: Mixture) -> _Curve:
        """Return rows sorted along a curve through their means."""
        codes, edge_m = _codes(mixture.means)
        order = np.argsort(codes, kind="stable")
        return _Curve(mixture.select(order), codes[order], edge_m)

    def level_of(self, cell_m: float, most: int) -> int:
        """Return the level of the least cells, of this edge at least, that leave no more than so many Gaussians."""
        level = max(0, math.ceil(math.log2(max(cell_m / self.edge_m, 1.0)) - 1e-6))
        sizes_m = self.mixture.sizes_m
        while True:
            small = sizes_m <= self.cell_m(level)
            cells = self._cells(small, level)
            if (~small).sum() + (np.diff(cells) != 0).sum() + (len(cells) > 0) <= most:
                return level
            level += 1

    def merged(self, level: int) -> _Curve:
        """Return the rows merged in cells of a level; Gaussians larger than a cell stay alone."""
        small = self.mixture.sizes_m <= self.cell_m(level)
        rows, alone = np.flatnonzero(small), np.flatnonzero(~small)
        if len(rows) == 0:
            return self
        starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(self._cells(small, level)))])
        mixture = Mixture.concatenate([merged(self.mixture.select(rows), starts), self.mixture.select(alone)])
        codes = np.concatenate([self.codes[rows][starts], self.codes[alone]])
        order = np.argsort(codes, kind="stable")
        return _Curve(mixture.select(order), codes[order], self.edge_m)

    def cell_m(self, level: int) -> float:
        """Return the edge of the cells of a level."""
        return self.edge_m * 2.0**level

    def _cells(self, rows: BoolArray, level: int) -> IntArray:
        return self.codes[rows] >> min(3 * level, 63)


@dataclass(frozen=True)
class _Shown:
    """Tile, with the moments of what it shows and the edge of the cells that were merged; 0 for a leaf."""

    tile: DetailTile
    curve: _Curve
    cell_m: float


@dataclass(frozen=True)
class _Builder:
    """Maker of tiles.

    Attributes:
        splat: all Gaussians.
        largest_tile: largest number of Gaussians in a tile.
        write: receives the contents.
    """

    splat: SplatArrays
    largest_tile: int
    write: WriteTile

    def leaf(self, name: str, rows: IntArray, codes: IntArray, edge_m: float) -> _Shown:
        """Return the leaf of some of the Gaussians."""
        content = self.splat.select(rows)
        self.write(name, content, is_leaf=True)
        mixture = mixture_of(content)
        tile = DetailTile(name, len(content), 0.0, bounds_of(mixture))
        return _Shown(tile, _Curve(mixture, codes, edge_m), 0.0)

    def parent(self, name: str, children: list[_Shown], curve: _Curve) -> _Shown:
        """Return the tile above children, with what they show, `curve`, merged in larger cells."""
        most = max(1, min(self.largest_tile, len(curve.codes) // _LEAST_REDUCTION))
        level = curve.level_of(2 * max(child.cell_m for child in children), most)
        shown, cell_m = curve.merged(level), curve.cell_m(level)
        content = drawn(shown.mixture, cell_m)
        self.write(name, content, is_leaf=False)
        boxes = np.stack([bounds_of(mixture_of(content)), *(child.tile.bounds for child in children)])
        bounds = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        below = tuple(child.tile for child in children)
        return _Shown(DetailTile(name, len(content), _ERROR_CELLS * cell_m, bounds, below), shown, cell_m)


class _Tree:
    """Octree of some of the Gaussians, and the levels above it."""

    def __init__(self, rows: IntArray, builder: _Builder) -> None:
        codes, self._edge_m = _codes(builder.splat.means[rows])
        order = np.argsort(codes, kind="stable")
        self._rows, self._codes = rows[order], codes[order]
        self._builder = builder

    def overview(self, name: str) -> _Shown:
        """Return the top of the levels above the octree."""
        top = self._cell(name, 0, len(self._rows), BITS)
        level = 1
        while len(top.curve.codes) >= _LEAST_REDUCTION * _OVERVIEW:
            top = self._builder.parent(f"{name}z{level}", [top], top.curve)
            level += 1
        return top

    def _cell(self, name: str, first: int, last: int, height: int) -> _Shown:
        """Return the tile of rows `first` … `last`, which lie in one cell of 2^height cells a side."""
        if last - first <= self._builder.largest_tile:
            rows = slice(first, last)
            return self._builder.leaf(name, self._rows[rows], self._codes[rows], self._edge_m)
        ends = self._split(first, last, height)
        while len(ends) == 2 and height > 0:  # a single child: look into it
            height -= 1
            ends = self._split(first, last, height)
        children = [
            self._cell(f"{name}{number}", *span, max(height - 1, 0))
            for number, span in enumerate(itertools.pairwise(ends))
        ]
        mixture = Mixture.concatenate([child.curve.mixture for child in children])
        codes = np.concatenate([child.curve.codes for child in children])
        return self._builder.parent(name, children, _Curve(mixture, codes, self._edge_m))

    def _split(self, first: int, last: int, height: int) -> list[int]:
        """Return where the octants that are not empty begin, and `last`; equal places are cut into equal parts."""
        if height == 0:
            parts = math.ceil((last - first) / self._builder.largest_tile)
            return [first + (last - first) * part // parts for part in range(parts + 1)]
        octants = self._codes[first:last] >> 3 * (height - 1)
        return [first, *(first + 1 + np.flatnonzero(np.diff(octants))).tolist(), last]
