"""Patterns of differences: what is drawn is found, and noise is none of them."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.statistics import blunders_among, scatter_about_median, two_groups

COUNT, SIGMA = 40, 0.02


def noise(seed: int, dimension: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, SIGMA, (COUNT, dimension))


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_shifted_part_is_found_whatever_its_order(share: float) -> None:
    shifted = np.random.default_rng(5).permutation(COUNT) < share * COUNT
    found = two_groups(noise(0) + shifted[:, None] * [3.0, -1.0, 0.5])
    assert found is not None
    assert np.array_equal(found.second, shifted) or np.array_equal(found.second, ~shifted)
    # The medians of 8 and 32 members err by 1.25 σ/√n: 1 cm; 4 σ of that.
    assert np.abs(np.abs(found.apart) - [3.0, 1.0, 0.5]).max() < 0.04


@pytest.mark.parametrize("dimension", [2, 3])
def test_noise_is_no_mixture_and_has_no_blunders(dimension: int) -> None:
    for seed in range(50):
        offsets = noise(seed, dimension)
        assert two_groups(offsets) is None
        assert blunders_among(offsets, SIGMA) is None


def test_scattered_blunders_are_no_group() -> None:
    rng = np.random.default_rng(6)
    bad = rng.permutation(COUNT) < 0.4 * COUNT
    offsets = noise(1) + bad[:, None] * rng.normal(0, 15.0, (COUNT, 3))
    assert two_groups(offsets) is None
    found = blunders_among(offsets, SIGMA)
    assert found is not None
    assert np.array_equal(found, bad)


def test_too_few_are_no_groups() -> None:
    assert two_groups([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01], [5.0, 5.0], [5.01, 5.0]]) is None


def test_scatter_ignores_forty_percent_blunders() -> None:
    offsets = noise(2)
    offsets[:16] += 100.0
    # At 40 %, the median is the 83 % quantile of the good ones: 5.0 of χ²₃ instead of 2.4.
    assert SIGMA < scatter_about_median(offsets) < 2.5 * SIGMA
