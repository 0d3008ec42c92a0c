"""Cholesky factor of a sparse matrix of square blocks, by nested dissection, with selected parts of its inverse.

The matrix couples places in the plane or in space, such as cameras that see the same points. Elimination couples
the neighbours of what it eliminates, and the order decides how far this fill-in spreads:

1. A cut across the longest extent halves the places. The places of one half that are coupled to the other form the
   separator, which is eliminated after both halves. Each half is cut in the same way (George 1973, doi
   10.1137/0710032). A block of n cameras over a plane then takes O(n log n) memory and O(n^1.5) operations.
2. Each separator is eliminated as a dense matrix, the front, together with the later places that it is coupled to
   (multifrontal method; Duff and Reid 1983, doi 10.1145/356044.356047).
3. The inverse is known on every front from that of the front above (Takahashi's equations; Erisman and Tinney 1975,
   doi 10.1145/360680.360704). Its diagonal blocks cost about twice the factorisation, and no solution of a system.

Couplings over any distance are allowed. They only enlarge the separators: a matrix without zeros becomes one front,
which is the dense method.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import bsr_matrix, csc_matrix

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray

_LEAST_CUT = 24  # places; fewer are eliminated together
_LARGEST_SEPARATOR = 0.5  # of the places that a cut divides; beyond it, they are eliminated together


@dataclass(frozen=True)
class _Front:
    eliminated: IntArray  # places eliminated here
    border: IntArray  # later places that they are coupled to
    children: tuple[int, ...]  # fronts below, whose borders lie within `eliminated` and `border`


@dataclass(frozen=True)
class Pivot:
    """Columns of the factor that a front eliminates, at rows `eliminated` (o,) and `border` (b,) of the matrix."""

    eliminated: IntArray
    border: IntArray
    diagonal: FloatArray  # (o, o) lower triangle
    below: FloatArray  # (b, o)


_FILL_BYTES = 12_000  # of blocks over a plane whose photographs overlap by 80 %: see `predicted_factor_bytes`


def predicted_factor_bytes(cameras: int) -> int:
    """Return the memory of a factor of cameras, each coupled with 75 neighbours in the plane, or with all."""
    return min(8 * (6 * cameras) ** 2, int(_FILL_BYTES * cameras * np.log2(max(cameras, 2))))


_solved = partial(solve_triangular, lower=True, check_finite=False)


class SparseCholesky:
    """Cholesky factor of a symmetric positive definite matrix of n × n blocks (w, w), given with both triangles.

    The cuts divide the places (n, d) of the block rows. The result does not depend on these, only the cost.

    Raises:
        DegenerateGeometryError: the matrix is not positive definite.
    """

    def __init__(self, matrix: bsr_matrix, position: FloatArray) -> None:
        self._width = matrix.blocksize[0]
        self._fronts = _dissection(matrix, position)
        self.pivots = self._factorised(matrix)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the product (n · w, m) of the inverse matrix and vectors (n · w, m)."""
        return self.coloured(self.whitened(right))

    def whitened(self, right: FloatArray) -> FloatArray:
        """Return the product L⁻¹ right (n · w, m) of vectors (n · w, m) with the inverse of the factor L."""
        solution = np.array(right, dtype=np.float64, order="C")
        for pivot in self.pivots:
            eliminated = _solved(pivot.diagonal, solution[pivot.eliminated])
            solution[pivot.eliminated] = eliminated
            solution[pivot.border] -= pivot.below @ eliminated
        return solution

    def coloured(self, white: FloatArray) -> FloatArray:
        """Return vectors (n · w, m) with the inverse matrix as their covariance, from white noise (n · w, m)."""
        solution = np.array(white, dtype=np.float64, order="C")
        for pivot in reversed(self.pivots):
            eliminated = solution[pivot.eliminated] - pivot.below.T @ solution[pivot.border]
            solution[pivot.eliminated] = _solved(pivot.diagonal, eliminated, trans=1)
        return solution

    def path(self, place: int) -> list[int]:
        """Return the pivots of which a place of L⁻ᵀ w depends: that of the place, and those above it, upwards."""
        path = [int(self._front_of[place])]
        while self._parent[path[-1]] >= 0:
            path.append(int(self._parent[path[-1]]))
        return path

    @cached_property
    def _front_of(self) -> IntArray:
        front_of = np.zeros(sum(len(front.eliminated) for front in self._fronts), dtype=np.int64)
        for index, front in enumerate(self._fronts):
            front_of[front.eliminated] = index
        return front_of

    @cached_property
    def _parent(self) -> IntArray:
        parent = np.full(len(self._fronts), -1, dtype=np.int64)
        for index, front in enumerate(self._fronts):
            parent[list(front.children)] = index
        return parent

    def inverse_form(self, right: csc_matrix) -> FloatArray:
        """Return the symmetric product rightᵀ A⁻¹ right (m, m) of a sparse matrix (n · w, m).

        Only the fronts on the way from the entries of `right` to the last separator take part.
        """
        reduced, form = right.toarray(order="C"), np.zeros((right.shape[1], right.shape[1]))
        for pivot in self.pivots:
            eliminated = reduced[pivot.eliminated]
            if eliminated.any():
                eliminated = _solved(pivot.diagonal, eliminated)
                reduced[pivot.border] -= pivot.below @ eliminated
                form += eliminated.T @ eliminated
        return form

    @cached_property
    def inverse_diagonal(self) -> FloatArray:
        """Diagonal blocks (n, w, w) of the inverse matrix."""
        count = sum(len(front.eliminated) for front in self._fronts)
        blocks, width = np.empty((count, self._width, self._width)), self._width
        for places, inverse in self._inverse_on_fronts():
            among = np.arange(len(places))
            blocks[places] = inverse.reshape(len(places), width, len(places), width)[among, :, among]
        return blocks

    def _inverse_on_fronts(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the places of each front that were eliminated there, and the inverse (o · w, o · w) among them."""
        above: dict[int, FloatArray] = {}
        for index in reversed(range(len(self._fronts))):
            front, pivot = self._fronts[index], self.pivots[index]
            on_border = above.pop(index, np.zeros((len(pivot.below), len(pivot.below))))
            root_inverse = _solved(pivot.diagonal, np.eye(len(pivot.diagonal)))
            response = pivot.below @ root_inverse
            across = -on_border @ response
            among = root_inverse.T @ root_inverse - response.T @ across
            yield front.eliminated, among
            whole = np.block([[among, across.T], [across, on_border]])
            places = np.concatenate([pivot.eliminated, pivot.border])
            order = np.argsort(places)
            for child in front.children:
                rows = order[np.searchsorted(places[order], self.pivots[child].border)]
                above[child] = whole[np.ix_(rows, rows)]

    def _factorised(self, matrix: bsr_matrix) -> list[Pivot]:
        pivots: list[Pivot] = []
        updates: dict[int, FloatArray] = {}
        width, place_in_front = self._width, np.full(matrix.shape[0] // self._width, -1, dtype=np.int64)
        for index, front in enumerate(self._fronts):
            places = np.concatenate([front.eliminated, front.border])
            place_in_front[places] = np.arange(len(places))
            dense = self._assembled(matrix, front, place_in_front)
            for child in front.children:
                rows = _rows(place_in_front[self._fronts[child].border], width)
                dense[np.ix_(rows, rows)] += updates.pop(child)
            place_in_front[places] = -1
            size = len(front.eliminated) * width
            try:
                diagonal = cholesky(dense[:size, :size], lower=True, check_finite=False)
            except np.linalg.LinAlgError:
                message = "The observations do not determine all cameras."
                raise DegenerateGeometryError("network-undetermined", message) from None
            below = np.ascontiguousarray(_solved(diagonal, dense[size:, :size].T).T)
            updates[index] = dense[size:, size:] - below @ below.T
            pivots.append(Pivot(_rows(front.eliminated, width), _rows(front.border, width), diagonal, below))
        return pivots

    def _assembled(self, matrix: bsr_matrix, front: _Front, place_in_front: IntArray) -> FloatArray:
        """Return the front (f · w, f · w) with the matrix's blocks in the columns of its own places."""
        width, count = self._width, len(front.eliminated) + len(front.border)
        dense = np.zeros((count, width, count, width))
        slots = _slots(matrix, front.eliminated)
        row = place_in_front[matrix.indices[slots]]
        column = place_in_front[np.repeat(front.eliminated, np.diff(matrix.indptr)[front.eliminated])]
        kept = row >= 0
        dense[row[kept], :, column[kept]] = np.swapaxes(matrix.data[slots[kept]], 1, 2)
        return dense.reshape(count * width, count * width)


def _rows(places: IntArray, width: int) -> IntArray:
    """Return the rows of the matrix that belong to block rows, one block row after the other."""
    return (places[:, None] * width + np.arange(width)).ravel()


def _dissection(matrix: bsr_matrix, position: FloatArray) -> list[_Front]:
    """Return the fronts, each after those below it."""
    fronts: list[_Front] = []
    eliminated = np.zeros(len(position), dtype=bool)

    def append(places: IntArray, children: tuple[int, ...]) -> int:
        eliminated[places] = True
        coupled = np.concatenate(
            [matrix.indices[_slots(matrix, places)], *(fronts[child].border for child in children)]
        )
        border = np.unique(coupled).astype(np.int64)
        fronts.append(_Front(places, border[~eliminated[border]], children))
        return len(fronts) - 1

    def dissect(places: IntArray) -> int:
        divided = _cut(matrix, position, places) if len(places) > _LEAST_CUT else None
        if divided is None:
            return append(places, ())
        *halves, separator = divided
        below = tuple(dissect(half) for half in halves if len(half))
        return append(separator, below)

    dissect(np.arange(len(position)))
    return fronts


def _cut(matrix: bsr_matrix, position: FloatArray, places: IntArray) -> tuple[IntArray, IntArray, IntArray] | None:
    """Return two halves of places without a coupling, and the separator between them; None: no cut pays."""
    along = position[places] @ np.linalg.svd(np.cov(position[places].T))[0][:, 0]
    order = places[np.argsort(along, kind="stable")]
    side = np.zeros(len(position), dtype=np.int8)
    halves = order[: len(order) // 2], order[len(order) // 2 :]
    side[halves[0]], side[halves[1]] = 1, 2
    facing = []
    for half, other in ((0, 2), (1, 1)):
        slots = _slots(matrix, halves[half])
        owner = np.repeat(halves[half], np.diff(matrix.indptr)[halves[half]])
        facing.append(np.unique(owner[side[matrix.indices[slots]] == other]))
    thinner = int(len(facing[1]) < len(facing[0]))
    if len(facing[thinner]) > _LARGEST_SEPARATOR * len(places) / 2:
        return None
    separator = facing[thinner]
    return np.setdiff1d(halves[0], separator), np.setdiff1d(halves[1], separator), separator


def _slots(matrix: bsr_matrix, rows: IntArray) -> IntArray:
    """Return the places in `matrix.data` of the blocks of block rows, one row after the other."""
    count = np.diff(matrix.indptr)[rows]
    start = np.repeat(matrix.indptr[rows] - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    return np.asarray(start + np.arange(int(count.sum())), dtype=np.int64)
