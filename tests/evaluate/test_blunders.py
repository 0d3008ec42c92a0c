"""Check points whose coordinate or mark is wrong, against draws of known truth."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.evaluate.blunders import blunder_caution, find_blunders
from tests.refusals import numbers


def joint_cov(count: int, own_m: float, common_m: float) -> np.ndarray:
    """Return the covariance (3 J, 3 J) of points with errors of their own and one that all share."""
    shared = np.kron(np.ones((count, count)), np.diag([common_m**2] * 3))
    return np.eye(3 * count) * own_m**2 + shared


def draw(count: int, own_m: float, common_m: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    cov = joint_cov(count, own_m, common_m)
    return np.random.default_rng(seed).multivariate_normal(np.zeros(3 * count), cov).reshape(-1, 3), cov


@pytest.mark.parametrize("count", [2, 3, 5, 12])
@pytest.mark.parametrize(("common_m", "size_m"), [(0.02, 0.8), (0.02, 8.0), (2.0, 1.5)])
def test_one_wrong_point_is_named(count: int, common_m: float, size_m: float) -> None:
    for seed in range(20):
        error, cov = draw(count, 0.02, common_m, seed)
        error[seed % count] += size_m * np.array([0.6, 0.0, 0.8])
        found = find_blunders(error, cov)
        if count == 2 and common_m > 1.0:  # both positions are known to metres: either may be the wrong one
            assert not found.wrong.any() and found.doubtful.all()
        else:
            assert np.flatnonzero(found.wrong).tolist() == [seed % count]


def test_two_wrong_points_of_seven_are_named() -> None:
    error, cov = draw(7, 0.02, 0.03, 1)
    error[[2, 5]] += [[1.0, 0.0, 0.0], [0.0, 0.4, 0.0]]
    assert np.flatnonzero(find_blunders(error, cov).wrong).tolist() == [2, 5]


def test_clean_points_are_not_blamed() -> None:
    for seed in range(300):
        error, cov = draw(2 + seed % 9, 0.02, (0.0, 0.05, 2.0)[seed % 3], seed)
        found = find_blunders(error, cov)
        assert not found.wrong.any() and not found.doubtful.any()


@pytest.mark.parametrize("factor", [2.0, 5.0, 20.0])
def test_a_sigma_that_is_too_small_is_not_blamed_on_points(factor: float) -> None:
    blamed = 0
    for seed in range(100):
        error, cov = draw(6, 0.02, 0.02, seed)
        blamed += int(find_blunders(factor * error, cov).wrong.any())
    assert blamed <= 1


def test_an_error_that_all_share_is_not_blamed_on_points() -> None:
    error, cov = draw(6, 0.02, 0.03, 3)
    assert not find_blunders(error + np.array([0.0, 0.0, 1.5]), cov).wrong.any()


def test_a_single_point_is_no_blunder() -> None:
    assert not find_blunders(np.array([[1.5, 0.0, 0.0]]), joint_cov(1, 0.02, 0.02)).wrong.any()


def test_the_caution_names_the_point_and_its_error() -> None:
    error, cov = draw(4, 0.02, 0.02, 2)
    error[1] += [1.5, 0.0, 0.0]
    (caution,) = blunder_caution(("G1", "G7", "G8", "G9"), error, find_blunders(error, cov))
    assert caution.code == "check-point-blunder" and "G7" in caution.sentence and "G8" not in caution.sentence
    assert pytest.approx(float(numbers(caution.sentence.split("G7")[1])[0]), abs=0.1) == 1.5
