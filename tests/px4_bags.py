"""PX4's messages of the flight in `bags`, in the layout of any release."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.formats.px4_messages import DEFINITIONS
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.rotations import ENU_FROM_NED, quat_xyzw_from_matrix
from tests.bags import ORIGIN, TYPES, Flight, Message, at_place, make

_RELEASE_OF = {"SensorGps": "1.15"}  # of the messages that `px4` makes; else 1.14
for _name, _layouts in DEFINITIONS.items():
    _release = _RELEASE_OF.get(_name.rpartition("/")[2], "1.14")
    TYPES.register(get_types_from_msg(_layouts[_release], _name))


def px4(flight: Flight, kind: str, boot_ns: int = 0) -> list[Message]:
    """Return PX4's messages, whose microseconds count from `boot_ns`."""
    kind = f"px4_msgs/msg/{kind}"
    times = flight.imu_ns if kind.endswith("Attitude") else flight.fix_ns
    turns = ENU_FROM_NED.T @ (flight.enu_from_body(times) if kind.endswith("Odometry") else at_place(flight, times))
    quats = quat_xyzw_from_matrix(turns)[:, [3, 0, 1, 2]].astype(np.float32, order="C")
    zero = np.zeros(3, np.float32)
    messages = []
    for i, ns in enumerate(times):
        stamp = int(ns - boot_ns) // 1000
        camera, antenna = flight.camera(times[i : i + 1])[0], flight.antenna(times[i : i + 1])[0]
        (lat, lon, alt), gps = lla_from_enu(camera, ORIGIN), lla_from_enu(antenna, ORIGIN)
        if kind.endswith("VehicleAttitude"):
            message = make(kind, stamp, stamp, quats[i], np.zeros(4, np.float32), 0)
        elif kind.endswith("VehicleGlobalPosition"):
            message = make(kind, stamp, stamp, lat, lon, alt - 50, alt, 0.0, 0, 0, 0.3, 0.5, 0.0, False, False)
        elif kind.endswith("VehicleOdometry"):
            ned = (ENU_FROM_NED.T @ camera).astype(np.float32)
            variance = np.full(3, 0.01, np.float32)
            message = make(
                kind, stamp, stamp, 1, ned, quats[i], 1, zero, zero, variance, variance, variance, 0, 100
            )
        else:
            message = make(
                kind, stamp, stamp, 1, *(float(v) for v in gps[:2]), float(gps[2]) - 50, float(gps[2]), 0.0, 0.0, 6,
                0.02, 0.03, 0.7, 1.0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, True, 0, 0, 20, 0.0, 0.0, 0.0, 1.0, 0,
                False, 0,
            )  # fmt: skip
        messages.append((f"/fmu/out/{kind.rpartition('/')[2]}", kind, int(ns), message))
    return messages


def px4_of(release: str, messages: list[Message]) -> list[Message]:
    """Return PX4's messages in the layout of another release; additional fields are zero."""
    kind = messages[0][1]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DEFINITIONS[kind][release], kind))
    converted: list[Message] = []
    for topic, _, ns, message in messages:
        values = []
        for name, (node, detail) in store.fielddefs[kind][1]:
            value = _px4_value(message, name)
            zero = np.zeros(detail[1], np.float32) if node == Nodetype.ARRAY else 0
            values.append(zero if value is None else value)
        converted.append((topic, kind, ns, bytes(store.serialize_cdr(store.types[kind](*values), kind))))
    return converted


def _px4_value(message: Any, name: str) -> Any:
    """Return the value of a field of another layout, None if the message has no such value."""
    if name in ("lat_lon_valid", "alt_valid"):
        return True
    if hasattr(message, name):
        return getattr(message, name)
    if hasattr(message, "latitude_deg"):
        whole = {"lat": message.latitude_deg * 1e7, "lon": message.longitude_deg * 1e7}
        whole |= {"alt": message.altitude_msl_m * 1e3, "alt_ellipsoid": message.altitude_ellipsoid_m * 1e3}
        return round(whole[name]) if name in whole else None
    if hasattr(message, "position"):
        if name == "pose_covariance":
            covariance = np.zeros(21, np.float32)
            covariance[[0, 6, 11]] = message.position_variance
            return covariance
        return float(message.position["xyz".index(name)]) if name in ("x", "y", "z") else None
    return None
