"""Statistics against values worked out by hand or by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.statistics import (
    chi2_quantile,
    mad_sigma,
    rayleigh_sigma,
    residual_stats,
    root_information,
    spatial_median,
    squared_mahalanobis,
)


def test_residual_stats_of_known_residuals() -> None:
    stats = residual_stats([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
    assert stats.count == 2
    assert stats.mean_h_m == pytest.approx(2.5)
    assert stats.rmse_e_m == pytest.approx(np.sqrt(4.5))
    assert stats.rmse_n_m == pytest.approx(np.sqrt(8.0))
    assert stats.rmse_h_m == pytest.approx(np.sqrt(12.5))
    assert stats.rmse_v_m == pytest.approx(np.sqrt(2.0))
    assert stats.rmse_3d_m == pytest.approx(np.sqrt(14.5))
    assert stats.max_3d_m == pytest.approx(5.0)


def test_residual_stats_of_nothing_are_null() -> None:
    stats = residual_stats(np.empty((0, 3)))
    assert stats.count == 0
    assert stats.rmse_3d_m is None


def test_mad_sigma_ignores_forty_percent_outliers() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, 5000)
    assert mad_sigma(values) == pytest.approx(2.0, rel=0.05)
    values[:2000] += 1000.0
    assert mad_sigma(values) < 8.0


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_root_information_whitens(dimension: int) -> None:
    factor = np.random.default_rng(dimension).normal(size=(5, dimension, dimension)) * [[[1e-3]]]
    cov = factor @ np.swapaxes(factor, 1, 2) + 1e-8 * np.eye(dimension)
    root = root_information(cov)
    assert root @ cov @ np.swapaxes(root, 1, 2) == pytest.approx(np.tile(np.eye(dimension), (5, 1, 1)), abs=1e-7)


def test_squared_mahalanobis_of_correlated_errors() -> None:
    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    r = np.array([[1.0, -1.0], [0.5, 2.0]])
    expected = [row @ np.linalg.inv(cov) @ row for row in r]
    assert squared_mahalanobis(r, cov) == pytest.approx(expected)


def test_chi2_quantile_of_many_degrees() -> None:
    degrees = np.array([[1, 3], [0, 3]])
    expected = np.where(degrees > 0, chi2.ppf(0.99, np.maximum(degrees, 1)), 0.0)
    np.testing.assert_allclose(chi2_quantile(0.99, degrees), expected)


def test_spatial_median_is_not_moved_by_a_third_of_wrong_points() -> None:
    rng = np.random.default_rng(0)
    right = np.array([3.0, -2.0, 1.0]) + rng.normal(0, 0.05, (20, 3))
    wrong = np.array([10.0, 5.0, 0.0]) + rng.normal(0, 3.0, (9, 3))
    # Of 20 points with σ 0.05 m, moved by 9 from one side: a few tenths of σ, and never metres.
    found = spatial_median(np.concatenate([right, wrong]))
    assert np.linalg.norm(found - [3.0, -2.0, 1.0]) < 0.1


def test_spatial_median_turns_with_the_axes() -> None:
    rng = np.random.default_rng(1)
    points, turn = rng.normal(size=(7, 3)), exp_so3(np.array([0.3, -1.0, 0.4]))
    np.testing.assert_allclose(spatial_median(points @ turn.T), turn @ spatial_median(points), atol=1e-4)
    np.testing.assert_allclose(spatial_median(np.ones((4, 3))), [1.0, 1.0, 1.0])


def test_rayleigh_sigma_is_that_of_a_coordinate() -> None:
    residual = np.random.default_rng(4).normal(0.0, 0.7, (20_000, 2))
    length = np.linalg.norm(residual, axis=1)
    # The median of 20 000 lengths is known to a hundredth; with 40 % outliers it is their 83rd percentile.
    assert rayleigh_sigma(length) == pytest.approx(0.7, rel=0.03)
    assert rayleigh_sigma(np.append(length, np.nan)) == rayleigh_sigma(length)
    length[:8000] += 1000.0
    assert rayleigh_sigma(length) < 2 * 0.7
