"""Flights: the true motion of the camera, and what GNSS at 10 Hz and an attitude sensor at 100 Hz record of it.

The errors of the sensors are realistic, and each of them is known.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from pipelines.core.types import FloatArray, IntArray, Vector3
from pipelines.geodesy.enu import Origin, geo_from_enu_at, lla_from_enu
from pipelines.geometry.rotations import ENU_FROM_NED, exp_so3, geo_from_cam

START_NS = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC
GNSS_STEP_NS, IMU_STEP_NS = 100_000_000, 10_000_000
GRAVITY_M_S2 = 9.80665
LEAD_S = 1.0  # time that the sensors run before the first and after the last photograph
_LOOK_AT_M = 6.0
_SPEED_M_S = 8.0
DEFAULT_HEIGHTS_M = {"orbit": (60.0,), "grid": (70.0,), "facade": (7.0, 15.0)}
DEFAULT_RADIUS_M = {"orbit": 85.0, "grid": 60.0, "facade": 19.0}


@dataclass(frozen=True)
class FlightPlan:
    """Plan of a flight."""

    kind: str  # "orbit", "grid" or "facade"
    images: int
    interval_s: float | None  # None for 2 s, or more where the aircraft would be faster than 8 m/s
    heights_m: tuple[float, ...]  # above the origin, one round each
    radius_m: float  # radius, half side, or distance from the facade


@dataclass(frozen=True)
class TrueTrajectory:
    """True motion of the camera. Times are seconds of the camera's clock since the first photograph."""

    photo_s: FloatArray  # (N,)
    cam_from_body: FloatArray  # (3, 3) nominal mounting; body axes: forward, right, down
    position: CubicSpline  # (N, 3) camera centres in geo at times (N,); second derivative in m/s²
    _angles: PchipInterpolator

    @property
    def stamp_ns(self) -> IntArray:
        return START_NS + np.round(self.photo_s * 1e9).astype(np.int64)

    def geo_from_nominal_cam(self, time_s: ArrayLike) -> FloatArray:
        """Return rotations (N, 3, 3) camera → geo of a camera that is mounted exactly as planned."""
        return geo_from_cam(self._angles(time_s))

    def geo_from_body(self, time_s: ArrayLike) -> FloatArray:
        """Return rotations (N, 3, 3) body → geo of the body (forward, right, down)."""
        return self.geo_from_nominal_cam(time_s) @ self.cam_from_body


def make_trajectory(
    plan: FlightPlan, complex_m: tuple[float, float], axes: FloatArray, rng: np.random.Generator
) -> TrueTrajectory:
    """Return the motion of a flight over a scene, with the wobble of an aircraft.

    The complex in the middle has half lengths along the town's `axes`, (3, 3) in rows.
    """
    index = np.arange(-1.0, plan.images + 1)
    if plan.kind == "orbit":
        positions, angles = _orbit(plan, index)
    elif plan.kind == "grid":
        positions, angles = _grid(plan, index, axes)
    else:
        positions, angles = _facade(plan, index, complex_m, axes)
    positions = positions + rng.normal(0, 0.008 * plan.radius_m, positions.shape)
    pitch = float(np.round(angles[:, 1].mean()))
    angles = angles + rng.normal(0, 1.5, angles.shape)
    angles[:, 0] = np.degrees(np.unwrap(np.radians(angles[:, 0])))
    step_m = float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    # In half seconds: photographs coincide with fixes.
    unhurried_s = max(2.0, float(np.ceil(2 * step_m / _SPEED_M_S)) / 2)
    times = index * (plan.interval_s or unhurried_s)
    return TrueTrajectory(
        times[1:-1].astype(np.float64),
        # The mount tilts the camera as the flight needs, so that the body itself flies level.
        geo_from_cam([0.0, pitch, 0.0]).T @ ENU_FROM_NED,
        CubicSpline(times, positions),
        PchipInterpolator(times, angles),
    )


def _rounds(plan: FlightPlan, index: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the number of the round of each index, and the index as a fraction of that round."""
    rounds = len(plan.heights_m)
    per_round = -(-plan.images // rounds)
    number = np.clip(index // per_round, 0, rounds - 1).astype(np.intp)
    count = np.minimum(per_round, plan.images - number * per_round)
    return number, (index - number * per_round) / count


def _orbit(plan: FlightPlan, index: FloatArray) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    azimuth = 2 * np.pi * share + 0.13 * number
    height = np.array(plan.heights_m)[number]
    positions = np.stack([plan.radius_m * np.cos(azimuth), plan.radius_m * np.sin(azimuth), height], axis=1)
    return positions, _looking(np.array([0.0, 0.0, _LOOK_AT_M]) - positions)


def _looking(direction: FloatArray) -> FloatArray:
    """Return yaw, pitch, roll (N, 3) in degrees of cameras that look along `direction` (N, 3) in geo."""
    yaw = np.degrees(np.arctan2(direction[:, 0], direction[:, 1]))
    pitch = np.degrees(np.arctan2(direction[:, 2], np.hypot(direction[:, 0], direction[:, 1])))
    return np.stack([yaw, pitch, np.zeros_like(yaw)], axis=1)


def _grid(plan: FlightPlan, index: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    per_round = -(-plan.images // len(plan.heights_m))
    # A photograph covers more across the line than along it: lines can be further apart than photographs.
    lines = max(1, round((0.75 * per_round) ** 0.5))
    per_line = -(-per_round // lines)
    step = np.clip(np.round(share * per_round), 0, per_round - 1).astype(int)
    line, along = step // per_line, step % per_line
    forward = line % 2 == 0
    place = np.where(forward, along, per_line - 1 - along) / max(per_line - 1, 1)
    x = plan.radius_m * (2 * place - 1)
    y = plan.radius_m * (2 * line / max(lines - 1, 1) - 1)
    # Lead-in and lead-out continue the line for a moment.
    x = x + np.where((index < 0) | (index >= plan.images), np.where(forward, 1, -1) * np.sign(index) * 5.0, 0.0)
    positions = np.stack([x, y, np.array(plan.heights_m)[number]], axis=1) @ axes
    positions[:, 2] = np.array(plan.heights_m)[number]
    heading = np.degrees(np.arctan2(axes[0, 0], axes[0, 1])) + np.where(forward, 0.0, 180.0)
    return positions, np.stack([heading, np.full(len(index), -90.0), np.zeros(len(index))], axis=1)


def _facade(
    plan: FlightPlan, index: FloatArray, complex_m: tuple[float, float], axes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    half_x, half_y = complex_m
    corner = 0.5 * np.pi * plan.radius_m
    sides = np.array([2 * half_x, corner, 2 * half_y, corner] * 2)[:8]
    ends = np.concatenate([[0.0], np.cumsum(sides)])
    way = np.mod(share, 1.0) * ends[-1]
    part = np.clip(np.searchsorted(ends, way, side="right") - 1, 0, 7)
    done = (way - ends[part]) / sides[part]
    # The outward normal turns by 90° along each corner and stays along each side, from south to east to north.
    turn = np.radians(-90 + 90 * (part // 2 + np.where(part % 2 == 1, done, 0.0)))
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    starts = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    corner_xy, next_corner_xy = starts[part // 2], starts[(part // 2 + 1) % 4]
    on_side = np.where(part % 2 == 1, 1.0, done)[:, None]
    place = corner_xy + (next_corner_xy - corner_xy) * on_side + plan.radius_m * outward
    height = np.array(plan.heights_m)[number]
    positions = np.concatenate([place, np.zeros((len(index), 1))], axis=1) @ axes
    positions[:, 2] = height
    inward = np.concatenate([-outward, np.full((len(index), 1), -0.12)], axis=1) @ axes
    return positions, _looking(inward)


@dataclass(frozen=True)
class Receiver:
    """Errors of a GNSS receiver, which states its white noise alone."""

    sigma_h_m: float  # white noise
    sigma_v_m: float  # white noise
    bias_m: float = 0.0  # RMS of a slow bias per axis
    bias_period_s: float = 60.0
    common_error_m: Vector3 = (0.0, 0.0, 0.0)  # systematic error of all fixes, east, north, up
    outlier_share: float = 0.0  # share of photographs around which the fixes are wrong
    outlier_m: float = 15.0  # size of the wrong fixes


RECEIVERS = {
    "rtk": Receiver(0.02, 0.03),
    "ppk": Receiver(0.015, 0.025, bias_m=0.01),
    "consumer": Receiver(1.5, 3.0, bias_m=0.8),
    "outliers": Receiver(0.05, 0.08, outlier_share=0.15),
}


@dataclass(frozen=True)
class Mounting:
    """True arrangement of camera, antenna and clocks."""

    antenna_in_body: FloatArray  # (3,) metres from the camera's centre, forward-right-down
    nominal_from_cam: FloatArray  # (3, 3) boresight: true camera axes → nominal axes of the mounting plan
    clock_offset_s: float  # navigation clock minus camera clock


@dataclass(frozen=True)
class GnssLog:
    """Records of the receiver, and the truth behind them."""

    stamp_ns: IntArray  # (N,) navigation clock
    position_in_geo: FloatArray  # (N, 3) measured antenna
    true_in_geo: FloatArray  # (N, 3) true antenna
    bias_amplitude_m: FloatArray  # (3,) bias(t) = amplitude · sin(2πt/period + phase)
    bias_phase_rad: FloatArray  # (3,) t from the first photograph on the camera's clock
    wrong_photos: IntArray  # (M,) indices


@dataclass(frozen=True)
class ImuLog:
    """Records of the attitude sensor; the body is forward-right-down."""

    stamp_ns: IntArray  # (N,) navigation clock
    geo_from_body: FloatArray  # (N, 3, 3) measured
    rate_in_body: FloatArray  # (N, 3) rad/s
    specific_force_in_body: FloatArray  # (N, 3) m/s²


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
    """Return the attitudes of an IMU, with rates (rad/s) and specific force (m/s²), by the navigation clock.

    `sigma_deg` is the white noise of an attitude around each axis.
    """
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
