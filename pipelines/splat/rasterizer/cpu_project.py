"""Projection of Gaussians to the screen and its derivative, one Gaussian at a time, as numba kernels.

Arithmetic is float64 whatever the arrays hold: it is scalar code, where float32 is no faster. Small matrices
are flat tuples, row by row, so that they stay in registers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.splat.rasterizer.api import ALPHA_MIN
from pipelines.splat.rasterizer.cpu_jit import jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_sh import MAX_COEFFICIENTS, sh_basis
from pipelines.splat.rasterizer.cpu_slope import WIDEST, depth_slope
from pipelines.splat.rasterizer.cpu_view import View

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
LOGIT_ALPHA_MIN = math.log(ALPHA_MIN / (1 - ALPHA_MIN))
# Gaussians that one worker takes at a time: dealt out in turn, because the visible ones come in clusters.
BLOCK = 256

# Columns of the table of splats that blending reads: centre, factor of the conic (see `write_splat`),
# logarithm of the opacity, colour, depth of the centre, slope of the depth in metres per pixel.
X, Y, FACTOR_XX, FACTOR_XY, FACTOR_YY, LOG_OPACITY, RED, GREEN, BLUE, DEPTH, SLOPE_X, SLOPE_Y = range(12)
SPLAT_WIDTH = 12
# Columns of the table of ellipses that binning reads: centre, covariance, squared Mahalanobis radius.
E_X, E_Y, E_XX, E_XY, E_YY, E_LEVEL = range(6)
ELLIPSE_WIDTH = 6


@jit
def row3(array: Any, i: int) -> Any:
    """Row i of an (N, 3) array."""
    return float(array[i, 0]), float(array[i, 1]), float(array[i, 2])


@jit
def point_in_cam(pose: Any, mean: Any) -> Any:
    """(x, y, z) of a point under the rigid transformation `pose` (3, 4)."""
    x, y, z = mean
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@jit
def unit_quat(quats: Any, i: int) -> Any:
    """Row i of (N, 4) quaternions at unit length, and the reciprocal of the length."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    scale = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return (w * scale, x * scale, y * scale, z * scale), scale


@jit
def rotation(quat: Any) -> Any:
    """Rotation matrix (9) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@jit
def variances(log_scales: Any, i: int) -> Any:
    """Variances along the principal axes of Gaussian i."""
    a, b, c = row3(log_scales, i)
    return math.exp(2 * a), math.exp(2 * b), math.exp(2 * c)


@jit
def jacobian(view: View, point: Any) -> Any:
    """Entries 00, 02, 11, 12 of ∂(u, v)/∂(x, y, z); the others are zero."""
    x, y, z = point
    slope_x = min(max(x / z, view.slope_x_min), view.slope_x_max)
    slope_y = min(max(y / z, view.slope_y_min), view.slope_y_max)
    return view.fx / z, -view.fx * slope_x / z, view.fy / z, -view.fy * slope_y / z


@jit
def screen_from_model(jac: Any, pose: Any) -> Any:
    """W (9): the linearised map from the model's frame to (u, v, z)."""
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
    """V = W R (9): the principal axes along (u, v, z)."""
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
    """xx, xy, yy of V diag(σ²) Vᵀ, of the rows u and v of V, + dilation · I."""
    a, b, c = variance
    return (
        axes[0] * axes[0] * a + axes[1] * axes[1] * b + axes[2] * axes[2] * c + dilation,
        axes[0] * axes[3] * a + axes[1] * axes[4] * b + axes[2] * axes[5] * c,
        axes[3] * axes[3] * a + axes[4] * axes[4] * b + axes[5] * axes[5] * c + dilation,
    )


@jit
def log_sigmoid(logit: float) -> float:
    """ln of the opacity; only called where logit ≥ LOGIT_ALPHA_MIN."""
    return -math.log1p(math.exp(-logit))


@jit
def _ellipse(means: Any, quats: Any, log_scales: Any, pose: Any, view: View, i: int) -> Any:
    """Point in the camera's frame, screen covariance and slope of the depth of Gaussian i."""
    point = point_in_cam(pose, row3(means, i))
    quat, _ = unit_quat(quats, i)
    axes = times_rotation(screen_from_model(jacobian(view, point), pose), rotation(quat))
    variance = variances(log_scales, i)
    cov = screen_covariance(axes, variance, view.dilation)
    return point, cov, depth_slope(axes, variance, cov, point[2])


@jit
def _holds_pixel(center: float, extent: float, size: float) -> bool:
    """Whether a pixel centre 0.5, 1.5 … size − 0.5 lies within `extent` of `center`."""
    first = max(math.ceil(center - extent - 0.5), 0.0)
    last = min(math.floor(center + extent - 0.5), size - 1.0)
    return first <= last


@jit
def _may_reach_image(point: Any, largest_log_scale: float, view: View) -> bool:
    """False only if a sphere around the Gaussian is sure to project outside the image: cheap, for most of them."""
    x, y, z = point
    sigma = math.exp(largest_log_scale) / z
    reach_x = WIDEST * math.sqrt(view.stretch_x * view.stretch_x * sigma * sigma + view.dilation)
    reach_y = WIDEST * math.sqrt(view.stretch_y * view.stretch_y * sigma * sigma + view.dilation)
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    return -reach_x <= u <= view.width + reach_x and -reach_y <= v <= view.height + reach_y


@jit
def _is_visible(means: Any, quats: Any, log_scales: Any, logit: float, pose: Any, view: View, i: int) -> bool:
    """Whether the ellipse in which Gaussian i reaches ALPHA_MIN has a pixel in its bounding box.

    Written so that NaN anywhere makes it invisible.
    """
    point, (xx, xy, yy), _ = _ellipse(means, quats, log_scales, pose, view, i)
    if not (xx * yy - xy * xy > 0.0 and xx < math.inf and yy < math.inf):
        return False
    level = 2.0 * (log_sigmoid(logit) - LOG_ALPHA_MIN)
    u = view.fx * point[0] / point[2] + view.cx
    v = view.fy * point[1] / point[2] + view.cy
    return _holds_pixel(u, math.sqrt(level * xx), view.width) and _holds_pixel(
        v, math.sqrt(level * yy), view.height
    )


@worker_jit
def _find_visible(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, pose: Any, view: View, visible: Any, depth: Any,
    worker: int, workers: int,
) -> None:  # fmt: skip
    for block in range(worker, (means.shape[0] + BLOCK - 1) // BLOCK, workers):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, means.shape[0])):
            visible[i] = False
            point = point_in_cam(pose, row3(means, i))
            logit = float(logit_opacities[i])
            if not (point[2] >= view.near and logit >= LOGIT_ALPHA_MIN):
                continue
            a, b, c = row3(log_scales, i)
            if _may_reach_image(point, max(a, b, c), view):
                visible[i] = _is_visible(means, quats, log_scales, logit, pose, view, i)
                depth[i] = point[2]


@parallel_jit
def find_visible(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, pose: Any, view: View, visible: Any, depth: Any,
    workers: int,
) -> None:  # fmt: skip
    """Write, for N Gaussians, whether each is visible (N,) and its depth (N,) if it is; on `workers` threads."""
    for worker in prange(workers):
        _find_visible(
            means, quats, log_scales, logit_opacities, pose, view, visible, depth, np.int64(worker), workers
        )


@jit
def _write_splat(splats: Any, ellipses: Any, row: int, center: Any, cov: Any, log_opacity: float) -> None:
    """Fill the row that blending and the one that binning reads, but for colour, depth and slope.

    The conic is kept as the factor of ½ Σ⁻¹: the exponent is −(f_xx dx + f_xy dy)² − (f_yy dy)², which does not
    cancel catastrophically for long thin Gaussians as the polynomial does.
    """
    xx, xy, yy = cov
    determinant = xx * yy - xy * xy
    factor_xx = math.sqrt(0.5 * yy / determinant)
    splats[row, X], splats[row, Y] = center
    splats[row, FACTOR_XX] = factor_xx
    splats[row, FACTOR_XY] = -0.5 * xy / (determinant * factor_xx)
    splats[row, FACTOR_YY] = math.sqrt(0.5 / yy)
    splats[row, LOG_OPACITY] = log_opacity
    ellipses[row, E_X], ellipses[row, E_Y] = center
    ellipses[row, E_XX], ellipses[row, E_XY], ellipses[row, E_YY] = xx, xy, yy
    ellipses[row, E_LEVEL] = 2.0 * (log_opacity - LOG_ALPHA_MIN)


@jit
def _longer_radius(cov: Any) -> float:
    """Three standard deviations along the longer axis of a covariance xx, xy, yy."""
    xx, xy, yy = cov
    half_difference = 0.5 * (xx - yy)
    return 3.0 * math.sqrt(0.5 * (xx + yy) + math.sqrt(half_difference * half_difference + xy * xy))


@jit
def unit_direction(mean: Any, center: Any) -> Any:
    """Unit vector from the camera's centre to a Gaussian, and the reciprocal of their distance."""
    x, y, z = mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return (x * scale, y * scale, z * scale), scale


@jit
def sh_colour(sh: Any, i: int, basis: Any, terms: int) -> Any:
    """Red, green, blue of Gaussian i before they are clamped at zero."""
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(terms):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue


@worker_jit
def _project_visible(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, sh: Any, pose: Any, center: Any, view: View,
    degree: int, visible: Any, rank: Any, splats: Any, ellipses: Any, radius: Any, worker: int, workers: int,
) -> None:  # fmt: skip
    basis = np.empty(MAX_COEFFICIENTS)
    count = visible.shape[0]
    for block in range(worker, (count + BLOCK - 1) // BLOCK, workers):
        for m in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            i, row = visible[m], rank[m]
            (x, y, z), cov, slope = _ellipse(means, quats, log_scales, pose, view, i)
            on_screen = (view.fx * x / z + view.cx, view.fy * y / z + view.cy)
            _write_splat(splats, ellipses, row, on_screen, cov, log_sigmoid(float(logit_opacities[i])))
            direction, _ = unit_direction(row3(means, i), center)
            sh_basis(direction, degree, basis)
            red, green, blue = sh_colour(sh, i, basis, (degree + 1) ** 2)
            splats[row, RED] = max(red, 0.0)
            splats[row, GREEN] = max(green, 0.0)
            splats[row, BLUE] = max(blue, 0.0)
            splats[row, DEPTH] = z
            splats[row, SLOPE_X], splats[row, SLOPE_Y] = slope
            radius[m] = _longer_radius(cov)


@parallel_jit
def project_visible(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, sh: Any, pose: Any, center: Any, view: View,
    degree: int, visible: Any, rank: Any, splats: Any, ellipses: Any, radius: Any, workers: int,
) -> None:  # fmt: skip
    """Fill the tables of the M visible Gaussians.

    Args:
        means, quats, log_scales, logit_opacities, sh: of the N Gaussians.
        pose, center: (3, 4) and, in the model's frame, (3,).
        view: camera.
        degree: of the spherical harmonics in use.
        visible: (M,) rows of the Gaussians, ascending.
        rank: (M,) place of each in the order of depth.
        splats: (M, SPLAT_WIDTH) by rank, written.
        ellipses: (M, ELLIPSE_WIDTH) by rank, written.
        radius: (M,) three standard deviations along the longer axis in px, in the order of `visible`, written.
        workers: number of threads.
    """
    for worker in prange(workers):
        _project_visible(
            means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible, rank, splats,
            ellipses, radius, np.int64(worker), workers,
        )  # fmt: skip
