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
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)
_FAST = {"contract", "nsz", "arcp", "reassoc", "nnan", "ninf"}
_UNSEEN = np.float32(-1.0)  # correlation outside a neighbour's image
NOISE_VARIANCE = np.float32(0.3)  # grey levels²: windows that vary less than the sensor's noise do not correlate
_LEAST_DEPTH = np.float32(1e-3)
_ZERO, _ONE, _BYTE = np.float32(0.0), np.float32(1.0), np.uint32(255)
_FURTHEST_M = np.float32(1e7)  # hypotheses beyond are as good as infinite, and kernels need finite numbers
_BEST_VIEWS = 3  # number of neighbours that count, the best of all


@njit(nogil=True, fastmath=_FAST, error_model="numpy", inline="always")
def _reflected(row: int, height: int) -> int:
    """Return the row that a row beyond the image mirrors."""
    inside = -row - 1 if row < 0 else row
    return 2 * height - inside - 1 if inside >= height else inside


@njit(nogil=True, error_model="numpy")
def _finite_row(
    depth: Float32Array,  # (W,) float32
    finite: Float32Array,  # (W,) float32
) -> None:
    """Write the depths of hypotheses into `finite`, 0 for others: here alone NaN and infinity may come in."""
    for i in range(depth.shape[0]):
        usable = (depth[i] > _ZERO) & (depth[i] < _FURTHEST_M)
        finite[i] = depth[i] if usable else _ZERO


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _project_row(
    columns: Float32Array,  # (W,) float32
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
        column, d = columns[i], depth[i]
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
    quads: NDArray[np.uint32],  # (h · w,) uint32
    place: NDArray[np.int32],  # (W,) int32
    fraction: Float32Array,  # (2, W) float32
    miss: Float32Array,  # (W,) float32
    quad: NDArray[np.uint32],  # (W,) uint32
    shown: Float32Array,  # (W,) float32
) -> None:
    """Write the interpolated grey levels at places into `shown` (W,); 0 where the place was missed.

    `quad` (W,) is scratch: reads from anywhere are no vector instructions, and would keep the rest from being some.
    """
    for i in range(place.shape[0]):
        quad[i] = quads[np.uint32(place[i])]
    for i in range(place.shape[0]):
        four = quad[i]
        a, b = np.float32(np.int32(four & _BYTE)), np.float32(np.int32((four >> np.uint32(8)) & _BYTE))
        c, d = np.float32(np.int32((four >> np.uint32(16)) & _BYTE)), np.float32(np.int32(four >> np.uint32(24)))
        above, below = a + fraction[0, i] * (b - a), c + fraction[0, i] * (d - c)
        level = above + fraction[1, i] * (below - above)
        shown[i] = level if miss[i] == _ZERO else _ZERO


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _add_across(
    window: tuple[int, ...],
    reference: Float32Array,  # (W + 2 half,) float32
    padded: Float32Array,  # (W + 2 half,) float32
    sums: Float32Array,  # (3, W) float32
) -> None:
    """Write Σ other, Σ other², Σ reference · other over windows along a row into sums (3, W).

    Both rows (W + 2 half,) are mirrored at their ends; `padded` is that of the neighbour, as the reference sees it.
    """
    for i in range(sums.shape[1]):
        total, square, product = padded[i], padded[i] * padded[i], reference[i] * padded[i]
        for k in range(1, len(window)):
            level = padded[i + k]
            total += level
            square += level * level
            product += reference[i + k] * level
        sums[0, i], sums[1, i], sums[2, i] = total, square, product


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
    window: tuple[int, ...],
    ring: Float32Array,  # (window, 3, W) float32
    shown: Float32Array,  # (W,) float32
    mean: Float32Array,  # (W,) float32
    inverse_sigma: Float32Array,  # (W,) float32
    score: Float32Array,  # (W,) float32
) -> None:
    """Write the correlation of a row with a neighbour into score (W,).

    The ring (window, 3, W) has sums along the rows of the window, `shown` (W,) the neighbour's grey levels at the
    row itself, mean and inverse σ (W,) are those of the reference's windows.
    """
    share = np.float32(1.0 / (len(window) * len(window)))
    for i in range(shown.shape[0]):
        total, square, product = ring[0, 0, i], ring[0, 1, i], ring[0, 2, i]
        for k in range(1, len(window)):
            total += ring[k, 0, i]
            square += ring[k, 1, i]
            product += ring[k, 2, i]
        other = total * share
        variance = max(square * share - other * other, NOISE_VARIANCE)
        level = (product * share - mean[i] * other) * inverse_sigma[i] / np.sqrt(variance)
        score[i] = _UNSEEN if shown[i] == _ZERO else level


@njit(nogil=True, fastmath=_FAST, error_model="numpy")
def _keep_largest(
    score: Float32Array,  # (W,) float32
    largest: Float32Array,  # (3, W) float32
) -> None:
    """Insert scores (W,) into the three largest (3, W) so far, largest first."""
    for i in range(score.shape[0]):
        new = score[i]
        first, second, third = largest[0, i], largest[1, i], largest[2, i]
        largest[0, i], new = max(first, new), min(first, new)
        largest[1, i], new = max(second, new), min(second, new)
        largest[2, i] = max(third, new)


@kernel(nogil=True, fastmath=_FAST, error_model="numpy")
def match_rows(
    window: tuple[int, ...],
    depth: Float32Array,  # (H, W) float32
    rows: IntArray,  # (2,) int64
    reference: Float32Array,  # (H, W + 2 half) float32
    mean: Float32Array,  # (H, W) float32
    inverse_sigma: Float32Array,  # (H, W) float32
    quads: NDArray[np.uint32],  # (n, h, w) uint32
    sizes: Float32Array,  # (n, 2) float32
    per_depth: Float32Array,  # (n, 3, 3) float32
    starts: Float32Array,  # (n, 3) float32
    out: Float32Array,  # (H, W) float32
) -> None:
    """Write the mean of the best correlations of some rows of a view with n neighbours, for a hypothesis of depth.

    Args:
        window: as many numbers as the window has pixels along its side. Their count is known to the compiler, which
            makes one kernel for each, without loops over the window.
        depth: (H, W) hypothesis.
        rows: (2,) first row and the row after the last.
        reference: (H, W + 2 half) grey levels, mirrored at the ends of rows; half = window // 2.
        mean: (H, W) of the reference's windows.
        inverse_sigma: (H, W) of the reference's windows.
        quads: (n, h, w) grey levels of the neighbours, as `StereoView` packs them.
        sizes: (n, 2) largest column and row of each neighbour, float32.
        per_depth: (n, 3, 3) float32, starts: (n, 3) float32: of a pixel (column, row) at depth d, the neighbour's
            homogeneous pixel is d · per_depth · (column, row, 1) + start.
        out: (H, W) mean of the three largest correlations, or of all if there are fewer.
    """
    count, height, width = len(quads), depth.shape[0], depth.shape[1]
    side, half, stride, counted = len(window), len(window) // 2, quads.shape[2], min(count, _BEST_VIEWS)
    flat, columns = quads.reshape(count, -1), np.arange(width).astype(np.float32)
    ring = np.empty((count, side, 3, width), np.float32)
    shown = np.zeros((count, side, width + 2 * half), np.float32)
    place, quad = np.empty(width, np.int32), np.empty(width, np.uint32)
    fraction, finite = np.empty((2, width), np.float32), np.empty(width, np.float32)
    miss, score = np.empty(width, np.float32), np.empty(width, np.float32)
    largest = np.empty((_BEST_VIEWS, width), np.float32)
    for pushed in range(rows[0] - half, rows[1] + half):
        row, slot = _reflected(pushed, height), (pushed + side) % side
        done = pushed - half
        _finite_row(depth[row], finite)
        largest[:] = np.float32(-2.0)
        for k in range(count):
            _project_row(columns, finite, row, per_depth[k], starts[k], sizes[k], stride, place, fraction, miss)
            _sample_row(flat[k], place, fraction, miss, quad, shown[k, slot, half : half + width])
            _mirror_ends(shown[k, slot], half)
            _add_across(window, reference[row], shown[k, slot], ring[k, slot])
            if done >= rows[0]:
                middle = shown[k, (done + side) % side, half : half + width]
                _correlate_row(window, ring[k], middle, mean[done], inverse_sigma[done], score)
                _keep_largest(score, largest)
        if done >= rows[0]:
            out[done] = largest[:counted].sum(axis=0) / np.float32(counted)


@kernel(nogil=True, error_model="numpy")
def keep_winner(
    number: int,
    first: int,
    score: Float32Array,  # (h, W) float32
    seen: BoolArray,  # (H, W) bool
    last: Float32Array,  # (H, W) float32
    best: Float32Array,  # (H, W) float32
    before: Float32Array,  # (H, W) float32
    after: Float32Array,  # (H, W) float32
    hypothesis: NDArray[np.int32],  # (H, W) int32
) -> None:
    """Compare the scores of hypothesis `number` with the best so far, pixel by pixel.

    Args:
        number: of the hypothesis, from 0.
        first: row of the first scores.
        score: (h, W) its scores; it has none in other rows.
        seen: (H, W) whether it has a score.
        last: (H, W) scores of the hypothesis before; receives those of this one.
        best: (H, W) largest scores so far.
        before: (H, W) scores of the hypotheses before the best ones.
        after: (H, W) scores of those after the best ones.
        hypothesis: (H, W) numbers of the best, int32.
    """
    for row in range(seen.shape[0]):
        if row < first or row >= first + score.shape[0]:
            last[row] = _UNSEEN
            continue
        for i in range(seen.shape[1]):
            new = score[row - first, i] if seen[row, i] else _UNSEEN
            better, next_ = new > best[row, i], hypothesis[row, i] == number - 1
            after[row, i] = np.float32(-2.0) if better else (new if next_ else after[row, i])
            before[row, i] = last[row, i] if better else before[row, i]
            hypothesis[row, i] = np.int32(number) if better else hypothesis[row, i]
            best[row, i] = new if better else best[row, i]
            last[row, i] = new


UNSEEN = float(_UNSEEN)
_LEAST_CURVATURE = 1e-6


@dataclass(frozen=True)
class StereoView:
    """Photograph (H, W) with its camera; grey levels 1 … 255, 0 outside the photograph's valid part."""

    camera: ViewPose
    grey: ByteArray

    @cached_property
    def quads(self) -> NDArray[np.uint32]:
        """Grey levels (H, W) of four pixels in a number: of this one in the lowest byte, the next, the two below.

        Interpolation then reads one place of the memory instead of four. Beyond the photograph are zeros.
        """
        grey = np.pad(self.grey, ((0, 1), (0, 1))).astype(np.uint32)
        pairs = grey[:, :-1] | grey[:, 1:] << 8
        return np.asarray(pairs[:-1] | pairs[1:] << 16)


def camera_matrix(camera: Pinhole, offset_px: float = 0.0) -> FloatArray:
    """Return the camera matrix (3, 3); OpenCV counts pixels from the centre of the first, an offset of 0.5."""
    return np.array([[camera.fx, 0, camera.cx - offset_px], [0, camera.fy, camera.cy - offset_px], [0, 0, 1]])


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the comparison."""

    window_px: int = 5  # side of the correlation window, odd
    reach_px: int = 6  # radius of the guided filter that averages correlations
    edge_grey: float = 10.0  # step in grey levels across which the filter does not average

    @property
    def support_px(self) -> int:
        """Distance from a pixel up to which its score depends on the image: the guided filter averages averages."""
        return self.window_px // 2 + 2 * self.reach_px


class Matcher:
    """Compares a photograph (H, W) with its neighbours under hypotheses of depth."""

    def __init__(self, reference: StereoView, neighbours: list[StereoView], settings: MatchSettings) -> None:
        grey, side = reference.grey.astype(np.float32), (settings.window_px, settings.window_px)
        self._settings, self._grey = settings, grey
        self._mean, square = (
            np.asarray(cv2.boxFilter(image, -1, side, borderType=cv2.BORDER_REFLECT), np.float32)
            for image in (grey, grey * grey)
        )
        variance = square - self._mean * self._mean
        self._inverse_sigma = (1 / np.sqrt(np.maximum(variance, NOISE_VARIANCE))).astype(np.float32)
        half = settings.window_px // 2
        self._mirrored = np.pad(grey, ((0, 0), (half, half)), mode="symmetric")
        self._quads, self._sizes = _stacked([view.quads for view in neighbours])
        self._per_depth, self._starts = _projections(reference, neighbours)
        self._mean_of_best = np.empty(grey.shape, np.float32)
        self._guided: tuple[slice, cv2.ximgproc.GuidedFilter] | None = None

    def __call__(self, depth: Float32Array, rows: slice | None = None) -> Float32Array:
        """Return the score (h, W) of depths (H, W) along the optical axis in some rows of the view; None: all.

        It says nothing where a depth is no hypothesis. Rows within the settings' `support_px` of either end are
        less exact.
        """
        part = rows or slice(0, len(self._grey))
        if part.start == part.stop:
            return self._mean_of_best[part]
        match_rows(
            *(tuple(range(self._settings.window_px)), depth, np.array([part.start, part.stop]), self._mirrored),
            *(self._mean, self._inverse_sigma, self._quads, self._sizes, self._per_depth, self._starts),
            self._mean_of_best,
        )
        return np.asarray(self._filter(part).filter(self._mean_of_best[part]), np.float32)

    def _filter(self, part: slice) -> cv2.ximgproc.GuidedFilter:
        """Return the guided filter of some rows; the rows of a hypothesis are mostly those of the one before."""
        if self._guided is None or self._guided[0] != part:
            guide, settings = np.ascontiguousarray(self._grey[part]), self._settings
            guided = cv2.ximgproc.createGuidedFilter(guide, settings.reach_px, settings.edge_grey**2)
            self._guided = part, guided
        return self._guided[1]


def is_hypothesis(depth: Float32Array) -> BoolArray:
    """Return whether depths (H, W) are such that a place can lie at them: positive, and not as good as infinite."""
    return np.asarray((depth > 0) & (depth < _FURTHEST_M))


def _stacked(images: list[NDArray[np.uint32]]) -> tuple[NDArray[np.uint32], Float32Array]:
    """Return images in one array (n, h, w), and the largest column and row (n, 2) of each."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    stacked = np.zeros((len(images), height, width), np.uint32)
    for whole, image in zip(stacked, images, strict=True):
        whole[: image.shape[0], : image.shape[1]] = image
    return stacked, np.array([[image.shape[1] - 1, image.shape[0] - 1] for image in images], np.float32)


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

    def __init__(self, shape: tuple[int, int]) -> None:
        self._count = 0
        self._hypothesis, self._best = np.zeros(shape, dtype=np.int32), np.full(shape, _UNSEEN)
        self._before, self._after, self._last = (np.full(shape, -2.0, np.float32) for _ in range(3))

    def add(self, score: Float32Array, seen: BoolArray, first: int = 0) -> None:
        """Take the scores (h, W) of the next hypothesis in the rows from `first` on, where it is `seen` (H, W)."""
        images = (self._last, self._best, self._before, self._after, self._hypothesis)
        keep_winner(self._count, first, score, seen, *images)
        self._count += 1

    def winner(self) -> Winner:
        """Return the best hypotheses, refined by the parabola through the scores before and after if both exist."""
        inner = (self._before > UNSEEN) & (self._after > UNSEEN)
        curvature = np.maximum(2 * self._best - self._before - self._after, _LEAST_CURVATURE)
        shift = np.where(inner, 0.5 * (self._after - self._before) / curvature, 0.0).clip(-0.5, 0.5)
        return Winner(self._hypothesis + shift, self._best, np.where(inner, curvature, _LEAST_CURVATURE), inner)
