"""Numba kernels of the photometric loss: L1 and SSIM of two images, value and gradient, rows over threads.

An image is (H, W·3), a row its interleaved channels. A blur along the row is then one loop with taps three elements
apart, the same for every channel, and vectorises. Each row is blurred along x once, kept in a ring of the last
eleven rows, and blurred along y from there. A pixel's result depends neither on the bands nor on the threads.

Numbers are float32 or float64, like the images; sums over pixels are float64.
"""

# ruff: noqa: PLR0917  (kernels take arrays, not objects)

import numpy as np
from numba import njit, prange
from numpy.typing import DTypeLike

from pipelines.core.types import ArrayHW, ArrayN, ArrayNHW, ArrayNK, FloatArray
from pipelines.splat.kernel_cache import kernel

RADIUS = 5
WINDOW = 2 * RADIUS + 1
SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2
PAD = 3 * RADIUS

_FAST = {"contract", "reassoc", "nsz"}


def gaussian_taps(dtype: DTypeLike) -> np.ndarray:
    """Return half of the window's weights (6,), centre first."""
    offset = np.arange(-RADIUS, RADIUS + 1)
    window = np.exp(-(offset**2) / (2 * SIGMA_PX**2))
    return (window / window.sum())[RADIUS:].astype(dtype)


@njit(fastmath=_FAST)
def _blur_along_row(
    padded: ArrayN,  # (n + 2 PAD,) float32/64
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    out: ArrayN,  # (n,) float32/64
) -> None:
    k0, k1, k2, k3, k4, k5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for j in range(out.shape[0]):
        out[j] = (
            k0 * padded[j + 15]
            + k1 * (padded[j + 12] + padded[j + 18])
            + k2 * (padded[j + 9] + padded[j + 21])
            + k3 * (padded[j + 6] + padded[j + 24])
            + k4 * (padded[j + 3] + padded[j + 27])
            + k5 * (padded[j] + padded[j + 30])
        )


@njit(fastmath=_FAST)
def _blur_across_rows(
    ring: ArrayNK,  # (WINDOW, n) float32/64
    row: int,
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    out: ArrayN,  # (n,) float32/64
) -> None:
    """Blur `row` across rows, from a ring (11, n) in which row r lies at r mod 11."""
    centre = ring[row % WINDOW]
    for j in range(out.shape[0]):
        out[j] = taps[0] * centre[j]
    for t in range(1, RADIUS + 1):
        weight = taps[t]
        above, below = ring[(row - t) % WINDOW], ring[(row + t) % WINDOW]
        for j in range(out.shape[0]):
            out[j] += weight * (above[j] + below[j])


@njit(fastmath=_FAST)
def _load_masked(
    image: ArrayHW,  # (H, n) float32/64
    valid: ArrayHW,  # (H, W) or (0, 0) bool
    row: int,
    padded: ArrayN,  # (n + 2 PAD,) float32/64
) -> None:
    """Load a row between its zero margins; pixels that do not count are zero, like those outside the image."""
    source = image[row]
    for j in range(source.shape[0]):
        padded[PAD + j] = source[j]
    if valid.shape[0] > 0:
        for x in range(valid.shape[1]):
            if not valid[row, x]:
                for c in range(3):
                    padded[PAD + 3 * x + c] = 0


@njit(fastmath=_FAST)
def _push_moments(
    rendered: ArrayHW,  # (H, n) float32/64
    target: ArrayHW,  # (H, n) float32/64
    valid: ArrayHW,  # (H, W) or (0, 0) bool
    row: int,
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    padded: ArrayNK,  # (3, n + 2 PAD) float32/64
    ring: ArrayNHW,  # (5, WINDOW, n) float32/64
) -> None:
    """Blur x, y, x², y², xy of a row along the row, into the five rings (5, 11, n)."""
    slot, n = row % WINDOW, rendered.shape[1]
    if row >= rendered.shape[0]:
        ring[:, slot] = 0
        return
    x, y, product = padded[0], padded[1], padded[2]
    _load_masked(rendered, valid, row, x)
    _load_masked(target, valid, row, y)
    _blur_along_row(x, taps, ring[0, slot])
    _blur_along_row(y, taps, ring[1, slot])
    for j in range(n + 2 * PAD):
        product[j] = x[j] * x[j]
    _blur_along_row(product, taps, ring[2, slot])
    for j in range(n + 2 * PAD):
        product[j] = y[j] * y[j]
    _blur_along_row(product, taps, ring[3, slot])
    for j in range(n + 2 * PAD):
        product[j] = x[j] * y[j]
    _blur_along_row(product, taps, ring[4, slot])


@njit(fastmath=_FAST)
def _ssim_row(
    moments: ArrayNK,  # (5, n) float32/64
    c1: float,  # of the images' type
    c2: float,  # of the images' type
    partials: ArrayNHW,  # (3, H, n) float32/64
    row: int,
) -> None:
    """Write SSIM of a row into moments[0], its derivatives by the blurred x, x² and xy into partials (3, H, n)."""
    mu_x, mu_y, xx, yy, xy = moments[0], moments[1], moments[2], moments[3], moments[4]
    one = c1 / c1  # of the images' type: a literal would turn the loop to float64
    d_mu, d_xx, d_xy = partials[0, row], partials[1, row], partials[2, row]
    for j in range(mu_x.shape[0]):
        mx, my = mu_x[j], mu_y[j]
        mxx, myy, mxy = mx * mx, my * my, mx * my
        cov = xy[j] - mxy
        a, b = mxy + mxy + c1, cov + cov + c2
        c, d = mxx + myy + c1, (xx[j] - mxx) + (yy[j] - myy) + c2
        inverse = one / (c * d)
        ssim = a * b * inverse
        by_xx, by_xy = -ssim / d, (a + a) * inverse
        by_mu = my * (b + b) * inverse - (mx + mx) * (ssim / c + by_xx) - my * by_xy
        d_mu[j], d_xx[j], d_xy[j] = by_mu, by_xx, by_xy
        mu_x[j] = ssim


@njit(fastmath=_FAST)
def _sum_row(
    x: ArrayN,  # (n + 2 PAD,) float32/64
    y: ArrayN,  # (n + 2 PAD,) float32/64
    ssim: ArrayN,  # (n,) float32/64
) -> tuple[float, float]:
    """Return Σ|x − y| and Σ SSIM of a row, in float64."""
    absolute, similarity = 0.0, 0.0
    for j in range(x.shape[0]):
        absolute += abs(np.float64(x[j] - y[j]))
    for j in range(ssim.shape[0]):
        similarity += np.float64(ssim[j])
    return absolute, similarity


@njit(fastmath=_FAST)
def _clear_invalid(
    valid: ArrayHW,  # (H, W) or (0, 0) bool
    row: int,
    ssim: ArrayN,  # (n,) float32/64
    partials: ArrayNHW,  # (3, H, n) float32/64
) -> None:
    for x in range(valid.shape[1]):
        if not valid[row, x]:
            for j in range(3 * x, 3 * x + 3):
                ssim[j] = 0
                for q in range(3):
                    partials[q, row, j] = 0


@kernel(parallel=True, fastmath=_FAST)
def ssim_forward(
    rendered: ArrayHW,  # (H, n) float32/64
    target: ArrayHW,  # (H, n) float32/64
    valid: ArrayHW,  # (H, W) or (0, 0) bool
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    c1: float,  # of the images' type
    c2: float,  # of the images' type
    bands: int,
    partials: ArrayNHW,  # (3, H, n) float32/64
    sums: FloatArray,  # (H, 2) float64
) -> None:
    """Write Σ|x − y| and Σ SSIM of each row into sums (H, 2), and SSIM's derivatives into partials (3, H, n).

    Args:
        rendered, target: (H, n) with n = 3 W.
        valid: (H, W) bool of the pixels that count, or (0, 0) for all.
        taps: (6,) from `gaussian_taps`.
        c1, c2: SSIM's constants, of the images' type.
        bands: number of blocks of rows that share the work.
        partials: (3, H, n) output: ∂SSIM by the blurred x, x² and xy.
        sums: (H, 2) float64 output.
    """
    height, n = rendered.shape
    for band in prange(bands):
        begin, end = band * height // bands, (band + 1) * height // bands
        padded = np.zeros((3, n + 2 * PAD), dtype=rendered.dtype)
        ring = np.zeros((5, WINDOW, n), dtype=rendered.dtype)
        moments = np.empty((5, n), dtype=rendered.dtype)
        for row in range(max(0, begin - RADIUS), begin + RADIUS):
            _push_moments(rendered, target, valid, row, taps, padded, ring)
        for row in range(begin, end):
            _push_moments(rendered, target, valid, row + RADIUS, taps, padded, ring)
            for q in range(5):
                _blur_across_rows(ring[q], row, taps, moments[q])
            _ssim_row(moments, c1, c2, partials, row)
            if valid.shape[0] > 0:
                _clear_invalid(valid, row, moments[0], partials)
            _load_masked(rendered, valid, row, padded[0])
            _load_masked(target, valid, row, padded[1])
            sums[row, 0], sums[row, 1] = _sum_row(padded[0], padded[1], moments[0])


@njit(fastmath=_FAST)
def _push_partials(
    partials: ArrayNHW,  # (3, H, n) float32/64
    row: int,
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    padded: ArrayN,  # (n + 2 PAD,) float32/64
    ring: ArrayNHW,  # (3, WINDOW, n) float32/64
) -> None:
    slot = row % WINDOW
    if row >= partials.shape[1]:
        ring[:, slot] = 0
        return
    for q in range(3):
        source = partials[q, row]
        for j in range(source.shape[0]):
            padded[PAD + j] = source[j]
        _blur_along_row(padded, taps, ring[q, slot])


@njit(fastmath=_FAST)
def _gradient_row(
    x: ArrayN,  # (n,) float32/64
    y: ArrayN,  # (n,) float32/64
    blurred: ArrayNK,  # (3, n) float32/64
    l1_weight: float,  # of the images' type
    ssim_weight: float,  # of the images' type
    out: ArrayN,  # (n,) float32/64
) -> None:
    by_mu, by_xx, by_xy = blurred[0], blurred[1], blurred[2]
    for j in range(out.shape[0]):
        difference = x[j] - y[j]
        sign = l1_weight if difference > 0 else -l1_weight
        sign = sign if difference != 0 else difference
        out[j] = sign - ssim_weight * (by_mu[j] + (x[j] + x[j]) * by_xx[j] + y[j] * by_xy[j])


@kernel(parallel=True, fastmath=_FAST)
def ssim_backward(
    rendered: ArrayHW,  # (H, n) float32/64
    target: ArrayHW,  # (H, n) float32/64
    valid: ArrayHW,  # (H, W) or (0, 0) bool
    partials: ArrayNHW,  # (3, H, n) float32/64
    taps: ArrayN,  # (RADIUS + 1,) float32/64
    l1_weight: float,  # of the images' type
    ssim_weight: float,  # of the images' type
    bands: int,
    gradient: ArrayHW,  # (H, n) float32/64
) -> None:
    """Write ∂(l1_weight · Σ|x − y| − ssim_weight · Σ SSIM)/∂x into gradient (H, n).

    The window is symmetric and the margins are zero: the blur is its own adjoint.
    """
    height, n = rendered.shape
    for band in prange(bands):
        begin, end = band * height // bands, (band + 1) * height // bands
        padded = np.zeros(n + 2 * PAD, dtype=rendered.dtype)
        ring = np.zeros((3, WINDOW, n), dtype=rendered.dtype)
        blurred = np.empty((3, n), dtype=rendered.dtype)
        for row in range(max(0, begin - RADIUS), begin + RADIUS):
            _push_partials(partials, row, taps, padded, ring)
        for row in range(begin, end):
            _push_partials(partials, row + RADIUS, taps, padded, ring)
            for q in range(3):
                _blur_across_rows(ring[q], row, taps, blurred[q])
            out = gradient[row]
            _gradient_row(rendered[row], target[row], blurred, l1_weight, ssim_weight, out)
            if valid.shape[0] > 0:
                for x in range(valid.shape[1]):
                    if not valid[row, x]:
                        out[3 * x : 3 * x + 3] = 0
