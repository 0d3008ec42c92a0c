"""Contour lines: no scraps, no rings around stones, and no further from the surface than its σ."""

import numpy as np
import pytest

from pipelines.deliver.raster import contour_lines
from pipelines.formats.geotiff import RasterFrame

CELL_M, CELLS = 0.25, 320


def slope_with_stones(rng: np.random.Generator, noise_m: float) -> tuple[RasterFrame, np.ndarray, np.ndarray]:
    """A slope of 5 % to the north with noise and thirty stones, and its true heights without them."""
    frame = RasterFrame("", 500.0, 900.0, CELL_M, CELL_M, CELLS, CELLS)
    north = 900.0 - CELL_M * (np.arange(CELLS) + 0.5)
    true = np.repeat(0.05 * (north - 820.0)[:, None], CELLS, axis=1)
    height = true + rng.normal(0, noise_m, true.shape)
    for row, column in rng.integers(10, CELLS - 10, (30, 2)):
        height[row - 2 : row + 3, column - 2 : column + 3] += 0.7
    return frame, height, true


@pytest.mark.parametrize("noise_m", [0.02, 0.1])
def test_a_slope_with_stones_has_one_line_a_height(noise_m: float) -> None:
    frame, height, true = slope_with_stones(np.random.default_rng(1), noise_m)
    lines = contour_lines(height, np.full(height.shape, 0.1), frame, interval=0.5, least=5.0)
    levels = [line.height for line in lines]
    assert len(levels) == len(set(levels)) >= 7  # 4 m of relief
    for line in lines:
        row = (900.0 - line.xy[:, 1]) / CELL_M - 0.5
        off = np.interp(row, np.arange(CELLS), true[:, 0]) - line.height
        assert (
            np.quantile(np.abs(off), 0.9) < 0.1 + noise_m
        )  # σ, and what 1.5 cells of smoothing leave of the noise


def test_without_a_sigma_heights_are_hardly_moved() -> None:
    frame, height, _ = slope_with_stones(np.random.default_rng(1), 0.0)
    height[:, 160:] += 0.3  # a step, which five cells of smoothing would blur
    lines = contour_lines(height, np.zeros(height.shape), frame, interval=0.5, least=5.0)
    across = max(lines, key=lambda line: len(line.xy)).xy
    near = across[np.abs(across[:, 0] - 540.0) < 6 * CELL_M]
    assert np.ptp(near[:, 1]) == pytest.approx(6.0, abs=1.0)  # 0.3 m of height are 6 m of a slope of 5 %
