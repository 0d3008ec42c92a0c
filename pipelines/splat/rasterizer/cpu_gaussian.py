"""Numba functions for one Gaussian: its projection to the screen, slope of its depth, and colour; the camera's
form.

Arithmetic is float64 whatever the arrays hold: it is scalar code, where float32 is no faster. Small matrices are
flat tuples, row by row, so that they stay in registers. Order, signs and polynomials of the spherical harmonics are
those of 3DGS (doi 10.1145/3592433).

With V the principal axes along (u, v, z), in rows, D their variances, and K the screen covariance with a part of
the image's dilation, the slope is q = s p, p = K⁻¹ c, c = (V D Vᵀ)_uz,vz. The factor s ≤ 1 keeps z near the depth
of the centre, see `api`; it depends on C, the screen covariance with all of the dilation.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from pipelines.core.types import (
    Array34,
    ArrayN,
    ArrayN3,
    ArrayN4,
    ArrayNK3,
    FloatArray,
    Matrix9,
    Vector2,
    Vector3,
    Vector4,
)
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import ALPHA_MIN, DEPTH_REACH, SLOPE_DILATION, RasterSettings
from pipelines.splat.rasterizer.cpu_lanes import jit
from pipelines.splat.rasterizer.reference import FRUSTUM_MARGIN

# N_lm of the real spherical harmonics; the other factor of each is a polynomial of the direction.
_C0 = math.sqrt(1 / (4 * math.pi))
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))
_C2_ZONAL = math.sqrt(5 / (16 * math.pi))
_C3_3 = math.sqrt(35 / (32 * math.pi))
_C3_2 = math.sqrt(105 / (4 * math.pi))
_C3_1 = math.sqrt(21 / (32 * math.pi))
_C3_0 = math.sqrt(7 / (16 * math.pi))

MAX_COEFFICIENTS = 16


@jit
def sh_basis(
    direction: Vector3,
    degree: int,
    basis: ArrayN,  # (MAX_COEFFICIENTS,) float64
) -> None:
    """Write the (degree + 1)² functions of a unit vector (x, y, z) into `basis` (16,)."""
    x, y, z = direction
    basis[0] = _C0
    if degree < 1:
        return
    basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = _C2 * x * y
    basis[5] = -_C2 * y * z
    basis[6] = _C2_ZONAL * (2 * zz - xx - yy)
    basis[7] = -_C2 * x * z
    basis[8] = 0.5 * _C2 * (xx - yy)
    if degree < 3:
        return
    basis[9] = -_C3_3 * y * (3 * xx - yy)
    basis[10] = _C3_2 * x * y * z
    basis[11] = -_C3_1 * y * (4 * zz - xx - yy)
    basis[12] = _C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
    basis[13] = -_C3_1 * x * (4 * zz - xx - yy)
    basis[14] = 0.5 * _C3_2 * z * (xx - yy)
    basis[15] = -_C3_3 * x * (xx - 3 * yy)


@jit
def sh_direction_gradient(
    direction: Vector3,
    degree: int,
    weight: ArrayN,  # (MAX_COEFFICIENTS,) float64
) -> Any:
    """Return Σ_k weight[k] · ∂basis[k]/∂(x, y, z), with the polynomials as functions of all space."""
    x, y, z = direction
    gx, gy, gz = 0.0, 0.0, 0.0
    if degree >= 1:
        gx, gy, gz = -_C1 * weight[3], -_C1 * weight[1], _C1 * weight[2]
    if degree >= 2:
        zonal, planar = 2 * _C2_ZONAL * weight[6], _C2 * weight[8]
        gx += _C2 * (y * weight[4] - z * weight[7]) + x * (planar - zonal)
        gy += _C2 * (x * weight[4] - z * weight[5]) - y * (planar + zonal)
        gz += -_C2 * (y * weight[5] + x * weight[7]) + 2 * z * zonal
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        w9, w10, w11 = _C3_3 * weight[9], _C3_2 * weight[10], _C3_1 * weight[11]
        w12, w13 = _C3_0 * weight[12], _C3_1 * weight[13]
        w14, w15 = 0.5 * _C3_2 * weight[14], _C3_3 * weight[15]
        gx += -6 * x * y * w9 + y * z * w10 + 2 * x * y * w11 - 6 * x * z * w12
        gx += (3 * xx + yy - 4 * zz) * w13 + 2 * x * z * w14 + 3 * (yy - xx) * w15
        gy += 3 * (yy - xx) * w9 + x * z * w10 + (xx + 3 * yy - 4 * zz) * w11 - 6 * y * z * w12
        gy += 2 * x * y * w13 - 2 * y * z * w14 + 6 * x * y * w15
        gz += x * y * w10 - 8 * y * z * w11 + (6 * zz - 3 * xx - 3 * yy) * w12
        gz += -8 * x * z * w13 + (xx - yy) * w14
    return gx, gy, gz


# Mahalanobis radius at which an opaque Gaussian falls to ALPHA_MIN.
WIDEST = math.sqrt(-2 * math.log(ALPHA_MIN))
# Largest standard deviation of the depth over the screen, in depths of the centre.
_SPREAD_MAX = DEPTH_REACH / WIDEST


@jit
def _free_slope(axes: Matrix9, variance: Vector3, narrow: Vector3) -> Any:
    """Return K⁻¹ (xx, xy, yy) and p (2), given V (9), D (3) and K (xx, xy, yy)."""
    a, b, c = variance
    xz = axes[0] * axes[6] * a + axes[1] * axes[7] * b + axes[2] * axes[8] * c
    yz = axes[3] * axes[6] * a + axes[4] * axes[7] * b + axes[5] * axes[8] * c
    xx, xy, yy = narrow
    scale = 1.0 / (xx * yy - xy * xy)
    inverse = (yy * scale, -xy * scale, xx * scale)
    return inverse, _times(inverse, (xz, yz))


@jit
def _narrow(cov: Vector3, dilation: float) -> Any:
    """Return K of C (xx, xy, yy), which is dilated by `dilation`."""
    xx, xy, yy = cov
    less = (1 - SLOPE_DILATION) * dilation
    return xx - less, xy, yy - less


@jit
def _times(symmetric: Vector3, vector: Vector2) -> Any:
    xx, xy, yy = symmetric
    x, y = vector
    return xx * x + xy * y, xy * x + yy * y


@jit
def _shrinkage(spread2: float, depth: float) -> float:
    """Return s, given p · C p, the variance of the depth over the screen."""
    most = _SPREAD_MAX * depth
    return most / math.sqrt(spread2) if spread2 > most * most else 1.0


@jit
def depth_slope(axes: Matrix9, variance: Vector3, cov: Vector3, dilation: float, depth: float) -> Any:
    """Return ∂z/∂u, ∂z/∂v of a Gaussian in m/px, given V (9), D (3), C (xx, xy, yy) and its dilation, and z."""
    _, (px, py) = _free_slope(axes, variance, _narrow(cov, dilation))
    wide_x, wide_y = _times(cov, (px, py))
    s = _shrinkage(px * wide_x + py * wide_y, depth)
    return s * px, s * py


@jit
def depth_slope_gradient(
    axes: Matrix9, variance: Vector3, cov: Vector3, dilation: float, depth: float, g_slope: Vector2
) -> Any:
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


class View(NamedTuple):
    """Camera of the kernels: lengths in pixels, slopes x/z and y/z, near plane in metres.

    A standard deviation of 1 m at a depth of 1 m is at most `stretch_x` px wide and `stretch_y` px high.
    """

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    slope_x_min: float
    slope_x_max: float
    slope_y_min: float
    slope_y_max: float
    near: float
    dilation: float
    mip_filter: bool
    stretch_x: float
    stretch_y: float


def make_view(camera: Pinhole, settings: RasterSettings, pose: FloatArray) -> View:
    """Return the kernels' form of `camera`; the Jacobian is taken no further out than its slopes, as in gsplat."""
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    slope_x_min, slope_x_max = -camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x
    slope_y_min, slope_y_max = -camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y
    # The norm of a rotation is 1. Derivatives vary all entries of the pose, however, and leave the rotations.
    norm = float(np.linalg.norm(pose[:, :3], 2))
    image = settings.image_of(camera)
    return View(
        width=float(image.width),
        height=float(image.height),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(image.cx),
        cy=float(image.cy),
        slope_x_min=slope_x_min,
        slope_x_max=slope_x_max,
        slope_y_min=slope_y_min,
        slope_y_max=slope_y_max,
        near=float(settings.near_m),
        dilation=float(settings.dilation_px2),
        mip_filter=settings.mip_filter,
        stretch_x=camera.fx * norm * math.hypot(1.0, max(-slope_x_min, slope_x_max)),
        stretch_y=camera.fy * norm * math.hypot(1.0, max(-slope_y_min, slope_y_max)),
    )


@jit
def row3(
    array: ArrayN3,  # (N, 3) float32/64
    i: int,
) -> Any:
    """Return row i of an array (N, 3) as three numbers in double precision."""
    return float(array[i, 0]), float(array[i, 1]), float(array[i, 2])


@jit
def transformed_point(
    pose: Array34,  # (3, 4) float64
    mean: Vector3,
) -> Any:
    """Return (x, y, z) of a point under the rigid transformation `pose` (3, 4)."""
    x, y, z = mean
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@jit
def unit_quat(
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    i: int,
) -> Any:
    """Return row i of (N, 4) quaternions at unit length, and the reciprocal of the length."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    scale = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return (w * scale, x * scale, y * scale, z * scale), scale


@jit
def rotation(quat: Vector4) -> Any:
    """Return the rotation matrix (9) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@jit
def shortest_axis(
    log_scales: ArrayN3,  # (N, 3) float32/64
    i: int,
) -> int:
    """Return the principal axis (0, 1 or 2) of the smallest deviation of Gaussian i; the first of equal ones."""
    a, b, c = row3(log_scales, i)
    shortest = 1 if b < a else 0
    return 2 if c < min(a, b) else shortest


@jit
def facing_normal(turn: Matrix9, axis: int, ray: Vector3) -> Any:
    """Return a column of a rotation matrix (9), and the sign that it is multiplied by to point against a ray."""
    x, y, z = turn[0], turn[3], turn[6]
    if axis == 1:
        x, y, z = turn[1], turn[4], turn[7]
    elif axis == 2:
        x, y, z = turn[2], turn[5], turn[8]
    sign = -1.0 if x * ray[0] + y * ray[1] + z * ray[2] > 0.0 else 1.0
    return (sign * x, sign * y, sign * z), sign


@jit
def variances(
    log_scales: ArrayN3,  # (N, 3) float32/64
    i: int,
) -> Any:
    """Return the variances of Gaussian i along its principal axes, from natural logarithms of deviations (N, 3)."""
    a, b, c = row3(log_scales, i)
    return math.exp(2 * a), math.exp(2 * b), math.exp(2 * c)


@jit
def jacobian(view: View, point: Vector3) -> Any:
    """Return entries 00, 02, 11, 12 of ∂(u, v)/∂(x, y, z); the others are zero."""
    x, y, z = point
    slope_x = min(max(x / z, view.slope_x_min), view.slope_x_max)
    slope_y = min(max(y / z, view.slope_y_min), view.slope_y_max)
    return view.fx / z, -view.fx * slope_x / z, view.fy / z, -view.fy * slope_y / z


@jit
def screen_from_model(
    jac: Vector4,
    pose: Array34,  # (3, 4) float64
) -> Any:
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
def times_rotation(w: Matrix9, r: Matrix9) -> Any:
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
def screen_covariance(axes: Matrix9, variance: Vector3, dilation: float) -> Any:
    """Return xx, xy, yy of V diag(σ²) Vᵀ + dilation · I, of the rows u and v of V."""
    a, b, c = variance
    return (
        axes[0] * axes[0] * a + axes[1] * axes[1] * b + axes[2] * axes[2] * c + dilation,
        axes[0] * axes[3] * a + axes[1] * axes[4] * b + axes[2] * axes[5] * c,
        axes[3] * axes[3] * a + axes[4] * axes[4] * b + axes[5] * axes[5] * c + dilation,
    )


@jit
def log_compensation(cov: Vector3, dilation: float) -> float:
    """Return ln √(|C less its dilation| / |C|) of C (xx, xy, yy); −∞: seen edge-on, nothing is left."""
    xx, xy, yy = cov
    before = (xx - dilation) * (yy - dilation) - xy * xy
    return 0.5 * math.log(before / (xx * yy - xy * xy)) if before > 0.0 else -math.inf


@jit
def log_opacity(logit: float, cov: Vector3, view: View) -> float:
    """Return ln of the opacity on the screen, given C (xx, xy, yy)."""
    plain = log_sigmoid(logit)
    return plain + log_compensation(cov, view.dilation) if view.mip_filter else plain


@jit
def compensation_gradient(cov: Vector3, dilation: float) -> Any:
    """Return the symmetric ∂/∂C (xx, xy, yy) of `log_compensation`: ½ (C less its dilation)⁻¹ − ½ C⁻¹."""
    xx, xy, yy = cov
    after = 0.5 / (xx * yy - xy * xy)
    nxx, nyy = xx - dilation, yy - dilation
    before = 0.5 / (nxx * nyy - xy * xy)
    return nyy * before - yy * after, -xy * before + xy * after, nxx * before - xx * after


@jit
def log_sigmoid(logit: float) -> float:
    """Return ln of the opacity; only called for logit ≥ LOGIT_ALPHA_MIN."""
    return -math.log1p(math.exp(-logit))


@jit
def unit_direction(
    mean: Vector3,
    center: ArrayN,  # (3,) float64
) -> Any:
    """Return the unit vector from the camera's centre to a Gaussian, and the reciprocal of their distance."""
    x, y, z = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return (x * scale, y * scale, z * scale), scale


@jit
def sh_colour(
    sh: ArrayNK3,  # (N, K, 3) float32/64
    i: int,
    basis: ArrayN,  # (MAX_COEFFICIENTS,) float64
    terms: int,
) -> Any:
    """Return red, green and blue of Gaussian i, not clamped at zero."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(terms):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue
