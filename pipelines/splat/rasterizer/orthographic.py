"""Orthographic rasteriser on a CPU, in float64: Gaussians from straight above, without leaning walls.

The projection is linear, so that the screen covariance and the slope of the depth are exact, and no Gaussian is too
near or too far. Blending is that of the other rasterisers (see `api`), by the same kernels; no gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from pipelines.core.types import FloatArray
from pipelines.splat.rasterizer import cpu_project
from pipelines.splat.rasterizer.api import ALPHA_MIN
from pipelines.splat.rasterizer.cpu import KERNEL_LOCK, blend_tiles, list_tiles

_LOG_ALPHA_MIN = float(np.log(ALPHA_MIN))


@dataclass(frozen=True)
class PlanSplats:
    """N Gaussians over a map plane, float64."""

    # (N, 3) column and row in px (the centre of the first pixel is 0.5, 0.5), and depth below a level above all of
    # them, in any unit; depths are > 0
    mean: FloatArray
    cov: FloatArray  # (N, 3, 3) covariance of the same three
    opacity: FloatArray  # (N,)
    colour: FloatArray  # (N, 3) red, green, blue

    def scaled(self, factor: float) -> PlanSplats:
        """Return the same Gaussians over pixels that are smaller by a factor; depths stay."""
        scale = np.array([factor, factor, 1.0])
        return PlanSplats(self.mean * scale, self.cov * np.outer(scale, scale), self.opacity, self.colour)


@dataclass(frozen=True)
class PlanView:
    """Orthographic view of H × W pixels, float64; the maps are those of a `Render`, with the colour over black."""

    colour: FloatArray
    alpha: FloatArray
    expected_depth: FloatArray
    depth_variance: FloatArray
    median_depth: FloatArray


def render_orthographic(
    splats: PlanSplats,
    width: int,
    height: int,
    *,
    corner: tuple[float, float] = (0.0, 0.0),
    dilation_px2: float = 0.3,
    shrink: float = 1.0,
) -> PlanView:
    """Return the view of a part of the plane, `width` × `height` px from a corner (column, row), from above.

    The Gaussians' covariances count by the factor `shrink`.
    """
    table, ellipses = _tables(splats, (width, height), corner, dilation_px2, shrink)
    with KERNEL_LOCK:
        lists = list_tiles(ellipses, np.arange(len(ellipses)), width, height)
        colour, alpha, depth_sum, square_sum, median, _ = blend_tiles(
            *(table, np.empty((0, 3)), lists, (height, width), np.zeros(3)),
            depth=True,
            workers=numba.get_num_threads(),
        )
    total = np.where(alpha > 0, alpha, 1.0)
    expected = np.where(alpha > 0, depth_sum / total, 0.0)
    variance = np.maximum(square_sum / total - expected**2, 0.0)
    return PlanView(colour, alpha, expected, variance, median)


def _tables(
    splats: PlanSplats, size: tuple[int, int], corner: tuple[float, float], dilation_px2: float, shrink: float
) -> tuple[FloatArray, FloatArray]:
    """Return the splats (M, SPLAT_WIDTH) and ellipses (M, ELLIPSE_WIDTH) of the part, nearest first."""
    width, height = size
    xx, yy = (shrink * splats.cov[:, axis, axis] + dilation_px2 for axis in (0, 1))
    level = 2.0 * (np.log(np.maximum(splats.opacity, 1e-300)) - _LOG_ALPHA_MIN)
    x, y = splats.mean[:, 0] - corner[0], splats.mean[:, 1] - corner[1]
    reach_x, reach_y = (np.sqrt(np.maximum(level, 0.0) * variance) for variance in (xx, yy))
    inside = (x + reach_x > 0) & (x - reach_x < width) & (y + reach_y > 0) & (y - reach_y < height)
    visible = np.flatnonzero(inside & (level > 0))
    order = visible[np.argsort(splats.mean[visible, 2], kind="stable")]
    xx, yy, x, y, level = xx[order], yy[order], x[order], y[order], level[order]
    cov = shrink * splats.cov[order]
    xy, xz, yz = cov[:, 0, 1], cov[:, 0, 2], cov[:, 1, 2]
    determinant = xx * yy - xy * xy
    factor_xx = np.sqrt(0.5 * yy / determinant)
    table = np.empty((len(order), cpu_project.SPLAT_WIDTH))
    table[:, cpu_project.X], table[:, cpu_project.Y] = x, y
    table[:, cpu_project.FACTOR_XX] = factor_xx
    table[:, cpu_project.FACTOR_XY] = -0.5 * xy / (determinant * factor_xx)
    table[:, cpu_project.FACTOR_YY] = np.sqrt(0.5 / yy)
    table[:, cpu_project.LOG_OPACITY] = 0.5 * level + _LOG_ALPHA_MIN
    table[:, [cpu_project.RED, cpu_project.GREEN, cpu_project.BLUE]] = splats.colour[order]
    table[:, cpu_project.DEPTH] = splats.mean[order, 2]
    table[:, cpu_project.SLOPE_X] = (yy * xz - xy * yz) / determinant
    table[:, cpu_project.SLOPE_Y] = (xx * yz - xy * xz) / determinant
    ellipses = np.stack([x, y, xx, xy, yy, level], axis=1)
    return table, np.ascontiguousarray(ellipses)
