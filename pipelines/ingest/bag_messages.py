"""Positions and attitudes out of ROS messages, and the tree of frames of `/tf` and `/tf_static`.

World and body axes by REP-103, REP-105, REP-145 and REP-147, and PX4's own. A frame whose name ends in `_ned` is
North-East-Down, one that ends in `_frd` Forward-Right-Down, as MAVROS names them. What a message does not know is
NaN; why a message cannot be used is its `problem`.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray, Quaternion, Vector3, vector3
from pipelines.formats.bag import RosMessage
from pipelines.geodesy.vertical import impossible_heights
from pipelines.geometry.rotations import ENU_FROM_NED, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.trajectory import Trajectory

Axes = Literal["flu", "frd", "optical"]
BASE = "base_link"
_NAN3 = (math.nan, math.nan, math.nan)
_LARGEST_SIGMA_M = 1e4
_PX4_FIXES = range(3, 7)  # 3D, differential, RTK float, RTK fixed; 8 is extrapolated
_PX4_RECEIVER = {5: "RTK float", 6: "RTK fixed"}
_STATUS_NO_FIX = -1
IMPOSSIBLE_HEIGHT = "altitude is impossible"
# Kinds of fix from the worst to the best, by their place
FIX_KINDS = (
    "without corrections",
    "with corrections (SBAS, differential)",
    "RTK float",
    "RTK or ground-based (GBAS)",
)
_KIND_OF_STATUS, _KIND_OF_PX4 = {1: 1, 2: 3}, {4: 1, 5: 2, 6: 3}
_COVARIANCE_UNKNOWN = 0
_POSE_FRAME_NED = 1


@dataclass(frozen=True)
class PositionSample:
    """A position as a message states it."""

    coordinates: Vector3  # (latitude, longitude, height), or metres east, north, up from the local frame's origin
    sigma_enu_m: Vector3  # NaN where unknown
    frame: str  # name of the frame that is at that place
    world: str = ""  # the local frame; "" for geodetic positions
    receiver: str = "unknown receiver"  # kind of receiver, for σ where the message has none
    problem: str = ""  # why it cannot be used, or ""
    fix_kind: int = 0  # of a receiver, as a place in `FIX_KINDS`


@dataclass(frozen=True)
class AttitudeSample:
    """An attitude as a message states it: a frame's own axes into East-North-Up, σ in degrees or NaN."""

    quat_xyzw: Quaternion
    sigma_deg: float
    frame: str
    axes: Axes
    problem: str = ""


def body_axes(frame: str) -> Axes:
    """Return a frame's axes by its name: FRD for `…_frd`, `…_ned`, the camera's for `…optical…`, else FLU."""
    name = frame.lower()
    if name.endswith(("_frd", "_ned")):
        return "frd"
    return "optical" if "optical" in name else "flu"


def stamp_ns(message: RosMessage) -> int | None:
    """Return a message's own stamp in nanoseconds: its header's, or PX4's microseconds; None where it is zero."""
    header = getattr(message, "header", None)
    if header is not None:
        return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec or None
    sample = getattr(message, "timestamp_sample", 0) or getattr(message, "timestamp", 0)
    return int(sample) * 1000 or None


def _fix(message: RosMessage) -> PositionSample:
    coordinates = (float(message.latitude), float(message.longitude), float(message.altitude))
    covariance = np.asarray(message.position_covariance, dtype=np.float64).reshape(3, 3)
    known = message.position_covariance_type != _COVARIANCE_UNKNOWN
    sigma = _sigmas(np.diag(covariance)) if known else _NAN3
    problem = "no fix (status)" if message.status.status <= _STATUS_NO_FIX else _geodetic_problem(coordinates)
    return PositionSample(
        coordinates,
        sigma,
        message.header.frame_id,
        receiver="single-frequency",
        problem=problem,
        fix_kind=_KIND_OF_STATUS.get(int(message.status.status), 0),
    )


def _global_position(message: RosMessage) -> PositionSample:
    coordinates = (float(message.lat), float(message.lon), float(message.alt_ellipsoid))
    flags = ("lat_lon_valid", "alt_valid", "alt_ellipsoid_valid")  # since px4_msgs 1.16
    valid = all(getattr(message, flag, True) for flag in flags)
    problem = _geodetic_problem(coordinates) if valid else "no fix (status)"
    if message.dead_reckoning:
        problem = "dead reckoning, without a receiver"
    return PositionSample(coordinates, _eph_epv(message), BASE, problem=problem)


def _sensor_gps(message: RosMessage) -> PositionSample:
    if hasattr(message, "latitude_deg"):
        coordinates = (message.latitude_deg, message.longitude_deg, message.altitude_ellipsoid_m)
    else:  # px4_msgs up to release 1.14: 1e-7 degrees and millimetres
        coordinates = (message.lat * 1e-7, message.lon * 1e-7, message.alt_ellipsoid * 1e-3)
    coordinates = (float(coordinates[0]), float(coordinates[1]), float(coordinates[2]))
    problem = "no fix (status)" if message.fix_type not in _PX4_FIXES else _geodetic_problem(coordinates)
    receiver = _PX4_RECEIVER.get(int(message.fix_type), "single-frequency")
    kind = _KIND_OF_PX4.get(int(message.fix_type), 0)
    return PositionSample(coordinates, _eph_epv(message), "gps", receiver=receiver, problem=problem, fix_kind=kind)


def _geodetic_problem(coordinates: Sequence[float]) -> str:
    lat, lon, alt = coordinates
    if not (math.isfinite(lat) and math.isfinite(lon)):
        return "latitude or longitude is NaN"
    if abs(lat) > 90 or abs(lon) > 360 or (lat == 0 and lon == 0):
        return "latitude or longitude is impossible"
    if not math.isfinite(alt):
        return "altitude is NaN"
    return IMPOSSIBLE_HEIGHT if impossible_heights(alt) else ""


def _local(
    position: RosMessage, message: RosMessage, frame: str = "", covariance: ArrayLike | None = None
) -> PositionSample:
    values = np.array([position.x, position.y, position.z], dtype=np.float64)
    variance = np.zeros(3) if covariance is None else np.asarray(covariance, dtype=np.float64)[[0, 7, 14]]
    if str(message.header.frame_id).lower().endswith("_ned"):
        values, variance = ENU_FROM_NED @ values, np.abs(ENU_FROM_NED) @ variance
    problem = "" if np.isfinite(values).all() else "position is NaN"
    world = message.header.frame_id or "odom"
    return PositionSample(vector3(values), _sigmas(variance), frame or BASE, world=world, problem=problem)


def _px4_local(message: RosMessage) -> PositionSample:
    if hasattr(message, "position"):
        ned = np.asarray(message.position, dtype=np.float64)
        variance = np.asarray(message.position_variance, np.float64)
    else:  # px4_msgs up to release 1.13: the upper triangle of a 6×6 covariance, row by row
        ned = np.array([message.x, message.y, message.z], dtype=np.float64)
        variance = np.asarray(message.pose_covariance, dtype=np.float64)[[0, 6, 11]]
    coordinates = vector3(ENU_FROM_NED @ ned)
    problem = "" if _px4_is_ned(message) else "its frame is not North-East-Down"
    if not all(map(math.isfinite, coordinates)):
        problem = "position is NaN"
    sigma = _sigmas(np.abs(ENU_FROM_NED) @ variance)
    return PositionSample(coordinates, sigma, BASE, world="PX4's local NED", problem=problem)


def _sigmas(variance: ArrayLike) -> Vector3:
    """Return σ of three variances; all NaN where one is not positive, or beyond `_LARGEST_SIGMA_M`."""
    values = np.asarray(variance, dtype=np.float64)
    if not (np.isfinite(values).all() and (values > 0).all() and (values < _LARGEST_SIGMA_M**2).all()):
        return _NAN3
    return vector3(np.sqrt(values))


def _eph_epv(message: RosMessage) -> Vector3:
    h, v = float(message.eph), float(message.epv)
    good = math.isfinite(h) and math.isfinite(v) and 0 < h < _LARGEST_SIGMA_M and 0 < v < _LARGEST_SIGMA_M
    return (h / math.sqrt(2.0), h / math.sqrt(2.0), v) if good else _NAN3


def _px4_is_ned(message: RosMessage) -> bool:
    if hasattr(message, "pose_frame"):
        return bool(message.pose_frame == _POSE_FRAME_NED)
    return bool(message.local_frame == 0)


def _imu(message: RosMessage) -> AttitudeSample:
    frame = message.header.frame_id
    covariance = np.asarray(message.orientation_covariance, dtype=np.float64)
    ned, unknown = body_axes(frame) == "frd", covariance[0] == -1.0
    return _attitude(message.orientation, covariance[[0, 4, 8]], frame or BASE, ned, unknown)


def _pose(
    orientation: RosMessage, message: RosMessage, frame: str = "", covariance: ArrayLike | None = None
) -> AttitudeSample:
    variance = np.zeros(3) if covariance is None else np.asarray(covariance, dtype=np.float64)[[21, 28, 35]]
    ned = str(message.header.frame_id).lower().endswith("_ned")
    return _attitude(orientation, variance, frame or BASE, ned)


def _px4_odometry(message: RosMessage) -> AttitudeSample:
    attitude = _from_ned_frd(message.q, getattr(message, "orientation_variance", np.full(3, np.nan)))
    return attitude if _px4_is_ned(message) else replace(attitude, problem="its frame is not North-East-Down")


def _attitude(
    quaternion: RosMessage, variance: ArrayLike, frame: str, ned: bool, unknown: bool = False
) -> AttitudeSample:
    values = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], dtype=np.float64)
    problem = "has no orientation" if unknown or not values.any() else _quaternion_problem(values)
    if ned and not problem:
        values = quat_xyzw_from_matrix(ENU_FROM_NED @ matrix_from_quat_xyzw(values))
    x, y, z, w = (float(value) for value in values)
    return AttitudeSample((x, y, z, w), _sigma_deg(variance), frame, body_axes(frame), problem)


def _from_ned_frd(quat_wxyz: Iterable[float], variance: ArrayLike) -> AttitudeSample:
    w, x, y, z = (float(value) for value in quat_wxyz)
    values = np.array([x, y, z, w])
    problem = _quaternion_problem(values)
    if problem:
        return AttitudeSample((0.0, 0.0, 0.0, 1.0), math.nan, BASE, "flu", problem)
    # As base_link, whose axes are forward, left, up.
    enu_from_flu = ENU_FROM_NED @ matrix_from_quat_xyzw(values) @ np.diag([1.0, -1.0, -1.0])
    x, y, z, w = (float(value) for value in quat_xyzw_from_matrix(enu_from_flu))
    return AttitudeSample((x, y, z, w), _sigma_deg(variance), BASE, "flu")


def _quaternion_problem(values: np.ndarray) -> str:
    if not np.isfinite(values).all():
        return "orientation is NaN"
    return "" if abs(float(np.linalg.norm(values)) - 1.0) < 0.05 else "orientation is no unit quaternion"


def _sigma_deg(variance: ArrayLike) -> float:
    values = np.asarray(variance, dtype=np.float64)
    if not (np.isfinite(values).all() and (values > 0).all()):
        return math.nan
    return float(np.degrees(np.sqrt(values.mean()))) if values.mean() < np.pi**2 else math.nan


# Readers of positions and attitudes by message type, the preferred types first.
POSITIONS: dict[str, Callable[[Any], PositionSample]] = {
    "sensor_msgs/msg/NavSatFix": _fix,
    "px4_msgs/msg/SensorGps": _sensor_gps,
    "px4_msgs/msg/VehicleGlobalPosition": _global_position,
    "nav_msgs/msg/Odometry": lambda m: _local(m.pose.pose.position, m, m.child_frame_id, m.pose.covariance),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _local(
        m.pose.pose.position, m, covariance=m.pose.covariance
    ),
    "geometry_msgs/msg/PoseStamped": lambda m: _local(m.pose.position, m),
    "px4_msgs/msg/VehicleOdometry": _px4_local,
}
# Zero of the heights in the types with latitude and longitude; heights of the others are of a local frame.
GEODETIC_HEIGHTS = {
    "sensor_msgs/msg/NavSatFix": "ellipsoidal by the definition of NavSatFix",
    "px4_msgs/msg/SensorGps": "PX4's altitude above the ellipsoid",
    "px4_msgs/msg/VehicleGlobalPosition": "PX4's altitude above the ellipsoid",
}
ATTITUDES: dict[str, Callable[[Any], AttitudeSample]] = {
    "sensor_msgs/msg/Imu": _imu,
    "px4_msgs/msg/VehicleAttitude": lambda m: _from_ned_frd(m.q, np.full(3, np.nan)),
    "nav_msgs/msg/Odometry": lambda m: _pose(m.pose.pose.orientation, m, m.child_frame_id, m.pose.covariance),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _pose(
        m.pose.pose.orientation, m, covariance=m.pose.covariance
    ),
    "geometry_msgs/msg/PoseStamped": lambda m: _pose(m.pose.orientation, m),
    "px4_msgs/msg/VehicleOdometry": _px4_odometry,
}


TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_MAX_LINKS = 1000
_MAX_STEPS = 64


@dataclass
class _Link:
    """A frame in its parent: samples of (time, x, y, z, qx, qy, qz, qw)."""

    parent: str
    static: bool
    samples: array[float] = field(default_factory=lambda: array("d"))


class Transforms:
    """The tree of frames. Static links hold at all times; others only between their samples."""

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}
        self.refused = 0

    def __contains__(self, frame: str) -> bool:
        return frame in self._links or any(link.parent == frame for link in self._links.values())

    def add(self, message: RosMessage, *, static: bool) -> None:
        """Add the links of a `TFMessage`; transforms that are not finite are counted in `refused`."""
        for transform in message.transforms:
            stamp, shift, turn = (
                transform.header.stamp, transform.transform.translation, transform.transform.rotation,
            )  # fmt: skip
            values = (
                stamp.sec + stamp.nanosec * 1e-9, shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w,
            )  # fmt: skip
            child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
            norm = float(np.linalg.norm(values[4:]))
            known = child in self._links or len(self._links) < _MAX_LINKS
            if not np.isfinite(values).all() or abs(norm - 1) > 0.05 or child == parent or not known:
                self.refused += 1
                continue
            link = self._links.get(child)
            if link is None or link.parent != parent or static:
                link = self._links[child] = _Link(parent, static)
            link.samples.extend(values)

    def between(self, to: str, of: str, time_s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return rotations (N, 3, 3) and origins (N, 3) of frame `of` in `to` at times (N,); None if not linked.

        Rows are NaN where a moving link on the way has no samples around the time.
        """
        up_to, up_of = self._ancestors(to.lstrip("/")), self._ancestors(of.lstrip("/"))
        common = next((frame for frame in up_of if frame in up_to), None)
        if common is None:
            return None
        common_from_of = self._upwards(up_of[: up_of.index(common)], time_s)
        common_from_to = self._upwards(up_to[: up_to.index(common)], time_s)
        back = np.swapaxes(common_from_to[0], -1, -2)
        shift = np.einsum("nij,nj->ni", back, common_from_of[1] - common_from_to[1])
        return back @ common_from_of[0], shift

    def _ancestors(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on."""
        line = [frame]
        while line[-1] in self._links and len(line) < _MAX_STEPS:
            parent = self._links[line[-1]].parent
            if parent in line:
                break
            line.append(parent)
        return line

    def _upwards(self, frames: list[str], time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        rotation, shift = np.tile(np.eye(3), (len(time_s), 1, 1)), np.zeros((len(time_s), 3))
        for frame in frames:
            step_rotation, step_shift = _at(self._links[frame], time_s)
            rotation, shift = step_rotation @ rotation, np.einsum("nij,nj->ni", step_rotation, shift) + step_shift
        return rotation, shift


def _at(link: _Link, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) and origins (N, 3) of a link's frame in its parent at times (N,)."""
    samples = np.frombuffer(link.samples).reshape(-1, 8)
    if link.static:
        turn = matrix_from_quat_xyzw(samples[-1, 4:])
        return np.tile(turn, (len(time_s), 1, 1)), np.tile(samples[-1, 1:4], (len(time_s), 1))
    clock, first = np.unique(samples[:, 0], return_index=True)
    motion = Trajectory.from_samples(
        clock, position=samples[first, 1:4], rotation=matrix_from_quat_xyzw(samples[first, 4:])
    )
    there = motion.at(time_s)
    return there.rotation, there.position
