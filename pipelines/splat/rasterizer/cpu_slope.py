"""Slope of the depth of a Gaussian across the screen, and its derivative, as numba functions.

With V the principal axes along (u, v, z), in rows, D their variances, and K the screen covariance with a part of
the image's dilation, the slope is q = s p, p = K⁻¹ c, c = (V D Vᵀ)_uz,vz. The factor s ≤ 1 keeps z near the depth
of the centre, see `api`; it depends on C, the screen covariance with all of the dilation.
"""

from __future__ import annotations

import math
from typing import Any

from pipelines.splat.rasterizer.api import ALPHA_MIN, DEPTH_REACH, SLOPE_DILATION
from pipelines.splat.rasterizer.cpu_jit import jit

# Mahalanobis radius at which an opaque Gaussian falls to ALPHA_MIN.
WIDEST = math.sqrt(-2 * math.log(ALPHA_MIN))
# Largest standard deviation of the depth over the screen, in depths of the centre.
_SPREAD_MAX = DEPTH_REACH / WIDEST


@jit
def _free_slope(axes: Any, variance: Any, narrow: Any) -> Any:
    """Return K⁻¹ (xx, xy, yy) and p (2), given V (9), D (3) and K (xx, xy, yy)."""
    a, b, c = variance
    xz = axes[0] * axes[6] * a + axes[1] * axes[7] * b + axes[2] * axes[8] * c
    yz = axes[3] * axes[6] * a + axes[4] * axes[7] * b + axes[5] * axes[8] * c
    xx, xy, yy = narrow
    scale = 1.0 / (xx * yy - xy * xy)
    inverse = (yy * scale, -xy * scale, xx * scale)
    return inverse, _times(inverse, (xz, yz))


@jit
def _narrow(cov: Any, dilation: float) -> Any:
    """Return K of C (xx, xy, yy), which is dilated by `dilation`."""
    xx, xy, yy = cov
    less = (1 - SLOPE_DILATION) * dilation
    return xx - less, xy, yy - less


@jit
def _times(symmetric: Any, vector: Any) -> Any:
    xx, xy, yy = symmetric
    x, y = vector
    return xx * x + xy * y, xy * x + yy * y


@jit
def _shrinkage(spread2: float, depth: float) -> float:
    """Return s, given p · C p, the variance of the depth over the screen."""
    most = _SPREAD_MAX * depth
    return most / math.sqrt(spread2) if spread2 > most * most else 1.0


@jit
def depth_slope(axes: Any, variance: Any, cov: Any, dilation: float, depth: float) -> Any:
    """Return ∂z/∂u, ∂z/∂v of a Gaussian in m/px.

    Args:
        axes: V (9).
        variance: D (3).
        cov: C (xx, xy, yy).
        dilation: of C in px².
        depth: z of the centre.
    """
    _, (px, py) = _free_slope(axes, variance, _narrow(cov, dilation))
    wide_x, wide_y = _times(cov, (px, py))
    s = _shrinkage(px * wide_x + py * wide_y, depth)
    return s * px, s * py


@jit
def depth_slope_gradient(axes: Any, variance: Any, cov: Any, dilation: float, depth: float, g_slope: Any) -> Any:
    """Return the slope and, given ∂L/∂ slope, ∂L/∂c (2), the symmetric ∂L/∂C (xx, xy, yy) and ∂L/∂z.

    K and C differ by a constant: ∂L/∂C is that of both.
    """
    inverse, (px, py) = _free_slope(axes, variance, _narrow(cov, dilation))
    wide_x, wide_y = _times(cov, (px, py))
    spread2 = px * wide_x + py * wide_y
    s = _shrinkage(spread2, depth)
    gx, gy = s * g_slope[0], s * g_slope[1]
    g_depth, share = 0.0, 0.0
    if s < 1.0:
        # s = const · z / √(p · C p).
        along = gx * px + gy * py
        g_depth, share = along / depth, -along / spread2
    hx, hy = _times(inverse, (gx + share * wide_x, gy + share * wide_y))
    # d(K⁻¹) = −K⁻¹ dK K⁻¹: −½ (h pᵀ + p hᵀ), and ½ p pᵀ of that share for the dC of the length.
    kx, ky = hx - 0.5 * share * px, hy - 0.5 * share * py
    g_cov = (-kx * px, -0.5 * (kx * py + ky * px), -ky * py)
    return (s * px, s * py), (hx, hy), g_cov, g_depth
