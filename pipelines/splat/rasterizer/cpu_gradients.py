"""Gradients of Gaussians and camera from the gradients of hits, through projection and colour, as numba kernels.

Sums run in a fixed order whatever the number of threads, without atomic additions: the result is the same bit for
bit on every run.
"""

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.core.types import (
    Array34,
    ArrayN,
    ArrayN3,
    ArrayN4,
    ArrayNK,
    ArrayNK3,
    Matrix9,
    Vector2,
    Vector3,
    Vector4,
)
from pipelines.splat.rasterizer import cpu_gaussian as gaussian
from pipelines.splat.rasterizer.cpu_blend import (
    D_BLUE,
    D_DEPTH,
    D_GREEN,
    D_RED,
    D_SLOPE_X,
    D_SLOPE_Y,
    HIT_GRADIENT_WIDTH,
    NORMAL_WIDTH,
    Q_X,
    Q_XX,
    Q_XY,
    Q_Y,
    Q_YY,
    Q,
)
from pipelines.splat.rasterizer.cpu_gaussian import MAX_COEFFICIENTS, View
from pipelines.splat.rasterizer.cpu_lanes import jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_project import BLOCK


@jit
def _conic_gradients(
    cov: Vector3,
    sums: ArrayN,  # (HIT_GRADIENT_WIDTH,) float64
) -> Any:
    """Return ∂L/∂ screen mean (u, v) and the symmetric ∂L/∂C (xx, xy, yy) of the screen covariance C.

    The exponent is −½ dᵀ C⁻¹ d, so that the gradients are C⁻¹ Σ q d and ½ C⁻¹ (Σ q d dᵀ) C⁻¹.
    """
    xx, xy, yy = cov
    scale = 1.0 / (xx * yy - xy * xy)
    a, b, c = yy * scale, -xy * scale, xx * scale
    # Rows of C⁻¹ Σ q d dᵀ.
    m00, m01 = a * sums[Q_XX] + b * sums[Q_XY], a * sums[Q_XY] + b * sums[Q_YY]
    m10, m11 = b * sums[Q_XX] + c * sums[Q_XY], b * sums[Q_XY] + c * sums[Q_YY]
    mean = (a * sums[Q_X] + b * sums[Q_Y], b * sums[Q_X] + c * sums[Q_Y])
    return mean, (0.5 * (m00 * a + m01 * b), 0.5 * (m00 * b + m01 * c), 0.5 * (m10 * b + m11 * c))


@jit
def _covariance_gradients(
    axes: Matrix9,
    variance: Vector3,
    view: View,
    depth: float,
    sums: ArrayN,  # (HIT_GRADIENT_WIDTH,) float64
) -> Any:
    """Return ∂L/∂ screen mean (2), depth of the centre, screen covariance (3), covariance with the depth (2)."""
    cov = gaussian.screen_covariance(axes, variance, view.dilation)
    (gu, gv), (xx, xy, yy) = _conic_gradients(cov, sums)
    if view.mip_filter:
        # ln α has the logarithm of the compensation as a term.
        of_xx, of_xy, of_yy = gaussian.compensation_gradient(cov, view.dilation)
        xx, xy, yy = xx + sums[Q] * of_xx, xy + sums[Q] * of_xy, yy + sums[Q] * of_yy
    g_depth, g_slope = sums[D_DEPTH], (sums[D_SLOPE_X], sums[D_SLOPE_Y])
    if g_depth == 0.0 and g_slope[0] == 0.0 and g_slope[1] == 0.0:
        # True of every render without depth.
        return (gu, gv), 0.0, (xx, xy, yy), (0.0, 0.0)
    slope, g_c, (s_xx, s_xy, s_yy), g_reach = gaussian.depth_slope_gradient(
        axes, variance, cov, view.dilation, depth, g_slope
    )
    g_mean = (gu - slope[0] * g_depth, gv - slope[1] * g_depth)
    return g_mean, g_depth + g_reach, (xx + s_xx, xy + s_xy, yy + s_yy), g_c


@jit
def _axes_gradient(axes: Matrix9, variance: Vector3, g_cov: Vector3, g_c: Vector2) -> Any:
    """Return ∂L/∂V (9), given the symmetric ∂L/∂ screen covariance and ∂L/∂ its covariance with depth."""
    xx, xy, yy = g_cov
    xz, yz = g_c
    a, b, c = variance
    return (
        a * (2 * xx * axes[0] + 2 * xy * axes[3] + xz * axes[6]),
        b * (2 * xx * axes[1] + 2 * xy * axes[4] + xz * axes[7]),
        c * (2 * xx * axes[2] + 2 * xy * axes[5] + xz * axes[8]),
        a * (2 * xy * axes[0] + 2 * yy * axes[3] + yz * axes[6]),
        b * (2 * xy * axes[1] + 2 * yy * axes[4] + yz * axes[7]),
        c * (2 * xy * axes[2] + 2 * yy * axes[5] + yz * axes[8]),
        a * (xz * axes[0] + yz * axes[3]),
        b * (xz * axes[1] + yz * axes[4]),
        c * (xz * axes[2] + yz * axes[5]),
    )


@jit
def _transposed_times(w: Matrix9, v: Matrix9, i: int, k: int) -> float:
    """Return entry (i, k) of Wᵀ V."""
    return float(w[i] * v[k] + w[3 + i] * v[3 + k] + w[6 + i] * v[6 + k])


@jit
def _turn_gradient(w: Matrix9, v: Matrix9, axis: int, normal: Vector3) -> Any:
    """Return ∂L/∂R (9) = Wᵀ ∂L/∂V, plus the gradient (3) of the column `axis` as a normal."""
    nx, ny, nz = normal
    first, second, third = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0
    return (
        _transposed_times(w, v, 0, 0) + first * nx,
        _transposed_times(w, v, 0, 1) + second * nx,
        _transposed_times(w, v, 0, 2) + third * nx,
        _transposed_times(w, v, 1, 0) + first * ny,
        _transposed_times(w, v, 1, 1) + second * ny,
        _transposed_times(w, v, 1, 2) + third * ny,
        _transposed_times(w, v, 2, 0) + first * nz,
        _transposed_times(w, v, 2, 1) + second * nz,
        _transposed_times(w, v, 2, 2) + third * nz,
    )


@jit
def _quat_gradient(quat: Vector4, scale: float, turn: Matrix9) -> Any:
    """Return ∂L/∂ quaternion (4) before normalisation, given ∂L/∂R (9)."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = turn
    qw, qx, qy, qz = quat
    gw = 2 * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
    gx = 2 * (qw * (r21 - r12) + qy * (r01 + r10) + qz * (r02 + r20) - 2 * qx * (r11 + r22))
    gy = 2 * (qw * (r02 - r20) + qx * (r01 + r10) + qz * (r12 + r21) - 2 * qy * (r00 + r22))
    gz = 2 * (qw * (r10 - r01) + qx * (r02 + r20) + qy * (r12 + r21) - 2 * qz * (r00 + r11))
    along = qw * gw + qx * gx + qy * gy + qz * gz
    return (
        scale * (gw - along * qw),
        scale * (gx - along * qx),
        scale * (gy - along * qy),
        scale * (gz - along * qz),
    )


@jit
def _point_gradient(
    view: View,
    point: Vector3,
    g_mean: Vector2,
    g_depth: float,
    pose: Array34,  # (3, 4) float64
    g_w: Matrix9,
) -> Any:
    """Return ∂L/∂ point in the camera's frame (3): through the screen mean, the depth and the Jacobian."""
    x, y, z = point
    gu, gv = g_mean
    j00 = g_w[0] * pose[0, 0] + g_w[1] * pose[0, 1] + g_w[2] * pose[0, 2]
    j02 = g_w[0] * pose[2, 0] + g_w[1] * pose[2, 1] + g_w[2] * pose[2, 2]
    j11 = g_w[3] * pose[1, 0] + g_w[4] * pose[1, 1] + g_w[5] * pose[1, 2]
    j12 = g_w[3] * pose[2, 0] + g_w[4] * pose[2, 1] + g_w[5] * pose[2, 2]
    fx_z, fy_z = view.fx / z, view.fy / z
    gx, gy = fx_z * gu, fy_z * gv
    gz = g_depth - (x * gx + y * gy + fx_z * j00 + fy_z * j11) / z
    slope_x, slope_y = x / z, y / z
    if view.slope_x_min <= slope_x <= view.slope_x_max:
        gx -= fx_z * j02 / z
        gz += 2 * fx_z * slope_x * j02 / z
    else:
        gz += fx_z * min(max(slope_x, view.slope_x_min), view.slope_x_max) * j02 / z
    if view.slope_y_min <= slope_y <= view.slope_y_max:
        gy -= fy_z * j12 / z
        gz += 2 * fy_z * slope_y * j12 / z
    else:
        gz += fy_z * min(max(slope_y, view.slope_y_min), view.slope_y_max) * j12 / z
    return gx, gy, gz


@jit
def _add_pose_gradient(
    camera: ArrayN,  # (CAMERA_WIDTH,) float64
    mean: Vector3,
    g_point: Vector3,
    jac: Vector4,
    g_w: Matrix9,
) -> None:
    """Add ∂L/∂[A | t] (12) of p = A m + t and W."""
    j00, j02, j11, j12 = jac
    x, y, z = mean
    gx, gy, gz = g_point
    camera[0] += gx * x + j00 * g_w[0]
    camera[1] += gx * y + j00 * g_w[1]
    camera[2] += gx * z + j00 * g_w[2]
    camera[3] += gx
    camera[4] += gy * x + j11 * g_w[3]
    camera[5] += gy * y + j11 * g_w[4]
    camera[6] += gy * z + j11 * g_w[5]
    camera[7] += gy
    camera[8] += gz * x + j02 * g_w[0] + j12 * g_w[3] + g_w[6]
    camera[9] += gz * y + j02 * g_w[1] + j12 * g_w[4] + g_w[7]
    camera[10] += gz * z + j02 * g_w[2] + j12 * g_w[5] + g_w[8]
    camera[11] += gz


@jit
def colour_gradient(
    sh: ArrayNK3,  # (N, K, 3) float32/64
    i: int,
    direction: Vector3,
    degree: int,
    sums: ArrayN,  # (HIT_GRADIENT_WIDTH,) float64
    basis: ArrayN,  # (MAX_COEFFICIENTS,) float64
    weight: ArrayN,  # (MAX_COEFFICIENTS,) float64
    g_sh: ArrayNK3,  # (N, K, 3) float32/64
) -> Any:
    """Write row i of ∂L/∂ SH, and return ∂L/∂ direction, with the basis as functions of all space."""
    terms = (degree + 1) ** 2
    for k in range(terms, g_sh.shape[1]):
        g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = 0.0, 0.0, 0.0
    gaussian.sh_basis(direction, degree, basis)
    red, green, blue = gaussian.sh_colour(sh, i, basis, terms)
    g_red = sums[D_RED] if red >= 0.0 else 0.0
    g_green = sums[D_GREEN] if green >= 0.0 else 0.0
    g_blue = sums[D_BLUE] if blue >= 0.0 else 0.0
    for k in range(terms):
        g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = basis[k] * g_red, basis[k] * g_green, basis[k] * g_blue
        weight[k] = sh[i, k, 0] * g_red + sh[i, k, 1] * g_green + sh[i, k, 2] * g_blue
    return gaussian.sh_direction_gradient(direction, degree, weight)


@jit
def unnormalised(direction: Vector3, scale: float, gradient: Vector3) -> Any:
    """Return ∂L/∂v of a vector v, given ∂L/∂ direction of direction = scale · v of unit length."""
    x, y, z = direction
    gx, gy, gz = gradient
    along = x * gx + y * gy + z * gz
    return scale * (gx - along * x), scale * (gy - along * y), scale * (gz - along * z)


@jit
def geometry_gradient(
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    i: int,
    mean: Vector3,
    direction: Vector3,
    pose: Array34,  # (3, 4) float64
    view: View,
    sums: ArrayN,  # (HIT_GRADIENT_WIDTH,) float64
    g_normal: ArrayN,  # (NORMAL_WIDTH,) float64
    camera: ArrayN,  # (CAMERA_WIDTH,) float64
    g_quats: ArrayN4,  # (N, 4) float32/64
    g_log_scales: ArrayN3,  # (N, 3) float32/64
) -> Any:
    """Write row i of ∂L/∂ quaternion and log scales, add to ∂L/∂ pose; return ∂L/∂ point and screen mean."""
    point = gaussian.transformed_point(pose, mean)
    quat, scale = gaussian.unit_quat(quats, i)
    turn = gaussian.rotation(quat)
    jac = gaussian.jacobian(view, point)
    w = gaussian.screen_from_model(jac, pose)
    axes, variance = gaussian.times_rotation(w, turn), gaussian.variances(log_scales, i)
    g_mean, g_depth, g_cov, g_c = _covariance_gradients(axes, variance, view, point[2], sums)
    g_axes = _axes_gradient(axes, variance, g_cov, g_c)
    turn_back = (turn[0], turn[3], turn[6], turn[1], turn[4], turn[7], turn[2], turn[5], turn[8])
    g_w = gaussian.times_rotation(g_axes, turn_back)
    axis, sign = -1, 1.0
    if g_normal[0] != 0.0 or g_normal[1] != 0.0 or g_normal[2] != 0.0:
        # Untrue in every render without normals.
        axis = gaussian.shortest_axis(log_scales, i)
        _, sign = gaussian.facing_normal(turn, axis, direction)
    g_turn = _turn_gradient(w, g_axes, axis, (sign * g_normal[0], sign * g_normal[1], sign * g_normal[2]))
    g_quats[i, 0], g_quats[i, 1], g_quats[i, 2], g_quats[i, 3] = _quat_gradient(quat, scale, g_turn)
    # Scaling a principal axis means scaling its column of V.
    g_log_scales[i, 0] = _transposed_times(axes, g_axes, 0, 0)
    g_log_scales[i, 1] = _transposed_times(axes, g_axes, 1, 1)
    g_log_scales[i, 2] = _transposed_times(axes, g_axes, 2, 2)
    g_point = _point_gradient(view, point, g_mean, g_depth, pose, g_w)
    _add_pose_gradient(camera, mean, g_point, jac, g_w)
    return g_point, g_mean


# Entries of a block's share of the camera's gradient: 12 of the pose, row by row, then 3 of the centre.
CAMERA_WIDTH = 15


@jit
def _sum_hits(
    gradient: ArrayN,  # (H · width,) float32/64
    width: int,
    places: ArrayN,  # (H,) int64
    splat_start: ArrayN,  # (M + 1,) int64
    first: int,
    last: int,
    sums: ArrayNK,  # (last − first or more, width) float64
) -> None:
    """Write the sums (last − first, width) of the hits of some splats.

    Hits lie by tile: nearly each is a cache miss. A loop that does nothing else has many of them under way.
    """
    for m in range(first, last):
        row = sums[m - first]
        for k in range(width):
            row[k] = 0.0
        for slot in range(splat_start[m], splat_start[m + 1]):
            start = places[slot] * width
            for k in range(width):
                row[k] += gradient[start + k]


@jit
def _clear(
    first: int,
    last: int,
    g_means: ArrayN3,  # (N, 3) float32/64
    g_quats: ArrayN4,  # (N, 4) float32/64
    g_log_scales: ArrayN3,  # (N, 3) float32/64
    g_logits: ArrayN,  # (N,) float32/64
    g_sh: ArrayNK3,  # (N, K, 3) float32/64
) -> None:
    """Set the gradients of Gaussians first … last − 1, which are not visible, to zero."""
    for i in range(first, last):
        for k in range(3):
            g_means[i, k], g_log_scales[i, k] = 0.0, 0.0
        for k in range(4):
            g_quats[i, k] = 0.0
        g_logits[i] = 0.0
        for k in range(g_sh.shape[1]):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = 0.0, 0.0, 0.0


@worker_jit
def _gaussian_gradients(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    sh: ArrayNK3,  # (N, K, 3) float32/64
    pose: Array34,  # (3, 4) float64
    center: ArrayN,  # (3,) float64
    view: View,
    degree: int,
    visible: ArrayN,  # (M,) int64
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    normal_gradient: ArrayN,  # (H · NORMAL_WIDTH or 0,) float32/64
    splat_start: ArrayN,  # (M + 1,) int64
    places: ArrayN,  # (H,) int64
    block_start: ArrayN,  # (blocks + 1,) int64
    g_means: ArrayN3,  # (N, 3) float32/64
    g_quats: ArrayN4,  # (N, 4) float32/64
    g_log_scales: ArrayN3,  # (N, 3) float32/64
    g_logits: ArrayN,  # (N,) float32/64
    g_sh: ArrayNK3,  # (N, K, 3) float32/64
    camera: ArrayNK,  # (blocks, CAMERA_WIDTH) float64
    g_screen: ArrayNK,  # (M, 2) float32
    worker: int,
    workers: int,
) -> None:
    block_sums, share = np.empty((BLOCK, HIT_GRADIENT_WIDTH)), np.empty(CAMERA_WIDTH)
    basis, weight = np.empty(MAX_COEFFICIENTS), np.empty(MAX_COEFFICIENTS)
    block_normals = np.zeros((BLOCK, NORMAL_WIDTH))
    for block in range(worker, block_start.shape[0] - 1, workers):
        for k in range(CAMERA_WIDTH):
            share[k] = 0.0
        first, last = block_start[block], block_start[block + 1]
        _sum_hits(gradient, HIT_GRADIENT_WIDTH, places, splat_start, first, last, block_sums)
        if normal_gradient.shape[0] > 0:
            _sum_hits(normal_gradient, NORMAL_WIDTH, places, splat_start, first, last, block_normals)
        following, end = block * BLOCK, min((block + 1) * BLOCK, means.shape[0])
        for m in range(first, last):
            i, sums = visible[m], block_sums[m - first]
            _clear(following, i, g_means, g_quats, g_log_scales, g_logits, g_sh)
            following = i + 1
            mean = gaussian.row3(means, i)
            direction, scale = gaussian.unit_direction(mean, center)
            (px, py, pz), (g_screen[m, 0], g_screen[m, 1]) = geometry_gradient(
                quats, log_scales, i, mean, direction, pose, view, sums, block_normals[m - first], share, g_quats,
                g_log_scales,
            )  # fmt: skip
            # ln α = ln σ(logit) + exponent, and ∂ ln σ/∂logit = 1 − σ(logit) = σ(−logit).
            logit = float(logit_opacities[i])
            g_logits[i] = sums[Q] * math.exp(gaussian.log_sigmoid(logit) - logit)
            g_direction = colour_gradient(sh, i, direction, degree, sums, basis, weight, g_sh)
            dx, dy, dz = unnormalised(direction, scale, g_direction)
            g_means[i, 0] = pose[0, 0] * px + pose[1, 0] * py + pose[2, 0] * pz + dx
            g_means[i, 1] = pose[0, 1] * px + pose[1, 1] * py + pose[2, 1] * pz + dy
            g_means[i, 2] = pose[0, 2] * px + pose[1, 2] * py + pose[2, 2] * pz + dz
            share[12] -= dx
            share[13] -= dy
            share[14] -= dz
        _clear(following, end, g_means, g_quats, g_log_scales, g_logits, g_sh)
        for k in range(CAMERA_WIDTH):
            camera[block, k] = share[k]


@parallel_jit
def gaussian_gradients(
    means: ArrayN3,  # (N, 3) float32/64
    quats: ArrayN4,  # (N, 4) float32/64, w x y z
    log_scales: ArrayN3,  # (N, 3) float32/64
    logit_opacities: ArrayN,  # (N,) float32/64
    sh: ArrayNK3,  # (N, K, 3) float32/64
    pose: Array34,  # (3, 4) float64
    center: ArrayN,  # (3,) float64
    view: View,
    degree: int,
    visible: ArrayN,  # (M,) int64
    gradient: ArrayN,  # (H · HIT_GRADIENT_WIDTH,) float32/64
    normal_gradient: ArrayN,  # (H · NORMAL_WIDTH or 0,) float32/64
    splat_start: ArrayN,  # (M + 1,) int64
    places: ArrayN,  # (H,) int64
    block_start: ArrayN,  # (blocks + 1,) int64
    g_means: ArrayN3,  # (N, 3) float32/64
    g_quats: ArrayN4,  # (N, 4) float32/64
    g_log_scales: ArrayN3,  # (N, 3) float32/64
    g_logits: ArrayN,  # (N,) float32/64
    g_sh: ArrayNK3,  # (N, K, 3) float32/64
    camera: ArrayNK,  # (blocks, CAMERA_WIDTH) float64
    g_screen: ArrayNK,  # (M, 2) float32
    workers: int,
) -> None:
    """Sum the gradients of hits by Gaussian, and propagate them back through the projection and the colours.

    Args:
        means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible: as in
            `project_visible`.
        gradient, normal_gradient: of the hits by tile, see `blend_gradient`.
        splat_start, places: of the hits of each splat, see `list_hits`.
        block_start: (blocks + 1,) into `visible`: the blocks of BLOCK Gaussians each.
        g_means, g_quats, g_log_scales, g_logits, g_sh: gradients of the N Gaussians, written; those that are not
            visible have zeros.
        camera: (blocks, CAMERA_WIDTH) each block's share of ∂L/∂ pose and centre, written.
        g_screen: (M, 2) ∂L/∂ screen mean, written.
    """
    for worker in prange(workers):
        _gaussian_gradients(
            means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible, gradient,
            normal_gradient, splat_start, places, block_start, g_means, g_quats, g_log_scales, g_logits, g_sh,
            camera, g_screen, np.int64(worker), workers,
        )  # fmt: skip
