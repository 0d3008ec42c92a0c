"""Offset, boresight and lever arm come back from flights whose rig is known, and are refused where unseen."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from pipelines.adjust.alignment import Correspondences
from pipelines.adjust.rig_fit import LIMIT_OFFSET_S, FitOptions, RigData, fit_rig
from pipelines.adjust.state import SIGMA_ARM_M, SIGMA_BORESIGHT_RAD, SystematicError, SystematicErrors, is_observed
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.trajectory import Trajectory
from pipelines.simulate.flight import (
    RECEIVERS,
    FlightPlan,
    Mounting,
    TrueTrajectory,
    make_trajectory,
    record_gnss,
    record_imu,
)
from tests.refusals import refused

OFFSET_S, BORESIGHT_DEG, ARM_M = 0.2, np.array([0.6, -0.5, 0.62]), np.array([0.25, -0.1, -0.15])
PIXEL_RAD = 1 / 3000  # 3 cm at 100 m
GEO_FROM_LOCAL = Similarity(17.0, exp_so3([0.3, 0.6, 0.7]), np.array([5.0, -40.0, 12.0]))


def _flight(kind: str, images: int = 48, seed: int = 0) -> TrueTrajectory:
    heights = {"orbit": (50.0, 70.0), "grid": (70.0,)}[kind]
    plan = FlightPlan(kind, images, None, heights, {"orbit": 85.0, "grid": 60.0}[kind])
    return make_trajectory(plan, (20.0, 15.0), np.eye(3), np.random.default_rng(seed))


def _data(track: TrueTrajectory, seed: int = 1, control: int = 0, *, arm_m: np.ndarray = ARM_M) -> RigData:
    """Navigation of an RTK receiver and an attitude of 0.5°, SfM cameras with errors of 5 mm and 0.02°.

    `arm_m` is the lever arm to start from.
    """
    rng = np.random.default_rng(seed)
    mounting = Mounting(ARM_M, exp_so3(np.radians(BORESIGHT_DEG)), OFFSET_S)
    gnss, imu = record_gnss(track, mounting, RECEIVERS["rtk"], rng), record_imu(track, mounting, 0.5, rng)
    true_geo_from_cam = track.geo_from_nominal_cam(track.photo_s) @ mounting.nominal_from_cam
    local_from_geo = GEO_FROM_LOCAL.inverse()
    count = len(track.photo_s)
    noise = exp_so3(np.radians(rng.normal(0, 0.02, (count, 3))))
    start = 1_700_000_000
    points = rng.uniform(-40, 40, (control, 3))
    return RigData(
        positions=Trajectory.from_samples(gnss.stamp_ns / 1e9, position=gnss.position_in_geo, max_gap_s=1.0),
        attitudes=Trajectory.from_samples(imu.stamp_ns / 1e9, rotation=imu.geo_from_body, max_gap_s=1.0),
        time_s=start + track.photo_s,
        center_in_local=local_from_geo.apply(track.position(track.photo_s) + rng.normal(0, 0.005, (count, 3))),
        cam_from_local=noise @ np.swapaxes(true_geo_from_cam, 1, 2) @ GEO_FROM_LOCAL.rotation,
        cam_from_body=np.tile(track.cam_from_body, (count, 1, 1)),
        antenna_in_body=np.tile(arm_m, (count, 1)),
        control=Correspondences(
            name=tuple(map(str, range(control))),
            control=np.ones(control, dtype=bool),
            in_local=local_from_geo.apply(points),
            cov_in_local=np.zeros((control, 3, 3)),
            in_geo=points,
            cov_in_geo=np.tile(1e-4 * np.eye(3), (control, 1, 1)),
        ),
        pixel_rad=PIXEL_RAD,
        footprint_in_local=100.0 * PIXEL_RAD / GEO_FROM_LOCAL.scale,
    )


@pytest.mark.parametrize("kind", ["orbit", "grid"])
@pytest.mark.parametrize("seed", [1, 2])
def test_offset_and_boresight(kind: str, seed: int) -> None:
    found = fit_rig(_data(_flight(kind, seed=seed), seed), 0.0, np.eye(3), FitOptions())
    assert found.state.offset_s == pytest.approx(OFFSET_S, abs=0.02)
    missed_deg = np.degrees(log_so3(found.state.boresight @ exp_so3(np.radians(BORESIGHT_DEG)).T))
    assert np.linalg.norm(missed_deg) < 0.1
    assert found.sigma[7] < 0.01 and abs(found.state.offset_s - OFFSET_S) < 4 * found.sigma[7]
    assert np.all(np.abs(missed_deg) < 4 * np.degrees(found.sigma[8:11]))
    assert found.rms_position_m < 0.05


@pytest.mark.slow
def test_lever_arm_with_control_points() -> None:
    data = _data(_flight("orbit"), control=6, arm_m=np.zeros(3))
    found = fit_rig(data, 0.0, np.eye(3), FitOptions(arm=True))
    sigma = found.sigma[11:14]
    assert is_observed("lever-arm", sigma, SIGMA_ARM_M).all()
    assert np.all(np.abs(found.state.arm - ARM_M) < np.maximum(4 * sigma, 0.01))
    assert found.state.offset_s == pytest.approx(OFFSET_S, abs=0.02)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.slow
def test_lever_arm_of_an_orbit_needs_control_points(seed: int) -> None:
    """Inwards and down it passes for another scale and height, ahead for another time: only wobble tells."""
    sigma = []
    for control in (0, 6):
        data = _data(_flight("orbit", seed=seed), seed, control, arm_m=np.zeros(3))
        data = replace(data, footprint_in_local=0.0)
        found = fit_rig(data, 0.0, np.eye(3), FitOptions(arm=True))
        sigma.append(found.sigma[11:14])
        assert np.all(np.abs(found.state.arm - ARM_M) < 3 * found.sigma[11:14])
    assert (sigma[0] > 3 * sigma[1]).all() and (sigma[1] < 0.04).all()


def _tilted(data: RigData, pixels: float) -> RigData:
    """All cameras tilted by so many pixels about their own x axes, the control points where their rays then meet.

    This is what a lens does that SfM has not quite found: the pixels hardly tell.
    """
    tilt = exp_so3([pixels * data.pixel_rad, 0.0, 0.0])
    before, after = (np.swapaxes(one, 1, 2) for one in (data.cam_from_local, tilt @ data.cam_from_local))
    control = []
    for point in data.control.in_local:
        ray = point - data.center_in_local
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        ray = np.einsum("nij,nkj,nk->ni", after, before, ray)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        control.append(np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, data.center_in_local)))
    moved = replace(data.control, in_local=np.array(control))
    return replace(data, cam_from_local=tilt @ data.cam_from_local, control=moved)


@pytest.mark.slow
def test_sigma_counts_a_lens_that_sfm_has_not_quite_found() -> None:
    data = _tilted(_data(_flight("orbit"), control=6, arm_m=np.zeros(3)), 1.0)
    found = fit_rig(data, 0.0, np.eye(3), FitOptions(arm=True))
    missed = log_so3(found.state.boresight @ exp_so3(np.radians(BORESIGHT_DEG)).T)
    assert np.linalg.norm(missed) > 0.5 * PIXEL_RAD  # it does harm
    assert np.all(np.abs(missed) < 3 * found.sigma[8:11])
    assert np.all(np.abs(found.state.arm - ARM_M) < 3 * found.sigma[11:14])


@pytest.mark.slow
def test_downward_lever_arm_of_a_level_flight_is_not_observable() -> None:
    data = _data(_flight("grid"), arm_m=np.zeros(3))
    found = fit_rig(data, 0.0, np.eye(3), FitOptions(arm=True))
    # The height of the whole takes it up.
    assert not is_observed("lever-arm", found.sigma[11:14], SIGMA_ARM_M)[2]


@pytest.mark.parametrize(
    ("name", "prior", "limit", "unit"),
    [("lever-arm", SIGMA_ARM_M, 0.1, 1.0), ("boresight", SIGMA_BORESIGHT_RAD, np.radians(0.5), np.degrees(1.0))],
)
def test_calibration_and_adjustment_observe_by_one_rule(
    name: Literal["lever-arm", "boresight"], prior: float, limit: float, unit: float
) -> None:
    """At the limit, the prior moves an estimate by 1 % of the way to its start."""
    assert limit**2 / (limit**2 + prior**2) < 0.01
    sigma = np.array([0.99, 1.01, 0.5]) * limit
    seen = is_observed(name, sigma, prior)
    assert seen.tolist() == [True, False, True]
    errors = SystematicErrors((SystematicError(name, (prior, prior, prior)),))
    (estimate,) = errors.estimates(np.zeros(3), np.diag(sigma**2))
    assert estimate.observed == tuple(seen.tolist())
    assert np.array(estimate.prior) == pytest.approx(unit * prior)


def test_long_lever_arm_is_not_drawn_to_its_start() -> None:
    """An arm of 1.5 m, half as long again as the σ of its prior."""
    offset_m = np.array([1.2, -0.8, 0.4])
    data = _data(_flight("orbit"), control=6, arm_m=ARM_M - offset_m)
    found = fit_rig(data, 0.0, np.eye(3), FitOptions(arm=True))
    sigma = found.sigma[11:14]
    assert np.all(np.abs(found.state.arm - offset_m) < np.maximum(4 * sigma, 0.015))


def _circle(speed_wobble: float) -> RigData:
    """A circle that looks inwards, at constant speed but for a share `speed_wobble`."""
    data = _data(_flight("orbit"))
    clock = data.positions.time_s

    def angle(time_s: FloatArray) -> FloatArray:
        t = time_s - data.time_s[0]
        return 0.1 * (t + speed_wobble * 3.0 * np.sin(t / 3.0))

    def place(time_s: FloatArray) -> FloatArray:
        return np.stack(
            [85 * np.cos(angle(time_s)), 85 * np.sin(angle(time_s)), np.full(len(time_s), 60.0)], axis=1
        )

    rng = np.random.default_rng(0)
    fixes = place(clock - OFFSET_S) + rng.normal(0, 0.02, (len(clock), 3))
    positions, none = replace(data.positions, position=fixes), Trajectory.from_samples(np.empty(0))
    return replace(
        data,
        positions=positions,
        attitudes=none,
        center_in_local=GEO_FROM_LOCAL.inverse().apply(place(data.time_s)),
    )


def test_offset_of_a_circle_at_constant_speed_is_not_observable() -> None:
    found = fit_rig(_circle(0.0), 0.0, np.eye(3), FitOptions())
    assert found.sigma[7] > LIMIT_OFFSET_S
    found = fit_rig(_circle(0.3), 0.0, np.eye(3), FitOptions())
    assert found.sigma[7] < LIMIT_OFFSET_S
    assert found.state.offset_s == pytest.approx(OFFSET_S, abs=0.02)


@pytest.mark.parametrize("speed_m_s", [0.0, 5.0])
def test_hover_and_straight_line_are_refused(speed_m_s: float) -> None:
    data = _data(_flight("orbit"))
    start = data.time_s[0]
    rng = np.random.default_rng(0)

    def place(time_s: FloatArray) -> FloatArray:
        return np.outer(time_s - start, [speed_m_s, 0, 0]) + rng.normal(0, 0.02, (len(time_s), 3))

    positions = replace(data.positions, position=place(data.positions.time_s))
    data = replace(data, positions=positions, center_in_local=GEO_FROM_LOCAL.inverse().apply(place(data.time_s)))
    with refused("rig-not-observable", DegenerateGeometryError):
        fit_rig(data, 0.0, np.eye(3), FitOptions())


@pytest.mark.slow
def test_the_end_of_the_search_is_no_offset() -> None:
    data = _data(_flight("grid"))
    data = replace(data, time_s=data.time_s - 18.0)  # as GPS time and UTC differ
    with refused("time-offset-at-limit", DegenerateGeometryError) as error:
        fit_rig(data, 0.0, np.eye(3), FitOptions())
    assert "--max-offset 30" in str(error.value)
    found = fit_rig(data, 0.0, np.eye(3), FitOptions(max_offset_s=30.0))
    assert found.state.offset_s == pytest.approx(18.0 + OFFSET_S, abs=0.02)
