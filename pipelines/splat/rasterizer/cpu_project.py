"""Numba kernels that find the visible Gaussians and fill the tables for binning and blending."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.splat.rasterizer.api import ALPHA_MIN
from pipelines.splat.rasterizer.cpu_gaussian import (
    jacobian,
    log_sigmoid,
    point_in_cam,
    rotation,
    row3,
    screen_covariance,
    screen_from_model,
    sh_colour,
    times_rotation,
    unit_direction,
    unit_quat,
    variances,
)
from pipelines.splat.rasterizer.cpu_jit import jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_sh import MAX_COEFFICIENTS, sh_basis
from pipelines.splat.rasterizer.cpu_slope import WIDEST, depth_slope
from pipelines.splat.rasterizer.cpu_view import View

LOG_ALPHA_MIN = math.log(ALPHA_MIN)
LOGIT_ALPHA_MIN = math.log(ALPHA_MIN / (1 - ALPHA_MIN))
# Gaussians that one worker takes at a time. Blocks are dealt out in turn, because visible Gaussians come in
# clusters.
BLOCK = 256

# Columns of the table of splats that blending reads: centre, factor of the conic (see `_write_splat`),
# logarithm of the opacity, colour, depth of the centre, slope of the depth in metres per pixel.
X, Y, FACTOR_XX, FACTOR_XY, FACTOR_YY, LOG_OPACITY, RED, GREEN, BLUE, DEPTH, SLOPE_X, SLOPE_Y = range(12)
SPLAT_WIDTH = 12
# Columns of the table of ellipses that binning reads: centre, covariance, squared Mahalanobis radius.
E_X, E_Y, E_XX, E_XY, E_YY, E_LEVEL = range(6)
ELLIPSE_WIDTH = 6


@jit
def _ellipse(means: Any, quats: Any, log_scales: Any, pose: Any, view: View, i: int) -> Any:
    """Return the point in the camera's frame, screen covariance and slope of the depth of Gaussian i."""
    point = point_in_cam(pose, row3(means, i))
    quat, _ = unit_quat(quats, i)
    axes = times_rotation(screen_from_model(jacobian(view, point), pose), rotation(quat))
    variance = variances(log_scales, i)
    cov = screen_covariance(axes, variance, view.dilation)
    return point, cov, depth_slope(axes, variance, cov, view.dilation, point[2])


@jit
def _holds_pixel(center: float, extent: float, size: float) -> bool:
    """Return whether a pixel centre 0.5, 1.5 … size − 0.5 lies within `extent` of `center`."""
    first = max(math.ceil(center - extent - 0.5), 0.0)
    last = min(math.floor(center + extent - 0.5), size - 1.0)
    return first <= last


@jit
def _may_reach_image(point: Any, largest_log_scale: float, view: View) -> bool:
    """Return False only if a sphere around the Gaussian surely projects outside the image: a cheap first test."""
    x, y, z = point
    sigma = math.exp(largest_log_scale) / z
    reach_x = WIDEST * math.sqrt(view.stretch_x * view.stretch_x * sigma * sigma + view.dilation)
    reach_y = WIDEST * math.sqrt(view.stretch_y * view.stretch_y * sigma * sigma + view.dilation)
    u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    return -reach_x <= u <= view.width + reach_x and -reach_y <= v <= view.height + reach_y


@jit
def _is_visible(means: Any, quats: Any, log_scales: Any, logit: float, pose: Any, view: View, i: int) -> bool:
    """Return whether the ellipse in which Gaussian i reaches ALPHA_MIN has a pixel in its bounding box.

    Comparisons are written so that NaN anywhere makes the Gaussian invisible.
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
    """Write the visibility (N,) of N Gaussians, and the depth (N,) of the visible, on `workers` threads."""
    for worker in prange(workers):
        _find_visible(
            means, quats, log_scales, logit_opacities, pose, view, visible, depth, np.int64(worker), workers
        )


@jit
def _write_splat(splats: Any, ellipses: Any, row: int, center: Any, cov: Any, log_opacity: float) -> None:
    """Fill the rows for blending (without colour, depth and slope) and for binning.

    The conic is kept as the factor of ½ Σ⁻¹: the exponent is −(f_xx dx + f_xy dy)² − (f_yy dy)². This form does not
    cancel catastrophically for long thin Gaussians, as the polynomial does.
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
    """Return three standard deviations along the longer axis of a covariance xx, xy, yy."""
    xx, xy, yy = cov
    half_difference = 0.5 * (xx - yy)
    return 3.0 * math.sqrt(0.5 * (xx + yy) + math.sqrt(half_difference * half_difference + xy * xy))


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
        rank: (M,) places of the visible Gaussians in the order of depth.
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
