"""Noise, significance and volumes of a difference of heights, on rasters whose noise and change are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipelines.change.detection import (
    LAGS,
    Cells,
    Noise,
    Samples,
    region_volumes,
    significant_change,
    slow_error_m,
    unchanged_ground,
)
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray

SIDE, CELL_M, SIGMA_M, SHIFT_M = 320, 0.25, 0.04, 0.03


def correlated_noise(rng: np.random.Generator) -> FloatArray:
    noise = gaussian_filter(rng.normal(0, 1, (SIDE, SIDE)), 3.0, mode="wrap")
    return np.asarray(SIGMA_M * noise / noise.std())


def level_cells(difference: FloatArray, variance: FloatArray, datum: FloatArray, slope: FloatArray) -> Cells:
    """Measured cells without any height step beside them."""
    shape = difference.shape
    return Cells(difference, variance, datum, slope, np.zeros(shape), np.ones(shape, dtype=bool))


def analysed(difference: FloatArray, stated: float = 0.5, slow_m: float = 0.0) -> tuple[Cells, Noise]:
    """Cells of a level raster whose variance is stated as a multiple of what it is, and their noise."""
    shape = difference.shape
    slope = np.random.default_rng(0).normal(0, 0.1, (*shape, 2))
    cells = level_cells(difference, np.full(shape, stated * SIGMA_M**2), np.zeros(shape), slope)
    row, column = (axis.ravel()[::7] for axis in np.indices(shape))
    place = np.asarray(CELL_M * (np.stack([column, -row], axis=-1) - SIDE / 2.0), dtype=np.float64)
    design = np.concatenate(
        [np.ones((*shape, 1)), -slope, np.zeros((*shape, 2)), np.sqrt(cells.variance_m2)[..., None]], axis=-1
    )
    normalised = difference / np.sqrt(cells.variance_m2)
    pairs = {lag: np.stack([normalised[:, :-lag].ravel(), normalised[:, lag:].ravel()], 1)[::5] for lag in LAGS}
    designs = {
        lag: np.stack([design[:, :-lag].reshape(-1, 6), design[:, lag:].reshape(-1, 6)], 1)[::5] for lag in LAGS
    }
    picked = level_cells(
        difference[row, column], cells.variance_m2[row, column], np.zeros(len(row)), slope[row, column]
    )
    samples = Samples(picked, place, pairs, designs)
    return cells, unchanged_ground(samples, CELL_M, 0.05, with_tilt=False, slow_m=slow_m)


def test_noise_of_no_change_is_found_and_gives_few_false_alarms() -> None:
    """Twice the stated variance, a shift, and noise correlated as exp(−h²/4s²), whose integral is 4πs² cells."""
    cells, noise = analysed(SHIFT_M + correlated_noise(np.random.default_rng(1)))
    assert noise.factor == pytest.approx(2.0, rel=0.15)
    assert noise.correlated_m2 == pytest.approx(4 * np.pi * 9 * CELL_M**2, rel=0.35)
    assert abs(noise.shift_m[2] - SHIFT_M) < 3 * np.sqrt(noise.shift_cov_m2[2, 2])
    centred = replace(cells, difference_m=cells.difference_m - noise.shift_m[2])
    sign = significant_change(centred, noise.factor, 4)
    assert (sign != 0).mean() < 0.05


def test_smooth_ground_does_not_lower_the_level_of_rough_ground() -> None:
    """A tenth of the ground scatters as predicted, the rest half as much: none of it has changed.

    By the scatter of most of the ground, a third of the rough cells would exceed their level.
    """
    noise_m = correlated_noise(np.random.default_rng(3))
    rough = np.zeros((SIDE, SIDE), dtype=bool)
    rough[:, : SIDE // 10] = True
    cells, noise = analysed(np.where(rough, 2.0, 1.0) * noise_m, stated=4.0)
    assert noise.scatter == pytest.approx(0.5, rel=0.15)
    sign = significant_change(cells, noise.factor, 4)
    assert (sign[rough] != 0).mean() < 0.05
    assert (significant_change(cells, noise.scatter**2, 4)[rough] != 0).mean() > 0.1


def test_an_interpolated_part_errs_as_one() -> None:
    """40 cells of a pit of which one epoch has interpolated heights, all off by one error of 0.5 m."""
    shape, sigma_m = (20, 30), 0.5
    inside, hole = np.zeros(shape, np.int64), np.zeros(shape, dtype=bool)
    inside[5:15, 5:25], hole[5:9, 5:15] = 1, True
    cells = level_cells(np.full(shape, -1.0), np.zeros(shape), np.zeros(shape), np.zeros((*shape, 2)))
    cells = replace(cells, step_m2=np.where(hole, sigma_m**2, 0.0), is_measured=~hole)
    _, noise = analysed(correlated_noise(np.random.default_rng(2)))
    (volume,) = region_volumes(inside, cells, 1)
    assert volume.sigma_m3(noise, CELL_M**2) == pytest.approx(40 * sigma_m * CELL_M**2)


def test_a_copy_is_told_from_a_second_flight() -> None:
    with pytest.raises(DegenerateGeometryError, match="of one flight"):
        analysed(np.full((SIDE, SIDE), SHIFT_M))


@pytest.mark.parametrize("slow_m", [0.0, 0.01, 0.03])
def test_slow_errors_are_told_from_noise(slow_m: float) -> None:
    """9000 points with 2.5 cm of noise, a tenth of them off by decimetres, in 150 blocks that err as wholes.

    The σ of 150 normal errors is known to 6 %; the noise of a block's median of 60, 4 mm, is taken off to a third.
    """
    rng = np.random.default_rng(6)
    place_m = rng.uniform(0, (150.0, 100.0), (9000, 2))
    of_block = rng.normal(0, 1.0, (10, 15))
    column, row = (place_m // 10.0).astype(int).T
    error_m = slow_m * of_block[row, column] + rng.normal(0, 0.025, 9000)
    error_m[::10] += 0.4
    found_m = slow_error_m(place_m, error_m, np.full(2, 10.0))
    assert found_m == pytest.approx(slow_m, rel=0.2, abs=0.0025)


def test_a_region_has_the_slow_errors_that_unchanged_ground_hides() -> None:
    """Both surfaces err alike where nothing has changed; a volume has the whole σ of what each is known to err."""
    cells, noise = analysed(correlated_noise(np.random.default_rng(7)), slow_m=0.05)
    assert noise.long_range_m == pytest.approx(0.05)
    inside = np.zeros((SIDE, SIDE), dtype=np.int64)
    inside[40:280, 40:280] = 1
    level = replace(cells, datum_m=np.full((SIDE, SIDE), noise.long_range_m))
    (volume,) = region_volumes(inside, level, 1)
    area_m2 = (inside > 0).sum() * CELL_M**2
    assert volume.sigma_m3(noise, CELL_M**2) == pytest.approx(0.05 * area_m2, rel=0.05)


def test_volumes_err_as_their_sigma_says_over_twenty_pairs() -> None:
    """A heap of 0.5 m: the RMS of error over σ of 20 independent pairs is 0.7 … 1.4, as for 97 % of samples.

    The region is given: its volume has no bias of detection.
    """
    rows, columns = np.indices((SIDE, SIDE))
    inside = (np.hypot(rows - 160, columns - 160) < 30).astype(np.int64)
    ratios = []
    for seed in range(20):
        truth = 0.5 * inside
        cells, noise = analysed(SHIFT_M + truth + correlated_noise(np.random.default_rng(100 + seed)))
        moved = np.full((SIDE, SIDE), np.sqrt(noise.shift_cov_m2[2, 2]))
        centred = replace(cells, difference_m=cells.difference_m - noise.shift_m[2], datum_m=moved)
        (volume,) = region_volumes(inside, centred, 1)
        found_m3, true_m3 = (volume.fill - volume.cut) * CELL_M**2, truth.sum() * CELL_M**2
        ratios.append((found_m3 - true_m3) / volume.sigma_m3(noise, CELL_M**2))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    sign = significant_change(centred, noise.factor, 4)
    assert (sign[inside == 1] == 1).mean() > 0.95
