"""Photometric matching of a photograph with its neighbours, hypothesis by hypothesis; the best hypothesis wins.

1. Normalised cross-correlation compares photographs: exposure does not change it.
2. The neighbours that agree best count (Kang, Szeliski & Chai, doi 10.1109/CVPR.2001.990462): an obstacle hides a
   place from some sides only.
3. A guided filter averages the correlations of each hypothesis, but not across edges of the photograph (Rhemann et
   al., doi 10.1109/CVPR.2011.5995372). Ground without texture needs a wide window; beside the edge of a roof a wide
   window sees the roof.

The kernels hold no GIL, so that threads match several views at once. All loops run along image rows and without
branches: LLVM makes vector instructions of them. Floating-point flags exclude NaN and infinity, which callers
therefore keep out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)
_FAST = {"contract", "nsz", "arcp", "reassoc", "nnan", "ninf"}
_UNSEEN = np.float32(-1.0)  # correlation outside a neighbour's image
NOISE_VARIANCE = np.float32(0.3)  # grey levels²: windows that vary less than the sensor's noise do not correlate
_LEAST_DEPTH = np.float32(1e-3)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@njit(nogil=True, fastmath=_FAST, error_model="numpy", inline="always")
def _reflected(row: int, height: int) -> int:
    """Return the row that a row beyond the image mirrors."""
    inside = -row - 1 if row < 0 else row
    return 2 * height - inside - 1 if inside >= height else inside


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _project_row(
    depth: Float32Array,  # (W,) float32
    row: int,
    per_depth: Float32Array,  # (3, 3) float32
    start: Float32Array,  # (3,) float32
    size: Float32Array,  # (2,) float32
    stride: int,
    place: NDArray[np.int32],  # (W,) int32
    fraction: Float32Array,  # (2, W) float32
    miss: Float32Array,  # (W,) float32
) -> None:
    """Project the pixels of a row at their depths (W,) into a neighbour, clamped to its image.

    Writes the index of the upper left of four pixels into `place` (W,), the position between them into `fraction`
    (2, W), and into `miss` (W,) 0 where nothing was clamped.
    """
    y = np.float32(row)
    x0 = per_depth[0, 1] * y + per_depth[0, 2]
    y0 = per_depth[1, 1] * y + per_depth[1, 2]
    z0 = per_depth[2, 1] * y + per_depth[2, 2]
    x_step, y_step, z_step = per_depth[0, 0], per_depth[1, 0], per_depth[2, 0]
    x_start, y_start, z_start, right, bottom = start[0], start[1], start[2], size[0], size[1]
    for i in range(depth.shape[0]):
        column, d = np.float32(i), depth[i]
        z = d * (z_step * column + z0) + z_start
        ahead = max(z, _LEAST_DEPTH)
        inverse = _ONE / ahead
        u = (d * (x_step * column + x0) + x_start) * inverse
        v = (d * (y_step * column + y0) + y_start) * inverse
        inner_u, inner_v = min(max(u, _ZERO), right), min(max(v, _ZERO), bottom)
        whole_u, whole_v = np.int32(inner_u), np.int32(inner_v)
        place[i] = whole_v * stride + whole_u
        fraction[0, i] = inner_u - np.float32(whole_u)
        fraction[1, i] = inner_v - np.float32(whole_v)
        miss[i] = abs(inner_u - u) + abs(inner_v - v) + (ahead - z)


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _sample_row(
    grey: Float32Array,  # (h · w,) float32
    stride: int,
    place: NDArray[np.int32],  # (W,) int32
    fraction: Float32Array,  # (2, W) float32
    miss: Float32Array,  # (W,) float32
    shown: Float32Array,  # (W,) float32
) -> None:
    """Write the interpolated grey levels at places into `shown` (W,); 0 where the place was missed."""
    down = np.uint32(stride)
    for i in range(place.shape[0]):
        first = np.uint32(place[i])
        a, b = grey[first], grey[first + np.uint32(1)]
        c, d = grey[first + down], grey[first + down + np.uint32(1)]
        above, below = a + fraction[0, i] * (b - a), c + fraction[0, i] * (d - c)
        level = above + fraction[1, i] * (below - above)
        shown[i] = level if miss[i] == _ZERO else _ZERO


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _add_across(
    reference: Float32Array,  # (W + 2 half,) float32
    padded: Float32Array,  # (W + 2 half,) float32
    half: int,
    sums: Float32Array,  # (3, W) float32
) -> None:
    """Write Σ other, Σ other², Σ reference · other over windows along a row into sums (3, W).

    Both rows (W + 2 half,) are mirrored at their ends; `padded` is that of the neighbour, as the reference sees it.
    """
    width = sums.shape[1]
    for k in range(2 * half + 1):
        for i in range(width):
            level = padded[i + k]
            product = reference[i + k] * level
            if k == 0:
                sums[0, i], sums[1, i], sums[2, i] = level, level * level, product
            else:
                sums[0, i] += level
                sums[1, i] += level * level
                sums[2, i] += product


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _mirror_ends(
    padded: Float32Array,  # (W + 2 half,) float32
    half: int,
) -> None:
    width = padded.shape[0] - 2 * half
    for k in range(half):
        padded[half - 1 - k] = padded[half + k]
        padded[half + width + k] = padded[half + width - 1 - k]


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _correlate_row(
    ring: Float32Array,  # (window, 3, W) float32
    shown: Float32Array,  # (W,) float32
    mean: Float32Array,  # (W,) float32
    inverse_sigma: Float32Array,  # (W,) float32
    total: Float32Array,  # (3, W) float32
    score: Float32Array,  # (W,) float32
) -> None:
    """Write the correlation of a row with a neighbour into score (W,).

    The ring (window, 3, W) has sums along the rows of the window, `shown` (W,) the neighbour's grey levels at the
    row itself, mean and inverse σ (W,) are those of the reference's windows, `total` (3, W) is scratch.
    """
    window, width = ring.shape[0], shown.shape[0]
    share = np.float32(1.0 / (window * window))
    for q in range(3):
        for i in range(width):
            total[q, i] = ring[0, q, i]
        for k in range(1, window):
            for i in range(width):
                total[q, i] += ring[k, q, i]
    for i in range(width):
        other = total[0, i] * share
        variance = max(total[1, i] * share - other * other, NOISE_VARIANCE)
        level = (total[2, i] * share - mean[i] * other) * inverse_sigma[i] / np.sqrt(variance)
        score[i] = _UNSEEN if shown[i] == _ZERO else level


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _keep_largest(
    score: Float32Array,  # (W,) float32
    largest: Float32Array,  # (k, W) float32
) -> None:
    """Insert scores (W,) into the sorted largest (k, W) so far; overwrites them."""
    for rank in range(largest.shape[0]):
        for i in range(score.shape[0]):
            kept, new = largest[rank, i], score[i]
            largest[rank, i] = max(kept, new)
            score[i] = min(kept, new)


@kernel(nogil=True, fastmath=_FAST, error_model="numpy")
def match_rows(
    depth: Float32Array,  # (H, W) float32
    rows: IntArray,  # (2,) int64
    reference: Float32Array,  # (H, W + 2 half) float32
    mean: Float32Array,  # (H, W) float32
    inverse_sigma: Float32Array,  # (H, W) float32
    greys: Float32Array,  # (n, h + 1, w + 1) float32
    sizes: Float32Array,  # (n, 2) float32
    per_depth: Float32Array,  # (n, 3, 3) float32
    starts: Float32Array,  # (n, 3) float32
    out: Float32Array,  # (H, k, W) float32
) -> None:
    """Write the best correlations of some rows of a view with n neighbours, under a hypothesis of depth.

    Args:
        depth: (H, W) hypothesis, finite.
        rows: (2,) first row and the row after the last.
        reference: (H, W + 2 half) grey levels, mirrored at the ends of rows; half = window // 2.
        mean: (H, W) of the reference's windows.
        inverse_sigma: (H, W) of the reference's windows.
        greys: (n, h + 1, w + 1) grey levels of the neighbours; the last row and column are not read with weight.
        sizes: (n, 2) largest column and row of each neighbour, float32.
        per_depth: (n, 3, 3) float32, starts: (n, 3) float32: of a pixel (column, row) at depth d, the neighbour's
            homogeneous pixel is d · per_depth · (column, row, 1) + start.
        out: (H, k, W) the largest correlations, largest first, k at most n.
    """
    count, height, width = len(greys), depth.shape[0], depth.shape[1]
    half = (reference.shape[1] - width) // 2
    window, stride = 2 * half + 1, greys.shape[2]
    flat = greys.reshape(count, -1)
    ring = np.empty((count, window, 3, width), np.float32)
    shown = np.zeros((count, window, width + 2 * half), np.float32)
    place, fraction = np.empty(width, np.int32), np.empty((2, width), np.float32)
    miss, score, total = np.empty(width, np.float32), np.empty(width, np.float32), np.empty((3, width), np.float32)
    for pushed in range(rows[0] - half, rows[1] + half):
        row, slot = _reflected(pushed, height), (pushed + window) % window
        done = pushed - half
        if done >= rows[0]:
            out[done] = np.float32(-2.0)
        for k in range(count):
            _project_row(depth[row], row, per_depth[k], starts[k], sizes[k], stride, place, fraction, miss)
            _sample_row(flat[k], stride, place, fraction, miss, shown[k, slot, half : half + width])
            _mirror_ends(shown[k, slot], half)
            _add_across(reference[row], shown[k, slot], half, ring[k, slot])
            if done >= rows[0]:
                middle = shown[k, (done + window) % window, half : half + width]
                _correlate_row(ring[k], middle, mean[done], inverse_sigma[done], total, score)
                _keep_largest(score, out[done])


@kernel(nogil=True, error_model="numpy")
def keep_winner(
    number: int,
    score: Float32Array,  # (P,) float32
    last: Float32Array,  # (P,) float32
    best: Float32Array,  # (P,) float32
    before: Float32Array,  # (P,) float32
    after: Float32Array,  # (P,) float32
    hypothesis: NDArray[np.int32],  # (P,) int32
) -> None:
    """Compare the scores of hypothesis `number` with the best so far, pixel by pixel.

    Args:
        number: of the hypothesis, from 0.
        score: (P,) its scores.
        last: (P,) scores of the hypothesis before; receives `score`.
        best: (P,) largest scores so far.
        before: (P,) scores of the hypotheses before the best ones.
        after: (P,) scores of those after the best ones.
        hypothesis: (P,) numbers of the best, int32.
    """
    for i in range(score.shape[0]):
        new = score[i]
        if new > best[i]:
            best[i], before[i], after[i], hypothesis[i] = new, last[i], np.float32(-2.0), number
        elif hypothesis[i] == number - 1:
            after[i] = new
        last[i] = new


UNSEEN = float(_UNSEEN)
_LEAST_CURVATURE = 1e-6
_FURTHEST_M = 1e7  # hypotheses beyond are as good as infinite, and kernels need finite numbers


@dataclass(frozen=True)
class StereoView:
    """Photograph (H, W) with its camera; grey levels 1 … 256, 0 outside the photograph's valid part."""

    camera: ViewPose
    grey: Float32Array


def camera_matrix(camera: Pinhole, offset_px: float = 0.0) -> FloatArray:
    """Return the camera matrix (3, 3); OpenCV counts pixels from the centre of the first, an offset of 0.5."""
    return np.array([[camera.fx, 0, camera.cx - offset_px], [0, camera.fy, camera.cy - offset_px], [0, 0, 1]])


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the comparison."""

    window_px: int = 5  # side of the correlation window, odd
    reach_px: int = 6  # radius of the guided filter that averages correlations
    edge_grey: float = 10.0  # step in grey levels across which the filter does not average
    views: int = 3  # number of neighbours that count, the best of all

    @property
    def support_px(self) -> int:
        """Distance from a pixel up to which its score depends on the image: the guided filter averages averages."""
        return self.window_px // 2 + 2 * self.reach_px


class Matcher:
    """Compares a photograph (H, W) with its neighbours under hypotheses of depth."""

    def __init__(self, reference: StereoView, neighbours: list[StereoView], settings: MatchSettings) -> None:
        grey, side = reference.grey, (settings.window_px, settings.window_px)
        self._settings, self._grey = settings, grey
        self._mean, square = (
            np.asarray(cv2.boxFilter(image, -1, side, borderType=cv2.BORDER_REFLECT), np.float32)
            for image in (grey, grey * grey)
        )
        variance = square - self._mean * self._mean
        self._inverse_sigma = (1 / np.sqrt(np.maximum(variance, NOISE_VARIANCE))).astype(np.float32)
        half = settings.window_px // 2
        self._mirrored = np.pad(grey, ((0, 0), (half, half)), mode="symmetric")
        self._greys, self._sizes = _stacked([view.grey for view in neighbours])
        self._per_depth, self._starts = _projections(reference, neighbours)
        height, width = grey.shape
        self._largest = np.empty((height, min(settings.views, len(neighbours)), width), np.float32)
        self._guided: tuple[slice, cv2.ximgproc.GuidedFilter] | None = None

    def __call__(self, depth: Float32Array, rows: slice | None = None) -> Float32Array:
        """Return the score (h, W) of depths (H, W) along the optical axis in some rows of the view; None: all.

        Depths that are not positive are no hypothesis: UNSEEN. Rows within the settings' `support_px` of either end
        are less exact.
        """
        part = rows or slice(0, len(self._grey))
        seen = (depth > 0) & (depth < _FURTHEST_M)
        match_rows(
            *(np.where(seen, depth, np.float32(0)), np.array([part.start, part.stop]), self._mirrored),
            *(self._mean, self._inverse_sigma, self._greys, self._sizes, self._per_depth, self._starts),
            self._largest,
        )
        score = self._filter(part).filter(self._largest[part].mean(axis=1))
        return np.where(seen[part], score, np.float32(UNSEEN))

    def _filter(self, part: slice) -> cv2.ximgproc.GuidedFilter:
        """Return the guided filter of some rows; the rows of a hypothesis are mostly those of the one before."""
        if self._guided is None or self._guided[0] != part:
            guide, settings = np.ascontiguousarray(self._grey[part]), self._settings
            guided = cv2.ximgproc.createGuidedFilter(guide, settings.reach_px, settings.edge_grey**2)
            self._guided = part, guided
        return self._guided[1]


def _stacked(images: list[Float32Array]) -> tuple[Float32Array, Float32Array]:
    """Return images in one array (n, h + 1, w + 1), and the largest column and row (n, 2) of each."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    greys = np.zeros((len(images), height + 1, width + 1), np.float32)
    for grey, image in zip(greys, images, strict=True):
        grey[: image.shape[0], : image.shape[1]] = image
    return greys, np.array([[image.shape[1] - 1, image.shape[0] - 1] for image in images], np.float32)


def _projections(reference: StereoView, neighbours: list[StereoView]) -> tuple[Float32Array, Float32Array]:
    """Return matrices (n, 3, 3) and vectors (n, 3) that project pixels with depths into neighbours."""
    camera = reference.camera
    model_from_pixel = camera.cam_from_model.T @ np.linalg.inv(camera_matrix(camera.pinhole, 0.5))
    per_depth, starts = [], []
    for view in neighbours:
        pixel_from_model = camera_matrix(view.camera.pinhole, 0.5) @ view.camera.cam_from_model
        per_depth.append(pixel_from_model @ model_from_pixel)
        starts.append(pixel_from_model @ (camera.center_in_model - view.camera.center_in_model))
    return np.array(per_depth, np.float32), np.array(starts, np.float32)


@dataclass(frozen=True)
class Winner:
    """Best of a sequence of hypotheses at each pixel (H, W)."""

    hypothesis: FloatArray  # its number, with a fraction
    score: Float32Array  # correlation, −1 … 1
    curvature: Float32Array  # minus the second derivative of the score by the number
    inner: BoolArray  # whether scores of the hypotheses before and after exist


class WinnerTakesAll:
    """Search for the largest of a sequence of score images at each pixel, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._hypothesis = np.full(shape, -2, dtype=np.int32)
        self._best, self._before, self._after, self._last = (np.full(shape, -2.0, np.float32) for _ in range(4))

    def add(self, score: Float32Array) -> None:
        """Take the scores (H, W) of the next hypothesis."""
        images = (score, self._last, self._best, self._before, self._after, self._hypothesis)
        keep_winner(self._count, *(image.reshape(-1) for image in images))
        self._count += 1

    def winner(self) -> Winner:
        """Return the best hypotheses, refined by the parabola through the scores before and after if both exist."""
        inner = (self._before > UNSEEN) & (self._after > UNSEEN)
        curvature = np.maximum(2 * self._best - self._before - self._after, _LEAST_CURVATURE)
        shift = np.where(inner, 0.5 * (self._after - self._before) / curvature, 0.0).clip(-0.5, 0.5)
        return Winner(self._hypothesis + shift, self._best, np.where(inner, curvature, _LEAST_CURVATURE), inner)
