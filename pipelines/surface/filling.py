"""Heights where nothing was measured, from the measured cells around, with a σ that follows from their spread.

What no photograph shows lies mostly behind something that stands above it: the lower of the heights around count,
as in the maps of LiDAR. On simulated flights the median error is a third of that of the nearest height.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.splat.kernel_cache import kernel

_DIRECTIONS = 16
_LOW = 0.1  # quantile of the heights around, weighted by their inverse squared distance
# Cells: σ of the smoothing of what is filled, near and far from the measured. Each direction would leave a streak.
_SMOOTHED, _SMOOTHED_FAR = 2.0, 8.0
_FAR = 24.0  # cells from the nearest measured one
_SOURCES = 0.25  # of the range of the heights around, by which one whose colour is taken may lie above the filled
# Cells around one whose scatter counts in its σ: on the edge of a roof, a cell decides between storeys.
_AROUND = 15
_SQUARE = 0.25  # share of the mean square difference of the heights around from the low one, in its variance
_REFLECTED = cv2.BORDER_REFLECT


@dataclass(frozen=True)
class FilledCells:
    """Cells (H, W) of a raster.

    Attributes:
        height: measured heights, and filled ones where wanted; NaN: none in reach.
        sigma: of the filled heights, in their unit; 0 elsewhere.
        distance: cells to the nearest measured one, along the nearest of sixteen directions; 0 elsewhere.
        source: number row · W + column of the measured cell whose colour a filled one may take; its own elsewhere.
    """

    height: FloatArray
    sigma: FloatArray
    distance: FloatArray
    source: IntArray


def fill_cells(
    height: FloatArray,
    wanted: BoolArray,
    reach: int,
    modelled: FloatArray | None = None,
    *,
    with_sigma: bool = True,
) -> FilledCells:
    """Return heights (H, W), NaN where none was measured, filled where wanted from at most `reach` cells away.

    1. A cell looks in sixteen directions for the first measured height; the low quantile of these is its own.
    2. Its variance is a quarter of the mean square of their differences from it, since what hides a place mostly
       stands above it, plus the variance of all heights nearby, those that a model knows (H, W) included, plus, for
       the share of directions that found nothing, what heights differ by at that distance. On the
       three simulated flights by which that share was chosen, 3 to 8 % of the errors exceed two σ. Without σ, that
       of the result is 0.
    """
    height = np.ascontiguousarray(height, dtype=np.float64)
    empty = wanted & ~np.isfinite(height)
    rows, columns = np.nonzero(empty)
    own = np.arange(height.size, dtype=np.int64).reshape(height.shape)
    sigma, distance = np.zeros(height.shape), np.zeros(height.shape)
    if not len(rows):
        return FilledCells(height, sigma, distance, own)
    angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    directions = np.column_stack([np.sin(angle), np.cos(angle)])
    low, square, near, missing, source = _heights_around(
        height, np.column_stack([rows, columns]), directions, reach
    )
    filled, known = height.copy(), np.isfinite(low)
    filled[rows, columns] = low
    close, far = _smoothed(filled, _SMOOTHED)[rows, columns], _smoothed(filled, _SMOOTHED_FAR)[rows, columns]
    share = np.clip(near / _FAR, 0.0, 1.0)
    filled[rows, columns] = np.where(known, (1 - share) * close + share * far, np.nan)
    distance[rows, columns] = near
    if with_sigma:
        relief = filled if modelled is None else np.where(empty & np.isfinite(modelled), modelled, filled)
        unknown = missing * np.interp(near, *_variogram(height))
        variance = _SQUARE * square + _scatter(relief)[rows, columns] + unknown
        sigma[rows, columns] = np.sqrt(variance)
    own[rows, columns] = np.where(known, source, own[rows, columns])
    return FilledCells(filled, sigma, distance, own)


def _smoothed(height: FloatArray, cells: float) -> FloatArray:
    known, middle, above = _above_middle(height)
    size = (2 * int(4 * cells + 0.5) + 1,) * 2
    weight, total = (cv2.GaussianBlur(values, size, cells, borderType=_REFLECTED) for values in (known, above))
    return np.asarray(middle + total / np.maximum(weight, 1e-9), dtype=np.float64)


def _above_middle(height: FloatArray) -> tuple[NDArray[np.float32], float, NDArray[np.float32]]:
    """Return 1 where a height is known (H, W), the median, and heights above it (H, W), 0 where not known."""
    known = np.isfinite(height)
    middle = float(np.median(height[known])) if known.any() else 0.0
    return known.astype(np.float32), middle, np.where(known, height - middle, 0.0).astype(np.float32)


def _variogram(height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distances (L,) in cells, and the mean square difference (L,) of measured heights so far apart."""
    lags, squares = [0.0], [0.0]
    for lag in 2 ** np.arange(int(np.log2(max(min(height.shape), 2)))):
        pairs = (height[lag:] - height[:-lag]).ravel(), (height[:, lag:] - height[:, :-lag]).ravel()
        difference = np.concatenate(pairs)
        difference = difference[np.isfinite(difference)]
        if len(difference):
            lags.append(float(lag))
            squares.append(max(float(np.mean(difference**2)), squares[-1]))
    return np.array(lags), np.array(squares)


def _scatter(height: FloatArray) -> FloatArray:
    """Return the variance (H, W) of the known heights around each cell; 0: there are none."""
    known, _, above = _above_middle(height)
    size = (2 * _AROUND + 1,) * 2
    share, mean, square = (
        cv2.boxFilter(values, cv2.CV_64F, size, borderType=_REFLECTED) for values in (known, above, above**2)
    )
    share = np.maximum(share, 1e-6)
    return np.asarray(np.maximum(square / share - (mean / share) ** 2, 0.0))


@kernel(nogil=True, parallel=True, error_model="numpy")
def _heights_around(
    height: FloatArray,  # (H, W) float64
    cells: IntArray,  # (C, 2) int64
    directions: FloatArray,  # (D, 2) float64
    reach: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Return low quantile, mean square difference from it, distance, missing share of directions, source."""
    count = len(cells)
    low, square = np.full(count, np.nan), np.zeros(count)
    near, missing, source = np.zeros(count), np.ones(count), np.zeros(count, dtype=np.int64)
    for k in prange(count):
        found = 0
        value, weight = np.empty(16), np.empty(16)
        length, place = np.empty(16), np.empty(16, dtype=np.int64)
        for j in range(len(directions)):
            for step in range(1, reach + 1):
                row = int(np.rint(cells[k, 0] + step * directions[j, 0]))
                column = int(np.rint(cells[k, 1] + step * directions[j, 1]))
                if row < 0 or column < 0 or row >= height.shape[0] or column >= height.shape[1]:
                    break
                if not np.isnan(height[row, column]):
                    value[found], weight[found] = height[row, column], 1.0 / (step * step)
                    length[found], place[found] = step, row * height.shape[1] + column
                    found += 1
                    break
        if found == 0:
            continue
        missing[k] = 1.0 - found / len(directions)
        order = np.argsort(value[:found])
        total, sum_so_far = weight[:found].sum(), 0.0
        for j in order:
            sum_so_far += weight[j]
            if sum_so_far >= _LOW * total:
                low[k] = value[j]
                break
        limit = low[k] + _SOURCES * (value[order[-1]] - value[order[0]])
        near[k], nearest_low = reach, reach + 1.0
        for j in range(found):
            square[k] += (value[j] - low[k]) ** 2 / found
            near[k] = min(near[k], length[j])
            if value[j] <= limit and length[j] < nearest_low:
                nearest_low, source[k] = length[j], place[j]
    return low, square, near, missing, source
