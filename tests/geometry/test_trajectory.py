"""Interpolation in time against a motion that is known at every moment."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.core.types import FloatArray
from pipelines.geometry.trajectory import Trajectory

RATE_RAD_S = 0.7
AXIS = np.array([1.0, 2.0, -2.0]) / 3.0


def attitude(time_s: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(RATE_RAD_S * time_s[:, None] * AXIS).as_matrix())


def motion(time_s: FloatArray, max_gap_s: float = 1.0) -> Trajectory:
    """Constant velocity and a constant rate of turn: lines and shortest arcs are exact."""
    return Trajectory.from_samples(
        time_s,
        position=time_s[:, None] * [1.0, -2.0, 0.5] + 6e6,
        rotation=attitude(time_s),
        sigma_m=0.1 + 0.01 * np.stack([time_s] * 3, axis=-1),
        sigma_deg=0.2 + 0.1 * time_s,
        max_gap_s=max_gap_s,
    )


def known(trajectory: Trajectory) -> list[bool]:
    return np.isfinite(trajectory.position).all(axis=1).tolist()


def test_between_samples_the_motion_is_met_exactly() -> None:
    time_s = np.array([0.3, 0.8, 1.0, 2.39, 0.0, 2.4])
    there = motion(np.array([0.0, 0.8, 1.1, 2.0, 2.4])).at(time_s)
    np.testing.assert_allclose(there.position, time_s[:, None] * [1.0, -2.0, 0.5] + 6e6, rtol=0, atol=1e-8)
    np.testing.assert_allclose(there.rotation, attitude(time_s), rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.sigma_m[:, 0], 0.1 + 0.01 * time_s, atol=1e-12)
    np.testing.assert_allclose(there.sigma_deg, 0.2 + 0.1 * time_s, atol=1e-12)


def test_nothing_outside_and_nothing_over_gaps() -> None:
    time_s = np.array([-0.2, 0.25, 1.7, 3.0, 3.0005, 3.9, np.nan])
    there = motion(np.array([0.0, 0.5, 3.0, 3.4])).at(time_s)
    assert known(there) == [False, True, False, True, True, False, False]
    assert np.isfinite(there.rotation).all(axis=(1, 2)).tolist() == known(there)


def test_an_instant_within_a_millisecond_of_a_sample_takes_it() -> None:
    samples = motion(np.array([0.0, 0.5, 3.0]))
    there = samples.at(np.array([-0.0009, 0.5009, 2.9995, 3.0009, 3.002]))
    assert known(there) == [True, True, True, True, False]
    np.testing.assert_array_equal(there.position[:4], samples.position[[0, 1, 2, 2]])


@pytest.mark.parametrize("max_gap_s", [0.1, np.inf])
def test_a_single_sample_serves_its_own_moment(max_gap_s: float) -> None:
    there = motion(np.array([5.0]), max_gap_s).at(np.array([5.0004, 5.5]))
    assert known(there) == [True, False]


def test_no_samples_give_nothing() -> None:
    assert known(motion(np.empty(0)).at(np.array([0.0, 1.0]))) == [False, False]


def test_a_quantity_that_a_neighbour_lacks_is_not_known() -> None:
    samples = motion(np.array([0.0, 0.5, 1.0]))
    samples.rotation[2] = np.nan
    samples.sigma_m[0] = np.nan
    there = samples.at(np.array([0.25, 0.75]))
    assert known(there) == [True, True]
    assert np.isfinite(there.rotation).all(axis=(1, 2)).tolist() == [True, False]
    assert np.isfinite(there.sigma_m).all(axis=1).tolist() == [False, True]
