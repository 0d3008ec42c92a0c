"""The sensors' errors are those of the options."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pipelines.geometry.rotations import exp_so3, geo_from_cam, log_so3
from pipelines.simulate.flight import (
    GRAVITY_M_S2,
    FlightPlan,
    Mounting,
    Receiver,
    TrueTrajectory,
    attitudes_at,
    fixes_at,
    make_trajectory,
    record_gnss,
    record_imu,
)

COMPLEX = (17.5, 18.5)
STRAIGHT = Mounting(np.zeros(3), np.eye(3), 0.0)


@pytest.fixture(scope="module")
def trajectory() -> TrueTrajectory:
    plan = FlightPlan("orbit", 200, 2.0, (60.0,), 85.0)
    return make_trajectory(plan, COMPLEX, np.eye(3), np.random.default_rng(1))


def within(sigma: float, errors: np.ndarray) -> bool:
    """Return whether the errors' variance fits σ², by a χ² test that fails a sound sensor once in a million."""
    low, high = stats.chi2.interval(1 - 1e-6, errors.size)
    return bool(low < np.square(errors).sum() / sigma**2 < high)


def test_white_noise_has_its_sigma_and_no_memory(trajectory: TrueTrajectory) -> None:
    log = record_gnss(trajectory, STRAIGHT, Receiver(0.02, 0.03), np.random.default_rng(2))
    error = log.position_in_geo - trajectory.position((log.stamp_ns - trajectory.stamp_ns[0]) / 1e9)
    assert within(0.02, error[:, :2])
    assert within(0.03, error[:, 2])
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 5 / np.sqrt(len(error))


def test_rates_and_cover(trajectory: TrueTrajectory) -> None:
    gnss = record_gnss(trajectory, STRAIGHT, Receiver(0.02, 0.03), np.random.default_rng(2))
    imu = record_imu(trajectory, STRAIGHT, 0.5, np.random.default_rng(3))
    assert set(np.diff(gnss.stamp_ns)) == {100_000_000}
    assert set(np.diff(imu.stamp_ns)) == {10_000_000}
    stamps = trajectory.stamp_ns
    for log in (gnss, imu):
        assert log.stamp_ns[0] <= stamps[0] - 1_000_000_000
        assert log.stamp_ns[-1] >= stamps[-1] + 1_000_000_000


def test_bias_is_the_stated_sine_about_the_common_error(trajectory: TrueTrajectory) -> None:
    common = (0.03, -0.02, 0.05)
    receiver = Receiver(0.0, 0.0, bias_m=0.8, bias_period_s=40.0, common_error_m=common)
    log = record_gnss(trajectory, STRAIGHT, receiver, np.random.default_rng(4))
    time_s = (log.stamp_ns - trajectory.stamp_ns[0]) / 1e9
    stated = log.bias_amplitude_m * np.sin(2 * np.pi * time_s[:, None] / 40.0 + log.bias_phase_rad)
    np.testing.assert_allclose(log.position_in_geo - log.true_in_geo, stated + common, atol=1e-9)
    # Ten whole periods: the RMS is the amplitude over √2.
    np.testing.assert_allclose(np.sqrt(np.square(stated).mean(axis=0)), 0.8, rtol=0.02)


def test_outliers_are_as_many_and_as_large_as_asked(trajectory: TrueTrajectory) -> None:
    receiver = Receiver(0.0, 0.0, outlier_share=0.15, outlier_m=15.0)
    log = record_gnss(trajectory, STRAIGHT, receiver, np.random.default_rng(5))
    stamps = trajectory.stamp_ns
    true = fixes_at(log, stamps) - trajectory.position(trajectory.photo_s)
    size = np.linalg.norm(true, axis=1)
    assert np.nonzero(size > 1e-6)[0].tolist() == log.wrong_photos.tolist()
    assert len(log.wrong_photos) == 30
    assert (size[log.wrong_photos] > 0.7 * 15 - 1e-9).all()
    assert (size[log.wrong_photos] < 1.3 * 15 + 1e-9).all()


def test_lever_arm_puts_the_antenna_above_the_level_body(trajectory: TrueTrajectory) -> None:
    mounting = Mounting(np.array([0.0, 0.0, -0.3]), np.eye(3), 0.0)
    log = record_gnss(trajectory, mounting, Receiver(0.0, 0.0), np.random.default_rng(6))
    arm = log.true_in_geo - trajectory.position((log.stamp_ns - trajectory.stamp_ns[0]) / 1e9)
    np.testing.assert_allclose(np.linalg.norm(arm, axis=1), 0.3, atol=1e-9)
    # The mount carries the camera's tilt, so that the body sways by its few degrees only.
    assert (arm[:, 2] > 0.3 * np.cos(np.radians(12))).all()


@pytest.mark.parametrize("offset_s", [0.2, -0.137])
def test_clock_offset_shifts_the_stamps(trajectory: TrueTrajectory, offset_s: float) -> None:
    mounting = Mounting(np.zeros(3), np.eye(3), offset_s)
    log = record_gnss(trajectory, mounting, Receiver(0.0, 0.0), np.random.default_rng(7))
    read = fixes_at(log, trajectory.stamp_ns)
    expected = trajectory.position(trajectory.photo_s - offset_s)
    # Linear interpolation between fixes 0.1 s apart misses a·Δt²/8.
    most = np.abs(trajectory.position(np.arange(0.0, 400.0, 0.1), 2)).max() * 0.1**2 / 8
    np.testing.assert_allclose(read, expected, atol=1.05 * most)


def test_attitude_noise_has_its_sigma(trajectory: TrueTrajectory) -> None:
    log = record_imu(trajectory, STRAIGHT, 0.5, np.random.default_rng(8))
    true = trajectory.geo_from_body((log.stamp_ns - trajectory.stamp_ns[0]) / 1e9)
    error = log_so3(np.swapaxes(true, 1, 2) @ log.geo_from_body)
    assert within(np.radians(0.5), error)


def test_rates_and_forces_are_those_of_the_motion(trajectory: TrueTrajectory) -> None:
    log = record_imu(trajectory, STRAIGHT, 0.0, np.random.default_rng(9))
    steps = log.geo_from_body[:-1] @ exp_so3(0.01 * log.rate_in_body[:-1])
    # Euler's step over 10 ms misses half the angular acceleration's share, well below 1e-4 rad.
    assert np.abs(log_so3(np.swapaxes(steps, 1, 2) @ log.geo_from_body[1:])).max() < 1e-4
    force = np.einsum("nij,nj->ni", log.geo_from_body, log.specific_force_in_body)
    time_s = (log.stamp_ns - trajectory.stamp_ns[0]) / 1e9
    np.testing.assert_allclose(
        force - trajectory.position(time_s, 2), [[0, 0, GRAVITY_M_S2]] * len(force), atol=1e-9
    )


def test_attitude_is_read_at_the_photographs(trajectory: TrueTrajectory) -> None:
    log = record_imu(trajectory, STRAIGHT, 0.0, np.random.default_rng(10))
    read = attitudes_at(log, trajectory.stamp_ns) @ trajectory.cam_from_body.T
    np.testing.assert_allclose(read, trajectory.geo_from_nominal_cam(trajectory.photo_s), atol=1e-9)


@pytest.mark.parametrize("kind", ["orbit", "grid", "facade"])
def test_flights_look_where_they_should(kind: str) -> None:
    plan = FlightPlan(kind, 24, None, (40.0, 55.0), 60.0)
    turn = 0.3
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    trajectory = make_trajectory(plan, COMPLEX, axes, np.random.default_rng(11))
    centers = trajectory.position(trajectory.photo_s)
    looks = trajectory.geo_from_nominal_cam(trajectory.photo_s)[:, :, 2]
    assert abs(np.sort(centers[:, 2]) - np.repeat([40.0, 55.0], 12)).max() < 3
    if kind == "grid":
        assert (looks[:, 2] < -np.cos(np.radians(8))).all()
        assert np.abs(centers @ axes.T)[:, :2].max() < 63
    else:
        inward = -centers[:, :2] / np.linalg.norm(centers[:, :2], axis=1, keepdims=True)
        level = looks[:, :2] / np.linalg.norm(looks[:, :2], axis=1, keepdims=True)
        assert ((level * inward).sum(axis=1) > np.cos(np.radians(10 if kind == "orbit" else 35))).all()
    if kind == "facade":
        outside = np.abs(centers @ axes.T)[:, :2] - COMPLEX
        gap = np.where((outside > 0).all(axis=1), np.linalg.norm(outside, axis=1), outside.max(axis=1))
        np.testing.assert_allclose(gap, 60.0, atol=2.5)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1) / np.diff(trajectory.photo_s)
    assert np.median(steps) < 8.5
    body = trajectory.geo_from_body(trajectory.photo_s)
    assert (body[:, 2, 2] < -np.cos(np.radians(12))).all()  # the body's down axis points down


def test_gimbal_angles_of_a_body_with_its_mount() -> None:
    plan = FlightPlan("orbit", 12, 2.0, (60.0,), 85.0)
    trajectory = make_trajectory(plan, COMPLEX, np.eye(3), np.random.default_rng(12))
    tilted = trajectory.geo_from_body(0.0) @ trajectory.cam_from_body.T
    np.testing.assert_allclose(tilted, trajectory.geo_from_nominal_cam(0.0), atol=1e-12)
    assert geo_from_cam([0.0, 0.0, 0.0])[:, 2].tolist() == pytest.approx([0.0, 1.0, 0.0])
