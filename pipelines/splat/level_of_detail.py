"""Levels of detail: a tree of tiles, each of which shows its part of the splat with few enough Gaussians.

Leaves hold the Gaussians themselves, each in exactly one leaf of an octree. A tile above merges what its children
show, by the cells of a grid. Its cells are at least twice as large as theirs: a viewer shows it from afar, and its
children from near. Above the octree, further levels become coarser until a few hundred Gaussians show the whole.

A Gaussian counts with its mass: opacity times the area of its shadow, averaged over all directions. That is the
light which it takes away from a distant viewer. Merging keeps the sum of the masses, and, weighted by mass, the
mean, the covariance (that of the mixture, by the law of total covariance) and the harmonics. Moments of moments are
those of the whole, so that levels of detail can be merged from one another without drift.

A scene may be larger than memory: it is handed over in parts, such as the blocks of a training, one after another.
Gaussians far outside the scene, and those as large as it, form a tree of their own: in the scene's tree they would
make the boxes of its tiles so large that a viewer always stands inside, and never sees a coarse level.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray, joined_rows, rows_of
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.splat.spatial import BITS, morton_codes

# Thomsen's formula for the surface of an ellipsoid, which is four times its mean shadow (Cauchy), within 1.1 %.
_THOMSEN = 1.6075
_LEAST_MASS = 1e-300
_LOG_SCALES = (-20.0, 20.0)  # a file may state more, with which nobody can calculate
_MOST_OPACITY = 0.99
# Mass that an opaque Gaussian of the mixture's covariance cannot take makes it larger, by at most this factor of
# its variance: an opaque surface in cells of edge h has σ = h / √12 in each, and is closed again at σ = h / √3.
_MOST_GROWTH = 4.0
# A viewer shows no Gaussian whose σ is less than about a third of a pixel. In the farthest view of a level, a cell
# is at least a pixel wide.
_LEAST_SIGMA_CELLS = 0.35


@dataclass(frozen=True)
class Mixture:
    """Moments of N groups of Gaussians: mass (opacity times area), means and covariances in metres."""

    mass: FloatArray
    means: FloatArray
    covariances: FloatArray
    sh: Float32Array

    @property
    def sizes_m(self) -> FloatArray:
        """Root of the trace of the covariances (N,): between one and √3 times the largest σ."""
        return np.asarray(np.sqrt(np.einsum("nii->n", self.covariances)))


def shadow_areas(sigmas: FloatArray) -> FloatArray:
    """Return the shadows (N,) of opaque Gaussians of standard deviations (N, 3), averaged over all directions.

    A Gaussian that is σ wide in every direction has the shadow 2π σ².
    """
    a, b, c = sigmas.T
    products = np.stack([a * b, b * c, c * a])
    largest = np.maximum(products.max(axis=0), np.finfo(np.float64).tiny)
    mean = ((products / largest) ** _THOMSEN).mean(axis=0) ** (1 / _THOMSEN)
    return np.asarray(2 * np.pi * largest * mean)


def mixture_of(splat: SplatArrays) -> Mixture:
    """Return Gaussians as a mixture: mass (opacity times mean shadow), means (N, 3), covariances (N, 3, 3)."""
    sigmas = np.exp(np.clip(splat.log_scales.astype(np.float64), *_LOG_SCALES))
    opacities = 0.5 + 0.5 * np.tanh(0.5 * splat.logit_opacities.astype(np.float64))
    axes = matrix_from_quat_xyzw(np.roll(splat.quats_wxyz, -1, axis=1)) * sigmas[:, None]
    return Mixture(
        mass=np.maximum(opacities * shadow_areas(sigmas), _LEAST_MASS),
        means=splat.means.astype(np.float64),
        covariances=axes @ axes.transpose(0, 2, 1),
        sh=splat.sh,
    )


def merged(mixture: Mixture, starts: IntArray) -> Mixture:
    """Return the moments of groups of successive rows, given each group's first row (G,), ascending from 0."""
    mass = np.add.reduceat(mixture.mass, starts)
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(mixture.mass)))
    weight = mixture.mass / mass[group]
    means = np.add.reduceat(weight[:, None] * mixture.means, starts)
    arm = mixture.means - means[group]
    second = mixture.covariances + arm[:, :, None] * arm[:, None, :]
    return Mixture(
        mass=mass,
        means=means,
        covariances=np.add.reduceat(weight[:, None, None] * second, starts),
        sh=np.add.reduceat(weight[:, None, None].astype(np.float32) * mixture.sh, starts),
    )


def drawn(mixture: Mixture, cell_m: float) -> SplatArrays:
    """Return Gaussians that show the groups of a level, which were merged in cells of an edge.

    The opacity is mass over area. A group with more mass than an opaque Gaussian of its covariance takes, and one
    too small to be shown, is enlarged evenly; where the limit of growth is met, its mass is cut.
    """
    variances, axes = np.linalg.eigh(mixture.covariances)
    sigmas = np.sqrt(np.maximum(variances, 1e-12 * np.maximum(variances[:, 2:], 1e-30)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    excess = mixture.mass / (_MOST_OPACITY * shadow_areas(sigmas))
    growth = np.sqrt(np.clip(excess, 1, _MOST_GROWTH))
    growth = np.maximum(growth, _LEAST_SIGMA_CELLS * cell_m / sigmas[:, 2])
    sigmas = sigmas * growth[:, None]
    opacity = np.clip(mixture.mass / shadow_areas(sigmas), 1e-12, _MOST_OPACITY)
    return SplatArrays(
        means=mixture.means.astype(np.float32),
        quats_wxyz=np.roll(quat_xyzw_from_matrix(axes), 1, axis=1).astype(np.float32),
        log_scales=np.log(sigmas).astype(np.float32),
        logit_opacities=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=mixture.sh,
    )


def bounds_of(mixture: Mixture) -> FloatArray:
    """Return the box (2, 3), least and largest coordinates, of Gaussians up to 3 σ."""
    reach = 3 * np.sqrt(np.einsum("nii->ni", mixture.covariances))
    return np.stack([(mixture.means - reach).min(axis=0), (mixture.means + reach).max(axis=0)])


# Viewers replace a tile whose error exceeds 16 pixels by default (CesiumJS). With this factor, cells are then drawn
# two to four pixels wide, and for viewers that demand 8 pixels still one to two.
_ERROR_CELLS = 4.0
_OVERVIEW = 256  # Gaussians of the coarsest level
_LEAST_REDUCTION = 2
_NEIGHBOURS = 4  # trees of parts that get a common parent: a surface in cells twice as large has a quarter of them
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
    """Tile of the tree."""

    name: str  # unique, of letters and digits
    count: int  # Gaussians that it shows
    error_m: float  # size of the details that it does not show; 0 for a leaf
    bounds: FloatArray  # (2, 3) box of its Gaussians up to 3 σ, and of its children
    children: tuple[DetailTile, ...] = ()  # together they replace it

    def all(self) -> Iterator[DetailTile]:
        yield self
        for child in self.children:
            yield from child.all()

    def levels(self) -> Iterator[tuple[DetailTile, ...]]:
        """Yield the tiles of each level of the tree, from the root down."""
        level: tuple[DetailTile, ...] = (self,)
        while level:
            yield level
            level = tuple(child for tile in level for child in tile.children)


def build_tiles(parts: Iterable[SplatArrays], box: FloatArray, tiler: Tiler) -> DetailTile:
    """Return the root of the tree of tiles, and write the content of each tile.

    Each part, of at least one Gaussian, has a tree of its own; as soon as four successive trees stand, they get a
    common parent. Parts should therefore be neighbours, and in the order of a tree themselves. All values are
    finite, and the `box` (2, 3) of the scene is that of all parts together, see `scene_box`.

    Memory: that of a part, of all Gaussians outside the scene, and of four tiles a level.
    """
    inner, outer = _Forest(tiler), []
    for number, part in enumerate(parts):
        outside = _outside(part, box)
        if not outside.all():
            inner.plant(_octree(rows_of(part, np.flatnonzero(~outside)), tiler, f"s{number}p"))
        outer.append(rows_of(part, np.flatnonzero(outside)))
    trees = [("s", tree) for tree in inner.grown()]
    if far := [part for part in outer if len(part)]:
        trees.append(("f", _octree(joined_rows(far), tiler, "f")))
    tops = [tiler.overview(name, tree) for name, tree in trees]
    return (tops[0] if len(tops) == 1 else tiler.joined("r", tops)).tile


def best_cut(root: DetailTile, most: int) -> list[DetailTile]:
    """Return tiles that together show everything, in as much detail as a number of Gaussians allows.

    The tile with the largest error is replaced by its children as long as there is room.
    """
    cut, total = [root], root.count
    while True:
        coarsest = max(cut, key=lambda tile: tile.error_m)
        total += sum(child.count for child in coarsest.children) - coarsest.count
        if total > most or not coarsest.children:
            return cut
        cut.remove(coarsest)
        cut += coarsest.children


def within_budget(root: DetailTile, most: int) -> DetailTile:
    """Return the tree without its finest tiles, so that all tiles together have no more than so many Gaussians.

    The tile with the largest error gets its children first, as long as there is room: what is left has one detail
    everywhere. The root stays in any case.
    """
    total, kept, waiting = root.count, set[str](), [(-root.error_m, root.name, root)]
    while waiting:
        _, name, tile = heapq.heappop(waiting)
        total += sum(child.count for child in tile.children)
        if total > most:
            break
        kept.add(name)
        for child in tile.children:
            heapq.heappush(waiting, (-child.error_m, child.name, child))

    def cut(tile: DetailTile) -> DetailTile:
        return replace(tile, children=tuple(map(cut, tile.children)) if tile.name in kept else ())

    return cut(root)


def coarser(splat: SplatArrays, most: int) -> Iterator[SplatArrays]:
    """Yield ever coarser splats of the whole scene, of at most half as many Gaussians each, the last of `most`.

    Cells have one size in all of the scene. A splat of at most so many has none.
    """
    if len(splat) <= most:
        return
    codes, edge_m = _codes(splat.means)
    order = np.argsort(codes, kind="stable")
    curve, level = _Curve(mixture_of(rows_of(splat, order)), codes[order], edge_m), 0
    while len(curve.codes) > most:
        level = curve.level_of(curve.cell_m(level), max(len(curve.codes) // _LEAST_REDUCTION, 1))
        curve = curve.merged(level)
        yield drawn(curve.mixture, curve.cell_m(level))


def scene_box(centers: ArrayLike) -> FloatArray:
    """Return the box (2, 3), least and largest coordinates, of a scene of Gaussians with these centres (N, 3)."""
    return np.asarray(np.quantile(np.asarray(centers), _INNER, axis=0))


def _outside(splat: SplatArrays, box: FloatArray) -> BoolArray:
    """Return which Gaussians (N,) are no part of the scene itself: far away, or as large as it."""
    low, high = box
    size_m = float((high - low).max())
    margin = _OUTSKIRTS * size_m
    away = ((splat.means < low - margin) | (splat.means > high + margin)).any(axis=1)
    outside: BoolArray = away | (splat.log_scales.max(axis=1) > np.log(max(_GIANT * size_m, _LEAST_EDGE_M)))
    return outside


def _codes(points: ArrayLike) -> tuple[IntArray, float]:
    codes, edge_m = morton_codes(torch.as_tensor(points, dtype=torch.float64))
    return codes.numpy(), max(edge_m, _LEAST_EDGE_M)


@dataclass(frozen=True)
class _Curve:
    """Moments of N Gaussians, sorted along a Z-order curve by their codes (N,): a cell is a range of rows.

    The curve's smallest cells have an edge; those of level k are 2^k times as large.
    """

    mixture: Mixture
    codes: IntArray
    edge_m: float

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
        mixture = joined_rows([merged(rows_of(self.mixture, rows), starts), rows_of(self.mixture, alone)])
        codes = np.concatenate([self.codes[rows][starts], self.codes[alone]])
        order = np.argsort(codes, kind="stable")
        return _Curve(rows_of(mixture, order), codes[order], self.edge_m)

    def cell_m(self, level: int) -> float:
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
class Tiler:
    """Maker of tiles of a largest number of Gaussians."""

    largest_tile: int
    write: WriteTile

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

    def joined(self, name: str, children: list[_Shown]) -> _Shown:
        """Return the tile above tops of different trees."""
        both = joined_rows([child.curve.mixture for child in children])
        codes, edge_m = _codes(both.means)
        order = np.argsort(codes, kind="stable")
        return self.parent(name, children, _Curve(rows_of(both, order), codes[order], edge_m))

    def overview(self, name: str, top: _Shown) -> _Shown:
        """Return the top of the levels above a tree."""
        level = 1
        while len(top.curve.codes) >= _LEAST_REDUCTION * _OVERVIEW:
            top = self.parent(f"{name}z{level}", [top], top.curve)
            level += 1
        return top


class _Forest:
    """Trees of successive parts of the scene: four of a height become one of the next."""

    def __init__(self, tiler: Tiler) -> None:
        self._tiler = tiler
        self._waiting: list[list[_Shown]] = []
        self._joined = 0

    def plant(self, tree: _Shown, height: int = 0) -> None:
        if height == len(self._waiting):
            self._waiting.append([])
        row = self._waiting[height]
        row.append(tree)
        if len(row) == _NEIGHBOURS:
            self._waiting[height] = []
            self.plant(self._join(row), height + 1)

    def grown(self) -> list[_Shown]:
        """Return the one tree of all; none, where none was planted."""
        rest: list[_Shown] = []
        for row in self._waiting:
            rest = [self._join([*row, *rest])] if len(row) + len(rest) > 1 else [*row, *rest]
        return rest

    def _join(self, trees: list[_Shown]) -> _Shown:
        self._joined += 1
        return self._tiler.joined(f"s{self._joined}j", trees)


def _octree(splat: SplatArrays, tiler: Tiler, name: str) -> _Shown:
    codes, edge_m = _codes(splat.means)
    rows = np.argsort(codes, kind="stable")
    codes = codes[rows]

    def cell(name: str, first: int, last: int, height: int) -> _Shown:
        """Return the tile of rows `first` … `last`, which lie in one cell of 2^height cells a side."""
        if last - first <= tiler.largest_tile:
            content = rows_of(splat, rows[first:last])
            tiler.write(name, content, is_leaf=True)
            mixture = mixture_of(content)
            tile = DetailTile(name, len(content), 0.0, bounds_of(mixture))
            return _Shown(tile, _Curve(mixture, codes[first:last], edge_m), 0.0)
        ends = octants(first, last, height)
        while len(ends) == 2 and height > 0:  # a single child: look into it
            height -= 1
            ends = octants(first, last, height)
        children = [
            cell(f"{name}{number}", *span, max(height - 1, 0))
            for number, span in enumerate(itertools.pairwise(ends))
        ]
        mixture = joined_rows([child.curve.mixture for child in children])
        places = np.concatenate([child.curve.codes for child in children])
        return tiler.parent(name, children, _Curve(mixture, places, edge_m))

    def octants(first: int, last: int, height: int) -> list[int]:
        """Return where the octants that are not empty begin, and `last`; equal places are cut into equal parts."""
        if height == 0:
            parts = math.ceil((last - first) / tiler.largest_tile)
            return [first + (last - first) * part // parts for part in range(parts + 1)]
        number = codes[first:last] >> 3 * (height - 1)
        return [first, *(first + 1 + np.flatnonzero(np.diff(number))).tolist(), last]

    return cell(name, 0, len(rows), BITS)
