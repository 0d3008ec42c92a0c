"""Writing of a flight as a rosbag2, in the form of a ROS 2 drone (REP-103, REP-105, REP-145).

The world is East-North-Up, `base_link` Forward-Left-Up, the camera `_optical` (x right, y down, z forward).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.bag import RosTypes
from pipelines.geometry.rotations import quat_xyzw_from_matrix

IMAGE_TOPIC = "/uav/camera/image/compressed"
INFO_TOPIC = "/uav/camera/camera_info"
FIX_TOPIC = "/uav/gnss/fix"
IMU_TOPIC = "/uav/imu/data"
TF_TOPIC = "/tf_static"
BODY, CAMERA, ANTENNA, IMU = "base_link", "camera_optical", "gnss_antenna", "imu_link"
_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
_TYPES = {
    IMAGE_TOPIC: "sensor_msgs/msg/CompressedImage",
    INFO_TOPIC: "sensor_msgs/msg/CameraInfo",
    FIX_TOPIC: "sensor_msgs/msg/NavSatFix",
    IMU_TOPIC: "sensor_msgs/msg/Imu",
    TF_TOPIC: "tf2_msgs/msg/TFMessage",
}


@dataclass(frozen=True)
class BagCamera:
    """Camera in the terms of `CameraInfo`."""

    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float]  # principal point, the centre of the top-left pixel being (0.5, 0.5)
    distortion: tuple[float, float, float, float, float]  # (k1, k2, p1, p2, k3), model plumb_bob
    cam_from_body: FloatArray  # (3, 3) nominal mounting, body forward-right-down


@dataclass(frozen=True)
class BagFlight:
    """Records of a flight. Stamps are nanoseconds since 1970, each sensor's on its own clock."""

    camera: BagCamera
    image_stamp_ns: IntArray  # (N,) of the N JPEG files
    image_paths: tuple[Path, ...]
    fix_stamp_ns: IntArray  # (M,)
    fix_lla: FloatArray  # (M, 3) degrees and ellipsoidal metres
    fix_sigma_enu_m: FloatArray  # (3,) σ that the receiver states
    fix_status: int  # `NavSatStatus.status` of all fixes
    antenna_in_body: FloatArray  # (3,) metres, forward-right-down
    imu_stamp_ns: IntArray  # (K,)
    imu_enu_from_body: FloatArray  # (K, 3, 3), body forward-right-down
    # imu_rate and imu_force: (K, 3) angular rate in rad/s, specific force in m/s²; forward-right-down
    imu_rate: FloatArray
    imu_force: FloatArray
    imu_sigma_deg: float  # σ of the attitude per axis


def write_bag(path: Path, storage: Literal["mcap", "sqlite3"], flight: BagFlight) -> int:
    """Write a bag folder in order of time; return the number of messages."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_JAZZY)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    count = 0
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        links = {
            topic: writer.add_connection(topic, kind, typestore=typestore, offered_qos_profiles=_qos(topic))
            for topic, kind in _TYPES.items()
        }
        for topic, stamp_ns, message in _messages(flight, typestore.types):
            writer.write(links[topic], stamp_ns, typestore.serialize_cdr(message, _TYPES[topic]))
            count += 1
    return count


def _qos(topic: str) -> list[Any]:
    """Return the quality of service: static transforms must reach late listeners; other topics take the default."""
    if topic != TF_TOPIC:
        return []
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    endless = QosTime(9223372036, 854775807)
    return [
        Qos(
            QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, endless, endless,
            QosLiveliness.AUTOMATIC, endless, False,
        )
    ]  # fmt: skip


def _messages(flight: BagFlight, types: RosTypes) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, stamp, message) by time; a photograph is read only when its message is due."""
    streams = [(FIX_TOPIC, flight.fix_stamp_ns), (IMU_TOPIC, flight.imu_stamp_ns)]
    streams += [(INFO_TOPIC, flight.image_stamp_ns), (IMAGE_TOPIC, flight.image_stamp_ns)]
    make = (_fix, _imu, _info, _image)
    first = min(int(stamps[0]) for _, stamps in streams)
    yield TF_TOPIC, first, _transforms(flight, types, first)
    rank = np.concatenate([np.full(len(stamps), k) for k, (_, stamps) in enumerate(streams)])
    index = np.concatenate([np.arange(len(stamps)) for _, stamps in streams])
    stamp = np.concatenate([stamps for _, stamps in streams])
    for k in np.lexsort((rank, stamp)):
        topic, stamp_ns = streams[rank[k]][0], int(stamp[k])
        yield topic, stamp_ns, make[rank[k]](flight, types, int(index[k]), stamp_ns)


def _header(types: RosTypes, stamp_ns: int, frame: str) -> Any:
    time = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](time, frame)


def _fix(flight: BagFlight, types: RosTypes, i: int, stamp_ns: int) -> Any:
    status = types["sensor_msgs/msg/NavSatStatus"](flight.fix_status, 1)
    cov = np.diag(np.square(flight.fix_sigma_enu_m)).ravel()
    return types["sensor_msgs/msg/NavSatFix"](
        _header(types, stamp_ns, ANTENNA), status, *flight.fix_lla[i].tolist(), cov, 2
    )


def _imu(flight: BagFlight, types: RosTypes, i: int, stamp_ns: int) -> Any:
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    attitude = quat_xyzw_from_matrix(flight.imu_enu_from_body[i] @ _FLU_FROM_FRD)
    rate, force = _FLU_FROM_FRD @ flight.imu_rate[i], _FLU_FROM_FRD @ flight.imu_force[i]
    cov = np.eye(3).ravel() * np.radians(flight.imu_sigma_deg) ** 2
    unknown = np.zeros(9)
    return types["sensor_msgs/msg/Imu"](
        _header(types, stamp_ns, IMU), quaternion(*attitude.tolist()), cov, vector(*rate.tolist()), unknown,
        vector(*force.tolist()), unknown,
    )  # fmt: skip


def _info(flight: BagFlight, types: RosTypes, _i: int, stamp_ns: int) -> Any:
    camera = flight.camera
    # ROS counts pixels from the centre of the first one, COLMAP from its corner.
    focal, cx, cy = camera.focal_px, camera.center_px[0] - 0.5, camera.center_px[1] - 0.5
    return types["sensor_msgs/msg/CameraInfo"](
        _header(types, stamp_ns, CAMERA), camera.height, camera.width, "plumb_bob", np.array(camera.distortion),
        np.array([focal, 0, cx, 0, focal, cy, 0, 0, 1.0]), np.eye(3).ravel(),
        np.array([focal, 0, cx, 0, 0, focal, cy, 0, 0, 0, 1.0, 0]), 0, 0,
        types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )  # fmt: skip


def _image(flight: BagFlight, types: RosTypes, i: int, stamp_ns: int) -> Any:
    data = np.frombuffer(flight.image_paths[i].read_bytes(), dtype=np.uint8)
    return types["sensor_msgs/msg/CompressedImage"](_header(types, stamp_ns, CAMERA), "jpeg", data)


def _transforms(flight: BagFlight, types: RosTypes, stamp_ns: int) -> Any:
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    transform, stamped = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/TransformStamped"]
    transforms = []
    for child, shift, rotation in (
        (CAMERA, np.zeros(3), _FLU_FROM_FRD @ flight.camera.cam_from_body.T),
        (ANTENNA, _FLU_FROM_FRD @ flight.antenna_in_body, np.eye(3)),
        (IMU, np.zeros(3), np.eye(3)),
    ):
        turn = quaternion(*quat_xyzw_from_matrix(rotation).tolist())
        header = _header(types, stamp_ns, BODY)
        transforms.append(stamped(header, child, transform(vector(*shift.tolist()), turn)))
    return types["tf2_msgs/msg/TFMessage"](transforms)
