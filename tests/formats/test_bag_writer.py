"""A written bag says the same to rosbags' reader, in ROS's conventions."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from pipelines.formats import bag_writer
from pipelines.formats.bag_writer import BagCamera, BagFlight, write_bag
from pipelines.geometry.rotations import ENU_FROM_NED, geo_from_cam

START = 1_700_000_000_000_000_000
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


def flight(folder: Path) -> BagFlight:
    rng = np.random.default_rng(0)
    paths = tuple(folder / f"{i}.jpg" for i in range(2))
    for path in paths:
        path.write_bytes(rng.bytes(500))
    cam_from_body = geo_from_cam([0.0, -35.0, 0.0]).T @ ENU_FROM_NED
    camera = BagCamera(640, 480, 544.0, (322.5, 238.5), (-0.045, 0.012, 4e-4, -3e-4, 0.0), cam_from_body)
    imu_stamps = START + 10_000_000 * np.arange(-20, 220)
    return BagFlight(
        camera=camera,
        image_stamp_ns=START + np.array([0, 2_000_000_001]),
        image_paths=paths,
        fix_stamp_ns=START + 100_000_000 * np.arange(-2, 22),
        fix_lla=np.array([46.0, 7.7, 1600.0]) + rng.normal(0, 1e-4, (24, 3)),
        fix_sigma_enu_m=np.array([0.02, 0.02, 0.03]),
        fix_status=2,
        antenna_in_body=np.array([0.1, 0.2, -0.3]),
        imu_stamp_ns=imu_stamps,
        imu_enu_from_body=ENU_FROM_NED @ Rotation.random(len(imu_stamps), rng=1).as_matrix(),
        imu_rate=rng.normal(0, 1, (len(imu_stamps), 3)),
        imu_force=rng.normal(0, 1, (len(imu_stamps), 3)),
        imu_sigma_deg=0.5,
    )


def read(path: Path) -> tuple[dict[str, list[Any]], list[int]]:
    messages: dict[str, list[Any]] = {}
    times = []
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            messages.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
            times.append(time)
    return messages, times


def stamps(messages: list[Any]) -> list[int]:
    return [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for m in messages]


def rotation(quaternion: Any) -> np.ndarray:
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w]).as_matrix()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bag_says_what_was_written(tmp_path: Path, storage: Literal["mcap", "sqlite3"]) -> None:
    given = flight(tmp_path)
    count = write_bag(tmp_path / "bag", storage, given)
    messages, times = read(tmp_path / "bag")
    assert count == len(times) == 1 + 24 + 240 + 2 + 2
    assert times == sorted(times)
    fixes, imu, images = (
        messages[topic] for topic in (bag_writer.FIX_TOPIC, bag_writer.IMU_TOPIC, bag_writer.IMAGE_TOPIC)
    )
    assert stamps(fixes) == given.fix_stamp_ns.tolist()
    np.testing.assert_array_equal([[m.latitude, m.longitude, m.altitude] for m in fixes], given.fix_lla)
    np.testing.assert_allclose(fixes[0].position_covariance.reshape(3, 3), np.diag([4e-4, 4e-4, 9e-4]))
    assert (fixes[0].status.status, fixes[0].position_covariance_type) == (2, 2)
    assert stamps(imu) == given.imu_stamp_ns.tolist()
    # The world stays East-North-Up; the body turns from forward-right-down to forward-left-up.
    np.testing.assert_allclose(
        [rotation(m.orientation) for m in imu], given.imu_enu_from_body @ FLU_FROM_FRD, atol=1e-12
    )
    np.testing.assert_array_equal(
        [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imu],
        given.imu_rate * [1, -1, -1],
    )
    assert stamps(images) == given.image_stamp_ns.tolist()
    assert [bytes(m.data) for m in images] == [path.read_bytes() for path in given.image_paths]
    assert {m.format for m in images} == {"jpeg"}


def test_calibration_counts_pixels_as_ros_does(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", "mcap", flight(tmp_path))
    info = read(tmp_path / "bag")[0][bag_writer.INFO_TOPIC][0]
    np.testing.assert_allclose(info.k.reshape(3, 3), [[544, 0, 322], [0, 544, 238], [0, 0, 1]])
    np.testing.assert_allclose(info.d, [-0.045, 0.012, 4e-4, -3e-4, 0])
    assert (info.width, info.height, info.distortion_model) == (640, 480, "plumb_bob")


def test_transforms_tell_mount_and_lever_arm(tmp_path: Path) -> None:
    given = flight(tmp_path)
    write_bag(tmp_path / "bag", "mcap", given)
    (message,) = read(tmp_path / "bag")[0][bag_writer.TF_TOPIC]
    links = {t.child_frame_id: t.transform for t in message.transforms}
    assert {t.header.frame_id for t in message.transforms} == {"base_link"}
    arm = links["gnss_antenna"].translation
    assert (arm.x, arm.y, arm.z) == (0.1, -0.2, 0.3)
    base_from_camera = rotation(links["camera_optical"].rotation)
    # A camera 35° below the nose: its z axis points forward and down, its x axis to the right (−y in FLU).
    np.testing.assert_allclose(
        base_from_camera[:, 2], [np.cos(np.radians(35)), 0, -np.sin(np.radians(35))], atol=1e-9
    )
    np.testing.assert_allclose(base_from_camera[:, 0], [0, -1, 0], atol=1e-9)
