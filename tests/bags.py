"""Tiny bags by rosbags' writer: the same flight in every message type and in every convention."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from pipelines.geodesy.enu import Origin, geo_from_enu_at, lla_from_enu
from pipelines.geometry.rotations import ENU_FROM_NED, quat_xyzw_from_matrix
from pipelines.geometry.trajectory import mount
from tests.earth import enu_from_lla

START = 1_700_000_000_000_000_000
ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)
FLU = np.diag([1.0, -1.0, -1.0])
OPTICAL_FROM_FRD = mount([0.0, 0.0, 0.0])
TYPES = get_typestore(Stores.ROS2_JAZZY)

Message = tuple[str, str, int, Any]  # topic, type, time of recording, message


@dataclass
class Flight:
    """Six photographs a second apart, positions at 10 Hz, attitudes at 50 Hz, all on one clock."""

    count: int = 6
    arm: np.ndarray = field(default_factory=lambda: np.array([0.1, -0.2, -0.3]))
    cam_from_body: np.ndarray = field(default_factory=lambda: mount([0.0, -35.0, 0.0]))

    @property
    def image_ns(self) -> np.ndarray:
        return START + 1_000_000_000 * np.arange(self.count)

    @property
    def fix_ns(self) -> np.ndarray:
        return START + 100_000_000 * np.arange(-5, 10 * self.count)

    @property
    def imu_ns(self) -> np.ndarray:
        return START + 20_000_000 * np.arange(-25, 50 * self.count)

    def camera(self, time_ns: np.ndarray) -> np.ndarray:
        """Return camera centres (N, 3) in the frame at ORIGIN, exactly linear: interpolation adds no error."""
        t = (time_ns - START) / 1e9
        return np.stack([5.0 * t, 20.0 - 3.0 * t, 60.0 + 0.5 * t], axis=1)

    def enu_from_body(self, time_ns: np.ndarray) -> np.ndarray:
        """Return attitudes (N, 3, 3) of the body, forward-right-down, in the frame at ORIGIN."""
        t = (time_ns - START) / 1e9
        angles = np.stack([40.0 + 7.0 * t, 3.0 * np.sin(t), 4.0 * np.cos(t)], axis=1)
        return ENU_FROM_NED @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()

    def antenna(self, time_ns: np.ndarray) -> np.ndarray:
        return self.camera(time_ns) + self.enu_from_body(time_ns) @ self.arm


def make(kind: str, *values: Any) -> Any:
    return TYPES.types[kind](*values)


def header(stamp_ns: int, frame: str) -> Any:
    return make("std_msgs/msg/Header", time(stamp_ns), frame)


def time(stamp_ns: int) -> Any:
    return make("builtin_interfaces/msg/Time", int(stamp_ns) // 10**9, int(stamp_ns) % 10**9)


def quaternion(rotation: np.ndarray) -> Any:
    return make("geometry_msgs/msg/Quaternion", *(float(v) for v in quat_xyzw_from_matrix(rotation)))


def point(values: np.ndarray) -> Any:
    return make("geometry_msgs/msg/Point", *(float(v) for v in values))


def vector(values: np.ndarray) -> Any:
    return make("geometry_msgs/msg/Vector3", *(float(v) for v in values))


def picture(seed: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def jpeg(seed: int) -> np.ndarray:
    return cv2.imencode(".jpg", picture(seed))[1].ravel()


def images(flight: Flight, topic: str = "/camera/image_raw/compressed") -> list[Message]:
    kind = "sensor_msgs/msg/CompressedImage"
    return [
        (topic, kind, ns, make(kind, header(ns, "camera_optical"), "jpeg", jpeg(i)))
        for i, ns in enumerate(flight.image_ns)
    ]


def info(
    flight: Flight, model: str = "plumb_bob", lens: Iterable[float] = (-0.05, 0.01, 1e-4, 2e-4, 0.0)
) -> Message:
    kind = "sensor_msgs/msg/CameraInfo"
    matrix = np.array([50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1.0])
    projection = np.array([48.0, 0, 30.0, 0, 0, 48.0, 22.0, 0, 0, 0, 1.0, 0])
    roi = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    message = make(
        kind, header(START, "camera_optical"), 48, 64, model, np.array(list(lens), np.float64), matrix,
        np.eye(3).ravel(), projection, 0, 0, roi,
    )  # fmt: skip
    return "/camera/camera_info", kind, START, message


def transforms(flight: Flight, base: str = "base_link", topic: str = "/tf_static") -> Message:
    from_frd = np.eye(3) if base.endswith("_frd") else FLU
    links = [
        ("camera_optical", np.zeros(3), from_frd @ flight.cam_from_body.T),
        ("gnss", from_frd @ flight.arm, np.eye(3)),
    ]
    kind = "tf2_msgs/msg/TFMessage"
    stamped = [
        make(
            "geometry_msgs/msg/TransformStamped", header(START, base), child,
            make("geometry_msgs/msg/Transform", vector(shift), quaternion(turn)),
        )
        for child, shift, turn in links
    ]  # fmt: skip
    return topic, kind, START - 500_000_000, make(kind, stamped)


def fix(ns: int, lla: Iterable[float], status: int = 2, covariance_type: int = 2, sigma: float = 0.02) -> Any:
    covariance = np.diag([sigma**2, sigma**2, (2 * sigma) ** 2]).ravel()
    state = make("sensor_msgs/msg/NavSatStatus", status, 1)
    lat, lon, alt = (float(v) for v in lla)
    return make("sensor_msgs/msg/NavSatFix", header(ns, "gnss"), state, lat, lon, alt, covariance, covariance_type)


def fixes(flight: Flight, topic: str = "/gnss/fix") -> list[Message]:
    places = lla_from_enu(flight.antenna(flight.fix_ns), ORIGIN)
    return [
        (topic, "sensor_msgs/msg/NavSatFix", ns, fix(ns, lla))
        for ns, lla in zip(flight.fix_ns, places, strict=True)
    ]


def at_place(flight: Flight, ns: np.ndarray) -> np.ndarray:
    """Return attitudes against north and up at their own places, as instruments measure them."""
    place = lla_from_enu(flight.camera(ns), ORIGIN)
    return np.swapaxes(geo_from_enu_at(place, ORIGIN), -1, -2) @ flight.enu_from_body(ns)


def imu(flight: Flight, frame: str = "base_link", topic: str = "/imu/data") -> list[Message]:
    ned = frame.endswith("_ned")
    kind = "sensor_msgs/msg/Imu"
    covariance = np.eye(3).ravel() * np.radians(0.4) ** 2
    messages = []
    for ns, enu_from_frd in zip(flight.imu_ns, at_place(flight, flight.imu_ns), strict=True):
        turn = ENU_FROM_NED.T @ enu_from_frd if ned else enu_from_frd @ FLU
        message = make(
            kind, header(ns, frame), quaternion(turn), covariance, vector(np.zeros(3)), np.zeros(9),
            vector(np.zeros(3)), np.zeros(9),
        )  # fmt: skip
        messages.append((topic, kind, int(ns), message))
    return messages


def poses(flight: Flight, kind: str, world: str = "map", body: str = "base_link") -> list[Message]:
    """Return camera positions and body attitudes in a local frame, as Odometry or either kind of pose."""
    times = flight.fix_ns
    messages = []
    for ns, place, enu_from_frd in zip(times, flight.camera(times), flight.enu_from_body(times), strict=True):
        from_enu = ENU_FROM_NED.T if world.endswith("_ned") else np.eye(3)
        frd_from_body = {"base_link": FLU, "base_link_frd": np.eye(3), "camera_optical": flight.cam_from_body.T}[
            body
        ]
        pose = make(
            "geometry_msgs/msg/Pose", point(from_enu @ place), quaternion(from_enu @ enu_from_frd @ frd_from_body)
        )
        covariance = np.diag([0.01, 0.01, 0.04, 1e-4, 1e-4, 1e-4]).ravel()
        if kind == "nav_msgs/msg/Odometry":
            twist = make("geometry_msgs/msg/Twist", vector(np.zeros(3)), vector(np.zeros(3)))
            message = make(
                kind, header(ns, world), body, make("geometry_msgs/msg/PoseWithCovariance", pose, covariance),
                make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
            )  # fmt: skip
        elif kind == "geometry_msgs/msg/PoseStamped":
            message = make(kind, header(ns, world), pose)
        else:
            message = make(kind, header(ns, world), make("geometry_msgs/msg/PoseWithCovariance", pose, covariance))
        messages.append(("/localization", kind, int(ns), message))
    return messages


def usual(flight: Flight) -> list[Message]:
    """Return NavSatFix, Imu, CameraInfo and /tf_static beside the photographs."""
    return [transforms(flight), info(flight), *fixes(flight), *imu(flight), *images(flight)]


@dataclass(frozen=True)
class Form:
    """Storage of a bag."""

    storage: StoragePlugin = StoragePlugin.MCAP
    compression: CompressionMode | None = None
    definitions: dict[str, str] = field(default_factory=dict)  # instead of the usual ones; "" for none


def write(path: Path, messages: list[Message], form: Form = Form()) -> Path:
    """Write messages by time of recording."""
    writer = Writer(path, version=9, storage_plugin=form.storage)
    if form.compression is not None:
        writer.set_compression(form.compression, CompressionFormat.ZSTD)
    with writer:
        links: dict[str, Any] = {}
        for topic, kind, ns, message in sorted(messages, key=lambda message: message[2]):
            if topic not in links:
                stated = {"msgdef": form.definitions[kind], "rihs01": "-"} if kind in form.definitions else {}
                links[topic] = writer.add_connection(topic, kind, typestore=TYPES, **stated)
            data = message if isinstance(message, bytes) else bytes(TYPES.serialize_cdr(message, kind))
            writer.write(links[topic], int(ns), data)
    return path


def expected(flight: Flight, origin: Origin) -> tuple[np.ndarray, np.ndarray]:
    """Return camera centres (N, 3) and rotations geo ← camera (N, 3, 3) in the frame at another origin."""
    lla = lla_from_enu(flight.camera(flight.image_ns), ORIGIN)
    turn = geo_from_enu_at(lla_from_enu(np.zeros(3), ORIGIN), origin)
    return enu_from_lla(lla, origin), turn @ flight.enu_from_body(flight.image_ns) @ flight.cam_from_body.T


def raw_images(flight: Flight, encoding: str, coded_of: Callable[[np.ndarray], np.ndarray]) -> list[Message]:
    """Return photographs as `sensor_msgs/Image` with seven bytes of padding a row."""
    kind = "sensor_msgs/msg/Image"
    messages: list[Message] = []
    for i, ns in enumerate(flight.image_ns):
        rows = np.ascontiguousarray(coded_of(picture(i))).view(np.uint8).reshape(48, -1)
        padded = np.pad(rows, ((0, 0), (0, 7)))
        step = padded.shape[1]
        message = make(
            kind, header(ns, "camera_optical"), 48, 64, encoding, 0, step, padded.ravel()
        )  # fmt: skip
        messages.append(("/camera/image_raw", kind, int(ns), message))
    return messages


def coded(bgr: np.ndarray, encoding: str) -> np.ndarray:
    """Return a picture (48, 64) of one colour as a mosaic or as YUV 4:2:2 (BT.601, studio range)."""
    blue, green, red = (float(value) for value in bgr)
    if encoding.startswith("bayer"):
        values = {"r": red, "g": green, "b": blue}
        a, b, c, d = (values[letter] for letter in encoding[6:10])
        return np.tile(np.array([[a, b], [c, d]], np.uint8), (24, 32))
    y = 16 + 0.257 * red + 0.504 * green + 0.098 * blue
    u = 128 - 0.148 * red - 0.291 * green + 0.439 * blue
    v = 128 + 0.439 * red - 0.368 * green - 0.071 * blue
    pair = [u, y, v, y] if encoding == "yuv422" else [y, u, y, v]
    return np.tile(np.round(pair).astype(np.uint8), (48, 32))


def join(path: Path, parts: list[Path]) -> None:
    """Make one bag of several files, as a recorder splits it."""
    path.mkdir()
    yaml = YAML(typ="safe")
    documents = [yaml.load((part / "metadata.yaml").read_text()) for part in parts]
    merged = documents[0]["rosbag2_bagfile_information"]
    files = [document["rosbag2_bagfile_information"]["relative_file_paths"][0] for document in documents]
    merged["relative_file_paths"] = []
    counts: dict[str, dict] = {}
    for number, (part, document) in enumerate(zip(parts, documents, strict=True)):
        information = document["rosbag2_bagfile_information"]
        name = f"bag_{number}.mcap"
        (part / files[number]).rename(path / name)
        merged["relative_file_paths"].append(name)
        for topic in information["topics_with_message_count"]:
            key = topic["topic_metadata"]["name"]
            if key in counts:
                counts[key]["message_count"] += topic["message_count"]
            else:
                counts[key] = topic
    merged["topics_with_message_count"] = list(counts.values())
    merged["message_count"] = sum(topic["message_count"] for topic in counts.values())
    with (path / "metadata.yaml").open("w") as handle:
        yaml.dump(documents[0], handle)


def as_ros1(message: Any, store: Any) -> Any:
    """Return the same message with ROS 1's headers, which have a sequence number."""
    kind = getattr(message, "__msgtype__", None)
    if isinstance(message, list):
        return [as_ros1(element, store) for element in message]
    if kind is None:
        return message
    values = {
        name: 0
        if name == "seq"
        else as_ros1(getattr(message, name if hasattr(message, name) else name.lower()), store)
        for name, _ in store.fielddefs[kind][1]
    }
    return store.types[kind](**values)


def with_unknown(flight: Flight) -> list[Message]:
    """Return a usual bag with an additional topic of an unknown type."""
    TYPES.register(get_types_from_msg("uint32 number", "nobody_msgs/msg/Thing"))
    thing = make("nobody_msgs/msg/Thing", 7)
    return [*usual(flight), ("/thing", "nobody_msgs/msg/Thing", START, thing)]
