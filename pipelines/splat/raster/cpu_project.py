"""Projection of Gaussians to the screen and its derivative, one Gaussian at a time, as numba kernels.

Arithmetic is float64 whatever the arrays hold: it is scalar code, where float32 is no faster. Small matrices
are flat tuples, row by row, so that they stay in registers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

from pipelines.splat.raster.api import ALPHA_MIN, Pinhole, RasterSettings
from pipelines.splat.raster.cpu_sh import MAX_COEFFICIENTS, sh_basis
from pipelines.splat.raster.reference import FRUSTUM_MARGIN

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
LOGIT_ALPHA_MIN = math.log(ALPHA_MIN / (1 - ALPHA_MIN))
# Gaussians that one worker takes at a time: dealt out in turn, because the visible ones come in clusters.
BLOCK = 256

# Columns of the table of splats that blending reads: centre, factor of the conic (see `write_splat`),
# logarithm of the opacity, colour, depth.
X, Y, FACTOR_XX, FACTOR_XY, FACTOR_YY, LOG_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
SPLAT_WIDTH = 10
# Columns of the table of ellipses that binning reads: centre, covariance, squared Mahalanobis radius.
E_X, E_Y, E_XX, E_XY, E_YY, E_LEVEL = range(6)
ELLIPSE_WIDTH = 6

jit: Any = njit(cache=True, error_model="numpy", fastmath={"contract"})
parallel_jit: Any = njit(cache=True, error_model="numpy", fastmath={"contract"}, parallel=True)


class View(NamedTuple):
    """The camera as kernels want it: lengths in pixels, slopes x/z and y/z, near plane in metres."""

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


def make_view(camera: Pinhole, settings: RasterSettings) -> View:
    """The kernels' view of `camera`; the Jacobian is taken no further out than these slopes, as in gsplat."""
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    return View(
        width=float(camera.width),
        height=float(camera.height),
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        slope_x_min=-camera.cx / camera.fx - margin_x,
        slope_x_max=(camera.width - camera.cx) / camera.fx + margin_x,
        slope_y_min=-camera.cy / camera.fy - margin_y,
        slope_y_max=(camera.height - camera.cy) / camera.fy + margin_y,
        near=float(settings.near_m),
        dilation=float(settings.dilation_px2),
    )


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
    """J A (6): the linearised map from the model's frame to the screen."""
    j00, j02, j11, j12 = jac
    return (
        j00 * pose[0, 0] + j02 * pose[2, 0],
        j00 * pose[0, 1] + j02 * pose[2, 1],
        j00 * pose[0, 2] + j02 * pose[2, 2],
        j11 * pose[1, 0] + j12 * pose[2, 0],
        j11 * pose[1, 1] + j12 * pose[2, 1],
        j11 * pose[1, 2] + j12 * pose[2, 2],
    )


@jit
def times_rotation(w: Any, r: Any) -> Any:
    """W R (6) of a 2×3 and a 3×3 matrix: the principal axes on the screen."""
    return (
        w[0] * r[0] + w[1] * r[3] + w[2] * r[6],
        w[0] * r[1] + w[1] * r[4] + w[2] * r[7],
        w[0] * r[2] + w[1] * r[5] + w[2] * r[8],
        w[3] * r[0] + w[4] * r[3] + w[5] * r[6],
        w[3] * r[1] + w[4] * r[4] + w[5] * r[7],
        w[3] * r[2] + w[4] * r[5] + w[5] * r[8],
    )


@jit
def screen_covariance(axes: Any, variance: Any, dilation: float) -> Any:
    """xx, xy, yy of V diag(σ²) Vᵀ + dilation · I."""
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
    """Point in the camera's frame and screen covariance of Gaussian i."""
    point = point_in_cam(pose, row3(means, i))
    quat, _ = unit_quat(quats, i)
    axes = times_rotation(screen_from_model(jacobian(view, point), pose), rotation(quat))
    return point, screen_covariance(axes, variances(log_scales, i), view.dilation)


@jit
def _holds_pixel(center: float, extent: float, size: float) -> bool:
    """Whether a pixel centre 0.5, 1.5 … size − 0.5 lies within `extent` of `center`."""
    first = max(math.ceil(center - extent - 0.5), 0.0)
    last = min(math.floor(center + extent - 0.5), size - 1.0)
    return first <= last


@jit
def _is_visible(means: Any, quats: Any, log_scales: Any, logit: float, pose: Any, view: View, i: int) -> bool:
    """Whether the ellipse in which Gaussian i reaches ALPHA_MIN has a pixel in its bounding box.

    Written so that NaN anywhere makes it invisible.
    """
    point, (xx, xy, yy) = _ellipse(means, quats, log_scales, pose, view, i)
    if not (xx * yy - xy * xy > 0.0 and xx < math.inf and yy < math.inf):
        return False
    level = 2.0 * (log_sigmoid(logit) - LOG_ALPHA_MIN)
    u = view.fx * point[0] / point[2] + view.cx
    v = view.fy * point[1] / point[2] + view.cy
    return _holds_pixel(u, math.sqrt(level * xx), view.width) and _holds_pixel(
        v, math.sqrt(level * yy), view.height
    )


@parallel_jit
def find_visible(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, pose: Any, view: View, visible: Any, depth: Any,
    workers: int,
) -> None:  # fmt: skip
    """Write, for N Gaussians, whether each is visible (N,) and its depth (N,) if it is; on `workers` threads."""
    count = means.shape[0]
    blocks = (count + BLOCK - 1) // BLOCK
    for worker in prange(workers):
        for block in range(worker, blocks, workers):
            for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
                visible[i] = False
                z = point_in_cam(pose, row3(means, i))[2]
                logit = float(logit_opacities[i])
                if z >= view.near and logit >= LOGIT_ALPHA_MIN:
                    visible[i] = _is_visible(means, quats, log_scales, logit, pose, view, i)
                    depth[i] = z


@jit
def _write_splat(splat: Any, ellipse: Any, u: float, v: float, cov: Any, log_opacity: float) -> None:
    """Fill the rows that blending and binning read.

    The conic is kept as the factor of ½ Σ⁻¹: the exponent is −(f_xx dx + f_xy dy)² − (f_yy dy)², which does not
    cancel catastrophically for long thin Gaussians as the polynomial does.
    """
    xx, xy, yy = cov
    determinant = xx * yy - xy * xy
    factor_xx = math.sqrt(0.5 * yy / determinant)
    splat[X], splat[Y] = u, v
    splat[FACTOR_XX] = factor_xx
    splat[FACTOR_XY] = -0.5 * xy / (determinant * factor_xx)
    splat[FACTOR_YY] = math.sqrt(0.5 / yy)
    splat[LOG_OPACITY] = log_opacity
    ellipse[E_X], ellipse[E_Y] = u, v
    ellipse[E_XX], ellipse[E_XY], ellipse[E_YY] = xx, xy, yy
    ellipse[E_LEVEL] = 2.0 * (log_opacity - LOG_ALPHA_MIN)


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


@parallel_jit
def project_visible(
    parameters: Any, pose: Any, center: Any, view: View, degree: int, visible: Any, rank: Any, splats: Any,
    ellipses: Any, radius: Any, workers: int,
) -> None:  # fmt: skip
    """Fill the tables of the M visible Gaussians.

    Args:
        parameters: means, quats, log_scales, logit_opacities, sh.
        pose: (3, 4).
        center: (3,) the camera's centre in the model's frame.
        view: camera.
        degree: of the spherical harmonics in use.
        visible: (M,) rows of the Gaussians, ascending.
        rank: (M,) place of each in the order of depth.
        splats: (M, SPLAT_WIDTH) by rank, written.
        ellipses: (M, ELLIPSE_WIDTH) by rank, written.
        radius: (M,) three standard deviations along the longer axis in px, in the order of `visible`, written.
        workers: number of threads.
    """
    means, quats, log_scales, logit_opacities, sh = parameters
    count = visible.shape[0]
    blocks = (count + BLOCK - 1) // BLOCK
    for worker in prange(workers):
        basis = np.empty(MAX_COEFFICIENTS)
        for block in range(worker, blocks, workers):
            for m in range(block * BLOCK, min((block + 1) * BLOCK, count)):
                i, row = visible[m], rank[m]
                (x, y, z), cov = _ellipse(means, quats, log_scales, pose, view, i)
                u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
                _write_splat(splats[row], ellipses[row], u, v, cov, log_sigmoid(float(logit_opacities[i])))
                direction, _ = unit_direction(row3(means, i), center)
                sh_basis(direction, degree, basis)
                red, green, blue = sh_colour(sh, i, basis, (degree + 1) ** 2)
                splats[row, RED], splats[row, GREEN], splats[row, BLUE] = (
                    max(red, 0.0),
                    max(green, 0.0),
                    max(blue, 0.0),
                )
                splats[row, DEPTH] = z
                half_difference = 0.5 * (cov[0] - cov[2])
                spread = math.sqrt(half_difference * half_difference + cov[1] * cov[1])
                radius[m] = 3.0 * math.sqrt(0.5 * (cov[0] + cov[2]) + spread)
