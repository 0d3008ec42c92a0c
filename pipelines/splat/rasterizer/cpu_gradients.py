"""Gradients of Gaussians and camera from the gradients of hits, as numba kernels.

Sums run in a fixed order whatever the number of threads, without atomic additions: the result is the same bit for
bit on every run.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from pipelines.splat.rasterizer.cpu_blend_gradient import HIT_GRADIENT_WIDTH, Q
from pipelines.splat.rasterizer.cpu_gaussian import log_sigmoid, row3, unit_direction
from pipelines.splat.rasterizer.cpu_gaussian_gradient import colour_gradient, geometry_gradient, unnormalised
from pipelines.splat.rasterizer.cpu_jit import jit, parallel_jit, worker_jit
from pipelines.splat.rasterizer.cpu_project import BLOCK
from pipelines.splat.rasterizer.cpu_sh import MAX_COEFFICIENTS
from pipelines.splat.rasterizer.cpu_view import View

# Entries of a block's share of the camera's gradient: 12 of the pose, row by row, then 3 of the centre.
CAMERA_WIDTH = 15


@jit
def _sum_hits(gradient: Any, places: Any, first: int, last: int, sums: Any) -> None:
    for k in range(HIT_GRADIENT_WIDTH):
        sums[k] = 0.0
    for slot in range(first, last):
        start = places[slot] * HIT_GRADIENT_WIDTH
        for k in range(HIT_GRADIENT_WIDTH):
            sums[k] += gradient[start + k]


@jit
def _clear_rows(
    first: int, last: int, g_means: Any, g_quats: Any, g_log_scales: Any, g_logits: Any, g_sh: Any
) -> None:
    for i in range(first, last):
        g_logits[i] = 0
        for k in range(3):
            g_means[i, k] = 0
            g_log_scales[i, k] = 0
        for k in range(4):
            g_quats[i, k] = 0
        for k in range(g_sh.shape[1]):
            g_sh[i, k, 0], g_sh[i, k, 1], g_sh[i, k, 2] = 0, 0, 0


@worker_jit
def _gaussian_gradients(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, sh: Any, pose: Any, center: Any, view: View,
    degree: int, visible: Any, rank: Any, gradient: Any, splat_start: Any, places: Any, block_start: Any,
    g_means: Any, g_quats: Any, g_log_scales: Any, g_logits: Any, g_sh: Any, camera: Any, g_screen: Any,
    worker: int, workers: int,
) -> None:  # fmt: skip
    sums, share = np.empty(HIT_GRADIENT_WIDTH), np.empty(CAMERA_WIDTH)
    basis, weight = np.empty(MAX_COEFFICIENTS), np.empty(MAX_COEFFICIENTS)
    for block in range(worker, block_start.shape[0] - 1, workers):
        for k in range(CAMERA_WIDTH):
            share[k] = 0.0
        _clear_rows(
            block * BLOCK, min((block + 1) * BLOCK, means.shape[0]), g_means, g_quats, g_log_scales, g_logits, g_sh
        )
        for m in range(block_start[block], block_start[block + 1]):
            i, row = visible[m], rank[m]
            _sum_hits(gradient, places, splat_start[row], splat_start[row + 1], sums)
            mean = row3(means, i)
            (px, py, pz), (g_screen[m, 0], g_screen[m, 1]) = geometry_gradient(
                quats, log_scales, i, mean, pose, view, sums, share, g_quats, g_log_scales
            )
            # ln α = ln σ(logit) + exponent, and ∂ ln σ/∂logit = 1 − σ(logit) = σ(−logit).
            logit = float(logit_opacities[i])
            g_logits[i] = sums[Q] * math.exp(log_sigmoid(logit) - logit)
            direction, scale = unit_direction(mean, center)
            g_direction = colour_gradient(sh, i, direction, degree, sums, basis, weight, g_sh)
            dx, dy, dz = unnormalised(direction, scale, g_direction)
            g_means[i, 0] = pose[0, 0] * px + pose[1, 0] * py + pose[2, 0] * pz + dx
            g_means[i, 1] = pose[0, 1] * px + pose[1, 1] * py + pose[2, 1] * pz + dy
            g_means[i, 2] = pose[0, 2] * px + pose[1, 2] * py + pose[2, 2] * pz + dz
            share[12] -= dx
            share[13] -= dy
            share[14] -= dz
        for k in range(CAMERA_WIDTH):
            camera[block, k] = share[k]


@parallel_jit
def gaussian_gradients(
    means: Any, quats: Any, log_scales: Any, logit_opacities: Any, sh: Any, pose: Any, center: Any, view: View,
    degree: int, visible: Any, rank: Any, gradient: Any, splat_start: Any, places: Any, block_start: Any,
    g_means: Any, g_quats: Any, g_log_scales: Any, g_logits: Any, g_sh: Any, camera: Any, g_screen: Any,
    workers: int,
) -> None:  # fmt: skip
    """Sum the gradients of hits by Gaussian, and propagate them back through the projection and the colours.

    Args:
        means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible, rank: as in
            `project_visible`.
        gradient: (H · HIT_GRADIENT_WIDTH,) of the hits by tile.
        splat_start, places: of the hits of each splat, see `list_hits`.
        block_start: (blocks + 1,) into `visible`: the blocks of BLOCK Gaussians each.
        g_means, g_quats, g_log_scales, g_logits, g_sh: gradients of the N Gaussians, written; zero for the
            invisible.
        camera: (blocks, CAMERA_WIDTH) each block's share of ∂L/∂ pose and centre, written.
        g_screen: (M, 2) ∂L/∂ screen mean, written.
        workers: number of threads.
    """
    for worker in prange(workers):
        _gaussian_gradients(
            means, quats, log_scales, logit_opacities, sh, pose, center, view, degree, visible, rank, gradient,
            splat_start, places, block_start, g_means, g_quats, g_log_scales, g_logits, g_sh, camera, g_screen,
            np.int64(worker), workers,
        )  # fmt: skip
