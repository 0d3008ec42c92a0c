"""SIFT's features of photographs, and matches of those that lie near where they are expected.

Compared with all features of another photograph, a feature must be unique among thousands. With those alone that
lie near an expected place, and have about the expected size and direction, it must be unique among a few, and takes
a hundredth of the time.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, ByteArray, Float32Array, IntArray
from pipelines.geometry.cameras import ColmapDatabase
from pipelines.splat.kernel_cache import kernel

DESCRIPTOR_LENGTH = 512.0  # of SIFT's descriptors as vectors, in the database

_CELL_PX = np.float32(16.0)
_MOST_FACTOR2 = np.float32(2.0**2)  # of a feature's size over the expected one, squared
_LEAST_COSINE2 = np.float32(np.cos(0.5) ** 2)  # of a feature's direction with the expected one: half a radian
_SAME_PLACE_PX = np.float32(3.0)  # apart: the same candidate, for SIFT gives a place several directions
_VALUES = 128  # of a descriptor: known to the compiler, the loop over them is vector instructions
_FAR = np.int32(2**30)  # squared distance of descriptors of none


@dataclass(frozen=True)
class SiftFeatures:
    """N features: pixels (N, 2), size and direction as vectors (N, 2) in px, descriptors (N, 128)."""

    xy_px: Float32Array
    axis_px: Float32Array
    descriptor: ByteArray

    @classmethod
    def read(cls, database: ColmapDatabase, key: int) -> Self:
        """Read a photograph's features that have descriptors, which come first; none of learned or unknown kind."""
        descriptor = np.asarray(database.read_descriptors(key).data)
        keypoint = np.asarray(database.read_keypoints(key), dtype=np.float32)[: len(descriptor)]
        known = descriptor.dtype == np.uint8 and descriptor.shape[1:] == (_VALUES,)
        if not known or keypoint.ndim != 2 or keypoint.shape[1] < 4 or not len(keypoint):
            return cls(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32), np.zeros((0, _VALUES), np.uint8))
        if keypoint.shape[1] == 6:  # an affine shape: its first column is the feature's axis
            axis = keypoint[:, [2, 4]]
        else:
            axis = keypoint[:, 2:3] * np.stack([np.cos(keypoint[:, 3]), np.sin(keypoint[:, 3])], axis=1)
        return cls(
            np.ascontiguousarray(keypoint[:, :2]), np.ascontiguousarray(axis), np.ascontiguousarray(descriptor)
        )

    def __len__(self) -> int:
        return len(self.xy_px)

    def of(self, rows: IntArray | BoolArray) -> Self:
        return replace(self, xy_px=self.xy_px[rows], axis_px=self.axis_px[rows], descriptor=self.descriptor[rows])

    @cached_property
    def square(self) -> NDArray[np.int32]:
        """Return the squared lengths (N,) of the descriptors."""
        return np.asarray((self.descriptor.astype(np.int32) ** 2).sum(axis=1), dtype=np.int32)

    @cached_property
    def cells(self) -> tuple[IntArray, IntArray, int, int]:
        """Return the features' order by cells, where each cell begins, and the numbers of columns and rows."""
        column, row = (self.xy_px // _CELL_PX).astype(np.int64).clip(0).T
        across, down = int(column.max(initial=0)) + 1, int(row.max(initial=0)) + 1
        cell = row * across + column
        order = np.argsort(cell, kind="stable")
        return order, np.searchsorted(cell[order], np.arange(across * down + 1)), across, down


class Expected(NamedTuple):
    """Where each of N features may be in another photograph: up to K places.

    Pixels (N, K, 2), radii (N, K) within which it is sought (not positive: nowhere), axes (N, K, 2) in px.
    """

    xy_px: Float32Array
    radius_px: Float32Array
    axis_px: Float32Array


def matches_near(
    first: SiftFeatures, second: SiftFeatures, expected: Expected, *, ratio: float, most_distance: float
) -> IntArray:
    """Return the matches (M, 2) of features of a photograph with those of a second one near the expected places.

    Each is the best of the other among the candidates of both, and unique in both photographs: the distance of its
    descriptors (of length one) is at most `most_distance`, and less than `ratio` of that of the next candidate.
    """
    order, begin, across, down = second.cells
    matched = _matched(
        *(first.xy_px, first.descriptor, first.square, expected.xy_px, expected.radius_px, expected.axis_px),
        *(second.xy_px, second.axis_px, second.descriptor, second.square, order, begin, across, down),
        *(np.float32(ratio**2), np.int32((most_distance * DESCRIPTOR_LENGTH) ** 2)),
    )
    return np.asarray(matched, dtype=np.int64)


def matches_of_all(first: SiftFeatures, second: SiftFeatures, *, ratio: float, most_distance: float) -> IntArray:
    """Return the matches (M, 2) of features of two photographs of which all are candidates, whatever their places.

    Each is the best of the other. The distance of the best is less than `ratio` of the second one's from the first.
    """
    most = np.int32((most_distance * DESCRIPTOR_LENGTH) ** 2)
    descriptors = first.descriptor, first.square, second.descriptor, second.square
    return np.asarray(_mutual(*descriptors, np.float32(ratio**2), most), dtype=np.int64)


# ruff: noqa: PLR0917  (kernels take arrays, not objects)


@njit(nogil=True, error_model="numpy", inline="always")
def _dot(one: ByteArray, i: int, other: ByteArray, j: int) -> np.int32:
    # Whole numbers: as quick as a matrix product by BLAS, which starts threads of its own.
    total = np.int32(0)
    for k in range(_VALUES):
        total += np.int32(one[i, k]) * np.int32(other[j, k])
    return total


@njit(nogil=True, error_model="numpy", inline="always")
def _keep(
    best: NDArray[np.int32],  # (N,) value of each key, -1: none
    nearest: NDArray[np.int32],  # (N, 2) squared distances of the best and of the next at another place
    xy: Float32Array,  # (M, 2) places of the values
    key: int,
    value: int,
    distance: np.int32,
) -> None:
    """Let a candidate become the best of its key, or the next one."""
    if distance >= nearest[key, 1]:
        return
    elsewhere = True
    if best[key] >= 0:
        across, down = xy[value, 0] - xy[best[key], 0], xy[value, 1] - xy[best[key], 1]
        elsewhere = across * across + down * down > _SAME_PLACE_PX * _SAME_PLACE_PX
    if distance < nearest[key, 0]:
        if elsewhere:
            nearest[key, 1] = nearest[key, 0]
        nearest[key, 0], best[key] = distance, value
    elif elsewhere:
        nearest[key, 1] = distance


@njit(nogil=True, error_model="numpy")
def _unique_of(best: NDArray[np.int32], back: NDArray[np.int32], unique: BoolArray) -> NDArray[np.int32]:
    """Return the matches (M, 2) of those features (N,) that are unique, and the best of their best."""
    matches = np.empty((len(best), 2), np.int32)
    found = 0
    for i in range(len(best)):
        if unique[i] and back[best[i]] == i:
            matches[found, 0], matches[found, 1] = i, best[i]
            found += 1
    return matches[:found]


@kernel(nogil=True, error_model="numpy")
def _matched(
    xy: Float32Array,  # (N, 2)
    descriptor: ByteArray,  # (N, D)
    square: NDArray[np.int32],  # (N,) of the descriptors
    place: Float32Array,  # (N, K, 2)
    radius: Float32Array,  # (N, K)
    wanted: Float32Array,  # (N, K, 2)
    other_xy: Float32Array,  # (M, 2)
    other_axis: Float32Array,  # (M, 2)
    other_descriptor: ByteArray,  # (M, D)
    other_square: NDArray[np.int32],  # (M,)
    order: IntArray,  # (M,)
    begin: IntArray,  # (across · down + 1,)
    across: int,
    down: int,
    ratio: np.float32,  # of squared distances
    most: np.int32,  # squared distance
) -> NDArray[np.int32]:
    count, others = descriptor.shape[0], other_descriptor.shape[0]
    best, back = np.full(count, -1, np.int32), np.full(others, -1, np.int32)
    nearest, nearest_back = np.full((count, 2), _FAR), np.full((others, 2), _FAR)
    compared = np.full(others, -1, np.int32)
    for i in range(count):
        for k in range(radius.shape[1]):
            r, x, y = radius[i, k], place[i, k, 0], place[i, k, 1]
            if not (r > 0 and x > -r and y > -r and x < across * _CELL_PX + r and y < down * _CELL_PX + r):
                continue
            a, b = wanted[i, k, 0], wanted[i, k, 1]
            size2 = a * a + b * b
            left, right = max(0, int((x - r) // _CELL_PX)), min(across - 1, int((x + r) // _CELL_PX))
            top, bottom = max(0, int((y - r) // _CELL_PX)), min(down - 1, int((y + r) // _CELL_PX))
            for row in range(top, bottom + 1):
                for at in range(begin[row * across + left], begin[row * across + right + 1]):
                    j = order[at]
                    u, v = other_xy[j, 0] - x, other_xy[j, 1] - y
                    c, d = other_axis[j, 0], other_axis[j, 1]
                    other2, dot = c * c + d * d, a * c + b * d
                    if (
                        compared[j] != i
                        and u * u + v * v <= r * r
                        and other2 < _MOST_FACTOR2 * size2
                        and size2 < _MOST_FACTOR2 * other2
                        and dot > 0
                        and dot * dot > _LEAST_COSINE2 * size2 * other2
                    ):
                        compared[j] = i
                        apart = square[i] + other_square[j] - 2 * _dot(descriptor, i, other_descriptor, j)
                        _keep(best, nearest, other_xy, i, j, apart)
                        _keep(back, nearest_back, xy, j, i, apart)
    unique = np.zeros(count, np.bool_)
    for i in range(count):
        if nearest[i, 0] <= most:
            unique[i] = nearest[i, 0] < ratio * min(nearest[i, 1], nearest_back[best[i], 1])
    return _unique_of(best, back, unique)


@kernel(nogil=True, error_model="numpy")
def _mutual(
    descriptor: ByteArray,  # (N, D)
    square: NDArray[np.int32],  # (N,)
    other_descriptor: ByteArray,  # (L, D)
    other_square: NDArray[np.int32],  # (L,)
    ratio: np.float32,  # of squared distances
    most: np.int32,  # squared distance
) -> NDArray[np.int32]:
    count, others = len(descriptor), len(other_descriptor)
    back, nearest_back = np.full(others, -1, np.int32), np.full(others, _FAR)
    best, unique, dot = np.full(count, -1, np.int32), np.zeros(count, np.bool_), np.empty(others, np.int32)
    for i in range(count):
        for j in range(others):
            dot[j] = _dot(descriptor, i, other_descriptor, j)
        first, second = _FAR, _FAR
        for j in range(others):
            apart = square[i] + other_square[j] - np.int32(2) * dot[j]
            if apart < second:
                if apart < first:
                    first, second, best[i] = apart, first, j
                else:
                    second = apart
            if apart < nearest_back[j]:
                nearest_back[j], back[j] = apart, i
        unique[i] = first <= most and first < ratio * second
    return _unique_of(best, back, unique)
