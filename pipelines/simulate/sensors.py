"""Sensors: GNSS at 10 Hz and attitude at 100 Hz, with realistic errors, each of them known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pipelines.core.types import FloatArray, IntArray, Vector3
from pipelines.geodesy.enu import Origin, geo_from_enu_at, lla_from_enu
from pipelines.geometry.rotations import exp_so3
from pipelines.simulate.flight import LEAD_S, START_NS, TrueTrajectory

GNSS_STEP_NS, IMU_STEP_NS = 100_000_000, 10_000_000
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Receiver:
    """Errors of a GNSS receiver.

    Attributes:
        sigma_h_m, sigma_v_m: white noise, also the σ that the receiver states.
        bias_m: RMS of a slow bias per axis, which the receiver does not state.
        bias_period_s: period of the bias.
        common_error_m: constant error of all fixes, east, north, up, which the receiver does not state.
        outlier_share: share of photographs around which the fixes are wrong.
        outlier_m: size of these errors.
    """

    sigma_h_m: float
    sigma_v_m: float
    bias_m: float = 0.0
    bias_period_s: float = 60.0
    common_error_m: Vector3 = (0.0, 0.0, 0.0)
    outlier_share: float = 0.0
    outlier_m: float = 15.0


RECEIVERS = {
    "rtk": Receiver(0.02, 0.03),
    "ppk": Receiver(0.015, 0.025, bias_m=0.01),
    "consumer": Receiver(1.5, 3.0, bias_m=0.8),
    "outliers": Receiver(0.05, 0.08, outlier_share=0.15),
}


@dataclass(frozen=True)
class Mounting:
    """True arrangement of camera, antenna and clocks.

    Attributes:
        antenna_in_body: (3,) metres from the camera's centre, forward-right-down.
        nominal_from_cam: (3, 3) boresight: true camera axes → nominal axes of the mounting plan.
        clock_offset_s: navigation clock minus camera clock.
    """

    antenna_in_body: FloatArray
    nominal_from_cam: FloatArray
    clock_offset_s: float


@dataclass(frozen=True)
class GnssLog:
    """Records of the receiver, and the truth behind them.

    Attributes:
        stamp_ns: (N,) navigation clock.
        position_in_geo, true_in_geo: (N, 3) measured and true antenna.
        bias_amplitude_m, bias_phase_rad: (3,) bias(t) = amplitude · sin(2πt/period + phase), t from the first
            photograph on the camera's clock.
        wrong_photos: (M,) indices of the photographs with wrong fixes.
    """

    stamp_ns: IntArray
    position_in_geo: FloatArray
    true_in_geo: FloatArray
    bias_amplitude_m: FloatArray
    bias_phase_rad: FloatArray
    wrong_photos: IntArray


@dataclass(frozen=True)
class ImuLog:
    """Records of the attitude sensor; the body is forward-right-down.

    Attributes:
        stamp_ns: (N,) navigation clock.
        geo_from_body: (N, 3, 3) measured.
        rate_in_body: (N, 3) rad/s, specific_force_in_body: (N, 3) m/s².
    """

    stamp_ns: IntArray
    geo_from_body: FloatArray
    rate_in_body: FloatArray
    specific_force_in_body: FloatArray


def record_gnss(
    trajectory: TrueTrajectory, mounting: Mounting, receiver: Receiver, rng: np.random.Generator
) -> GnssLog:
    """Return fixes at 10 Hz of the antenna's true position, with the receiver's errors."""
    since_ns = _epochs(trajectory, mounting, GNSS_STEP_NS)
    time_s = since_ns / 1e9
    arm = trajectory.geo_from_body(time_s) @ mounting.antenna_in_body
    true = trajectory.position(time_s) + arm
    amplitude = np.full(3, np.sqrt(2.0) * receiver.bias_m)
    phase = rng.uniform(0, 2 * np.pi, 3)
    bias = amplitude * np.sin(2 * np.pi * time_s[:, None] / receiver.bias_period_s + phase)
    white = rng.normal(size=true.shape) * [receiver.sigma_h_m, receiver.sigma_h_m, receiver.sigma_v_m]
    count = len(trajectory.photo_s)
    wrong = np.sort(rng.permutation(count)[: round(receiver.outlier_share * count)])
    # Flatter than a sphere, like multipath.
    direction = rng.normal(size=(len(wrong), 3)) * [1.0, 1.0, 0.6]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    jumps = np.zeros((count, 3))
    jumps[wrong] = direction * receiver.outlier_m * rng.uniform(0.7, 1.3, (len(wrong), 1))
    # A reflected signal lasts a while: from halfway before the photograph to halfway after it. Photographs are
    # matched by the navigation clock's stamp, as a user does who does not know the clock offset.
    stamped_s = time_s + mounting.clock_offset_s
    nearest = np.searchsorted((trajectory.photo_s[1:] + trajectory.photo_s[:-1]) / 2, stamped_s)
    stamp_ns = START_NS + since_ns + round(mounting.clock_offset_s * 1e9)
    measured = true + receiver.common_error_m + bias + white + jumps[nearest]
    return GnssLog(stamp_ns, measured, true, amplitude, phase, wrong)


def _epochs(trajectory: TrueTrajectory, mounting: Mounting, step_ns: int) -> IntArray:
    """Return epochs (N,) that cover all photographs, in camera-clock nanoseconds since the first."""
    lead_ns = round((LEAD_S + abs(mounting.clock_offset_s)) * 1e9)
    last_ns = round(float(trajectory.photo_s[-1]) * 1e9) + lead_ns
    return np.arange(-(-lead_ns // step_ns) * -step_ns, last_ns + step_ns, step_ns, dtype=np.int64)


def record_imu(
    trajectory: TrueTrajectory, mounting: Mounting, sigma_deg: float, rng: np.random.Generator
) -> ImuLog:
    """Return attitude, rate and specific force at 100 Hz, with white noise on the attitude."""
    since_ns = _epochs(trajectory, mounting, IMU_STEP_NS)
    time_s = since_ns / 1e9
    true = trajectory.geo_from_body(time_s)
    half_s = 1e-3
    ahead, behind = trajectory.geo_from_body(time_s + half_s), trajectory.geo_from_body(time_s - half_s)
    rate = Rotation.from_matrix(np.swapaxes(behind, 1, 2) @ ahead).as_rotvec() / (2 * half_s)
    force = trajectory.position(time_s, 2) + np.array([0.0, 0.0, GRAVITY_M_S2])
    noise = exp_so3(np.radians(rng.normal(0, sigma_deg, (len(time_s), 3))))
    return ImuLog(
        START_NS + since_ns + round(mounting.clock_offset_s * 1e9),
        true @ noise,
        np.asarray(rate),
        np.einsum("nji,nj->ni", true, force),
    )


def fixes_at(log: GnssLog, stamp_ns: IntArray) -> FloatArray:
    """Return fixes (M, 3) in geo at stamps (M,), linear between the two nearest."""
    since = (log.stamp_ns - log.stamp_ns[0]).astype(np.float64)
    at = (stamp_ns - log.stamp_ns[0]).astype(np.float64)
    return np.stack([np.interp(at, since, log.position_in_geo[:, i]) for i in range(3)], axis=1)


def attitudes_at(log: ImuLog, stamp_ns: IntArray) -> FloatArray:
    """Return attitudes geo ← body (M, 3, 3) at stamps (M,), by slerp between the two nearest."""
    since = (log.stamp_ns - log.stamp_ns[0]).astype(np.float64)
    at = (stamp_ns - log.stamp_ns[0]).astype(np.float64)
    return np.asarray(Slerp(since, Rotation.from_matrix(log.geo_from_body))(at).as_matrix())


def in_local_enu(rotations: FloatArray, positions_in_geo: FloatArray, origin: Origin) -> FloatArray:
    """Return rotations (N, 3, 3) into geo as rotations into East-North-Up at each place (N, 3)."""
    geo_from_enu = geo_from_enu_at(lla_from_enu(positions_in_geo, origin), origin)
    return np.swapaxes(geo_from_enu, -1, -2) @ rotations
