"""Projection of one Gaussian to the screen, as numba functions.

Arithmetic is float64 whatever the arrays hold: it is scalar code, where float32 is no faster. Small matrices are
flat tuples, row by row, so that they stay in registers.
"""

from __future__ import annotations

import math
from typing import Any

from pipelines.splat.rasterizer.cpu_jit import jit
from pipelines.splat.rasterizer.cpu_view import View


@jit
def row3(array: Any, i: int) -> Any:
    """Return row i of an (N, 3) array."""
    return float(array[i, 0]), float(array[i, 1]), float(array[i, 2])


@jit
def point_in_cam(pose: Any, mean: Any) -> Any:
    """Return (x, y, z) of a point under the rigid transformation `pose` (3, 4)."""
    x, y, z = mean
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@jit
def unit_quat(quats: Any, i: int) -> Any:
    """Return row i of (N, 4) quaternions at unit length, and the reciprocal of the length."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    scale = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return (w * scale, x * scale, y * scale, z * scale), scale


@jit
def rotation(quat: Any) -> Any:
    """Return the rotation matrix (9) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@jit
def variances(log_scales: Any, i: int) -> Any:
    """Return the variances along the principal axes of Gaussian i."""
    a, b, c = row3(log_scales, i)
    return math.exp(2 * a), math.exp(2 * b), math.exp(2 * c)


@jit
def jacobian(view: View, point: Any) -> Any:
    """Return entries 00, 02, 11, 12 of ∂(u, v)/∂(x, y, z); the others are zero."""
    x, y, z = point
    slope_x = min(max(x / z, view.slope_x_min), view.slope_x_max)
    slope_y = min(max(y / z, view.slope_y_min), view.slope_y_max)
    return view.fx / z, -view.fx * slope_x / z, view.fy / z, -view.fy * slope_y / z


@jit
def screen_from_model(jac: Any, pose: Any) -> Any:
    """Return W (9), the linearised map from the model's frame to (u, v, z)."""
    j00, j02, j11, j12 = jac
    return (
        j00 * pose[0, 0] + j02 * pose[2, 0],
        j00 * pose[0, 1] + j02 * pose[2, 1],
        j00 * pose[0, 2] + j02 * pose[2, 2],
        j11 * pose[1, 0] + j12 * pose[2, 0],
        j11 * pose[1, 1] + j12 * pose[2, 1],
        j11 * pose[1, 2] + j12 * pose[2, 2],
        *(pose[2, 0], pose[2, 1], pose[2, 2]),
    )


@jit
def times_rotation(w: Any, r: Any) -> Any:
    """Return V = W R (9), the principal axes along (u, v, z)."""
    return (
        w[0] * r[0] + w[1] * r[3] + w[2] * r[6],
        w[0] * r[1] + w[1] * r[4] + w[2] * r[7],
        w[0] * r[2] + w[1] * r[5] + w[2] * r[8],
        w[3] * r[0] + w[4] * r[3] + w[5] * r[6],
        w[3] * r[1] + w[4] * r[4] + w[5] * r[7],
        w[3] * r[2] + w[4] * r[5] + w[5] * r[8],
        w[6] * r[0] + w[7] * r[3] + w[8] * r[6],
        w[6] * r[1] + w[7] * r[4] + w[8] * r[7],
        w[6] * r[2] + w[7] * r[5] + w[8] * r[8],
    )


@jit
def screen_covariance(axes: Any, variance: Any, dilation: float) -> Any:
    """Return xx, xy, yy of V diag(σ²) Vᵀ + dilation · I, of the rows u and v of V."""
    a, b, c = variance
    return (
        axes[0] * axes[0] * a + axes[1] * axes[1] * b + axes[2] * axes[2] * c + dilation,
        axes[0] * axes[3] * a + axes[1] * axes[4] * b + axes[2] * axes[5] * c,
        axes[3] * axes[3] * a + axes[4] * axes[4] * b + axes[5] * axes[5] * c + dilation,
    )


@jit
def log_sigmoid(logit: float) -> float:
    """Return ln of the opacity; only called for logit ≥ LOGIT_ALPHA_MIN."""
    return -math.log1p(math.exp(-logit))


@jit
def unit_direction(mean: Any, center: Any) -> Any:
    """Return the unit vector from the camera's centre to a Gaussian, and the reciprocal of their distance."""
    x, y, z = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return (x * scale, y * scale, z * scale), scale


@jit
def sh_colour(sh: Any, i: int, basis: Any, terms: int) -> Any:
    """Return red, green and blue of Gaussian i, not clamped at zero."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(terms):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue
