"""Slope of the depth of a Gaussian across the screen, and its derivative, as numba functions.

With V the principal axes along (u, v, z), in rows, D their variances and C the dilated screen covariance, the
slope is q = s C⁻¹ c, c = (V D Vᵀ)_uz,vz. The factor s ≤ 1 keeps z near the depth of the centre, see `api`.
"""

from __future__ import annotations

import math
from typing import Any

from pipelines.splat.rasterizer.api import ALPHA_MIN, DEPTH_REACH
from pipelines.splat.rasterizer.cpu_jit import jit

# Mahalanobis radius at which an opaque Gaussian falls to ALPHA_MIN.
WIDEST = math.sqrt(-2 * math.log(ALPHA_MIN))
# Largest standard deviation of the depth over the screen, in depths of the centre.
_SPREAD_MAX = DEPTH_REACH / WIDEST


@jit
def _free_slope(axes: Any, variance: Any, cov: Any) -> Any:
    """Return c (2), C⁻¹ (xx, xy, yy) and C⁻¹ c (2)."""
    a, b, c = variance
    xz = axes[0] * axes[6] * a + axes[1] * axes[7] * b + axes[2] * axes[8] * c
    yz = axes[3] * axes[6] * a + axes[4] * axes[7] * b + axes[5] * axes[8] * c
    xx, xy, yy = cov
    scale = 1.0 / (xx * yy - xy * xy)
    inverse = (yy * scale, -xy * scale, xx * scale)
    return (xz, yz), inverse, _times(inverse, (xz, yz))


@jit
def _times(symmetric: Any, vector: Any) -> Any:
    xx, xy, yy = symmetric
    x, y = vector
    return xx * x + xy * y, xy * x + yy * y


@jit
def _shrinkage(spread2: float, depth: float) -> float:
    """Return s, given c · C⁻¹ c, the variance of the depth over the screen."""
    most = _SPREAD_MAX * depth
    return most / math.sqrt(spread2) if spread2 > most * most else 1.0


@jit
def depth_slope(axes: Any, variance: Any, cov: Any, depth: float) -> Any:
    """Return ∂z/∂u, ∂z/∂v of a Gaussian in m/px, given V (9), D (3), C (xx, xy, yy) and z of the centre."""
    (xz, yz), _, (qx, qy) = _free_slope(axes, variance, cov)
    s = _shrinkage(xz * qx + yz * qy, depth)
    return s * qx, s * qy


@jit
def depth_slope_gradient(axes: Any, variance: Any, cov: Any, depth: float, g_slope: Any) -> Any:
    """Return the slope and, given ∂L/∂ slope, ∂L/∂c (2), the symmetric ∂L/∂C (xx, xy, yy) and ∂L/∂z."""
    (xz, yz), inverse, (qx, qy) = _free_slope(axes, variance, cov)
    spread2 = xz * qx + yz * qy
    s = _shrinkage(spread2, depth)
    gx, gy = s * g_slope[0], s * g_slope[1]
    g_depth, share = 0.0, 0.0
    if s < 1.0:
        # s = const · z / √(c · C⁻¹ c).
        along = gx * qx + gy * qy
        g_depth, share = along / depth, -along / spread2
    hx, hy = _times(inverse, (gx, gy))
    g_c = (hx + share * qx, hy + share * qy)
    # d(C⁻¹) = −C⁻¹ dC C⁻¹: −½ (h qᵀ + q hᵀ), and half of that share's for the length.
    kx, ky = hx + 0.5 * share * qx, hy + 0.5 * share * qy
    g_cov = (-kx * qx, -0.5 * (kx * qy + ky * qx), -ky * qy)
    return (s * qx, s * qy), g_c, g_cov, g_depth
