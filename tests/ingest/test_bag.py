"""`georef ingest --bag` on tiny bags of one flight, whose truth is known: every type and convention."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.geometry.trajectory import mount
from pipelines.survey.navigation import NavigationTrack
from tests import bags
from tests.bags import Flight, Form, Message
from tests.ingested_bags import Ingest, Refusal, check, remarked
from tests.px4_bags import px4

WHERE = "46.02,7.75,1620"


def test_usual_bag(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight()
    survey = ingest(bags.usual(flight))
    check(survey, flight)
    assert survey.warnings == ()
    vertical = survey.vertical
    assert (vertical.name, vertical.stated, vertical.by_definition) == ("ellipsoidal", False, True)
    assert "NavSatFix" in vertical.note and not vertical.is_assumed
    (camera,) = survey.cameras
    # ROS counts pixels from the centre of the first one: half a pixel more in COLMAP's coordinates.
    assert (camera.model, camera.focal_source) == ("OPENCV", "calibrated")
    np.testing.assert_allclose(camera.params, [50.0, 51.0, 32.0, 24.0, -0.05, 0.01, 1e-4, 2e-4])
    image = survey.images[2]
    assert image.name == "frame_000002.jpg" and image.timestamp_s == bags.START / 1e9 + 2
    assert image.fix is not None and (image.fix.source, image.fix.sigma_source) == ("bag", "file")
    np.testing.assert_allclose(image.fix.cov_in_geo, np.diag([4e-4, 4e-4, 16e-4]), atol=1e-7)
    assert image.attitude is not None and image.attitude.source == "bag"
    assert image.attitude.sigma_deg == pytest.approx(0.4)
    (workspace,) = tmp_path.glob("ws*")
    assert (workspace / "ingest/images" / image.name).read_bytes() == bags.jpeg(2).tobytes()
    track = NavigationTrack.load(workspace / "ingest/track.npz")
    assert (len(track.position_time_s), len(track.attitude_time_s)) == (len(flight.fix_ns), len(flight.imu_ns))
    np.testing.assert_allclose(track.antenna_in_body, np.tile(flight.arm, (6, 1)), atol=1e-12)


LOCAL = {
    "odometry": lambda f: bags.poses(f, "nav_msgs/msg/Odometry"),
    "pose": lambda f: bags.poses(f, "geometry_msgs/msg/PoseStamped"),
    "pose with covariance": lambda f: bags.poses(f, "geometry_msgs/msg/PoseWithCovarianceStamped"),
    "odometry of the optical frame": lambda f: bags.poses(f, "nav_msgs/msg/Odometry", body="camera_optical"),
    "px4 odometry": lambda f: px4(f, "VehicleOdometry"),
}


@pytest.mark.parametrize("convention", LOCAL)
def test_local_frames(ingest: Ingest, convention: str) -> None:
    flight = Flight()
    messages = [bags.transforms(flight), *LOCAL[convention](flight), *bags.images(flight)]
    check(ingest(messages, "--origin", WHERE), flight)


def test_ned_frames(ingest: Ingest) -> None:
    """North-East-Down and Forward-Right-Down by the names of the frames, as MAVROS has them."""
    flight = Flight()
    odometry = bags.poses(flight, "nav_msgs/msg/Odometry", world="map_ned", body="base_link_frd")
    check(
        ingest([bags.transforms(flight, "base_link_frd"), *odometry, *bags.images(flight)], "--origin", WHERE),
        flight,
    )
    mounted = [*bags.fixes(flight), *bags.imu(flight, frame="imu_ned"), *bags.images(flight)]
    check(ingest(mounted, "--camera-mount", "0,-35,0", "--lever-arm", "0.1,-0.2,-0.3"), flight)


def test_position_at_interpolated_times_and_offset(ingest: Ingest) -> None:
    """Stamps of the camera's clock between the samples, and 0.2 s behind the navigation's."""
    flight = Flight()
    messages = [one for one in bags.usual(flight) if "image" not in one[0]]
    for i, (topic, kind, ns, message) in enumerate(bags.images(flight)):
        message.header.stamp = bags.time(ns - 200_000_000)
        messages.append((topic, kind, ns + 30_000_000 * i, message))
    survey = ingest(messages, "--time-offset", "0.2")
    check(survey, flight)
    assert survey.images[0].timestamp_s == pytest.approx(bags.START / 1e9 - 0.2)


RAW = {
    "rgb8": lambda bgr: bgr[..., ::-1],
    "bgr8": lambda bgr: bgr,
    "rgba8": lambda bgr: np.dstack([bgr[..., ::-1], bgr[..., :1]]),
    "bgra8": lambda bgr: np.dstack([bgr, bgr[..., :1]]),
    "mono8": lambda bgr: bgr[..., 0],
}


@pytest.mark.parametrize("encoding", RAW)
def test_raw_images_lose_nothing(ingest: Ingest, tmp_path: Path, encoding: str) -> None:
    flight = Flight(count=3)
    survey = ingest([*bags.fixes(flight), *bags.raw_images(flight, encoding, RAW[encoding])])
    (workspace,) = tmp_path.glob("ws*")
    for i, image in enumerate(survey.images):
        read = cv2.imread(str(workspace / survey.image_dir / image.name), cv2.IMREAD_UNCHANGED)
        truth = bags.picture(i)
        np.testing.assert_array_equal(read, truth[..., 0] if encoding == "mono8" else truth)


def test_sixteen_bits_keep_their_top_eight(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight(count=3)

    def twelve_bits(bgr: np.ndarray) -> np.ndarray:
        return bgr[..., 0].astype("<u2") << 4 | 15

    survey = ingest([*bags.fixes(flight), *bags.raw_images(flight, "mono16", twelve_bits)])
    (workspace,) = tmp_path.glob("ws*")
    read = cv2.imread(str(workspace / survey.image_dir / survey.images[1].name), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, bags.picture(1)[..., 0])
    assert remarked(survey, "image-bit-depth", "12 bits")


@pytest.mark.parametrize(
    "encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8", "yuv422", "yuv422_yuy2"]
)
def test_colours_of_mosaics_and_yuv(ingest: Ingest, tmp_path: Path, encoding: str) -> None:
    """A plane of one colour comes back in that colour: red and blue are not swapped."""
    flight = Flight(count=3)
    colours = [np.array(bgr, np.uint8) for bgr in ((200, 100, 50), (40, 90, 220), (60, 200, 30))]
    made = iter(colours)
    survey = ingest(
        [*bags.fixes(flight), *bags.raw_images(flight, encoding, lambda _: bags.coded(next(made), encoding))]
    )
    (workspace,) = tmp_path.glob("ws*")
    for image, colour in zip(survey.images, colours, strict=True):
        read = cv2.imread(str(workspace / survey.image_dir / image.name))
        np.testing.assert_allclose(read[8:-8, 8:-8].reshape(-1, 3).mean(axis=0), colour, atol=3)  # YUV rounds


LENSES = {
    "with k3": ("plumb_bob", (-0.1, 0.02, 0.1, 0.2, 0.3), "FULL_OPENCV", (-0.1, 0.02, 0.1, 0.2, 0.3, 0, 0, 0)),
    "rational": ("rational_polynomial", (1, 2, 3, 4, 5, 6, 7, 8), "FULL_OPENCV", (1, 2, 3, 4, 5, 6, 7, 8)),
    "equidistant": ("equidistant", (0.1, 0.2, 0.3, 0.4), "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)),
    "none": ("plumb_bob", (0, 0, 0, 0, 0), "PINHOLE", ()),
}  # fmt: skip


@pytest.mark.parametrize("lens", LENSES)
def test_lens(ingest: Ingest, lens: str) -> None:
    flight = Flight(count=3)
    model, given, colmap, params = LENSES[lens]
    survey = ingest([bags.info(flight, model, given), *bags.fixes(flight), *bags.images(flight)])
    assert survey.cameras[0].model == colmap
    np.testing.assert_allclose(survey.cameras[0].params[4:], params)


def test_frames_by_time_by_distance_and_sharp(ingest: Ingest) -> None:
    flight = Flight(count=12)
    messages = bags.usual(flight)
    numbers = [int(image.name[6:12]) for image in ingest(messages, "--every", "2s").images]
    assert numbers == [0, 2, 4, 6, 8, 10]
    numbers = [int(image.name[6:12]) for image in ingest(messages, "--every", "11m").images]
    assert numbers == [0, 2, 4, 6, 8, 10]  # 5.85 m a second
    for _, kind, ns, message in messages:
        if kind.endswith("CompressedImage") and ns == flight.image_ns[6]:
            soft = cv2.GaussianBlur(bags.picture(6), (0, 0), 5)
            message.data = cv2.imencode(".jpg", soft)[1].ravel()
    survey = ingest(messages, "--every", "2s", "--skip-blurred")
    assert [int(image.name[6:12]) for image in survey.images] == [0, 2, 4, 7, 9, 11]
    assert remarked(survey, "blurred-frames", "1 frames")


class TestBadMessages:
    def test_fixes_that_are_none(self, ingest: Ingest) -> None:
        flight = Flight()
        messages = bags.usual(flight)
        places = [message for topic, _, _, message in messages if topic == "/gnss/fix"]
        for message in places[20:40]:  # 1.5 to 3.4 s
            message.status.status = -1
        places[50].altitude = np.nan
        places[0].latitude = np.nan
        for message in places:
            message.position_covariance_type = 0
        survey = ingest(messages)
        assert [image.fix is None for image in survey.images] == [False, False, True, True, False, False]
        assert remarked(survey, "message-unusable", "20 of 65", "/gnss/fix", "no fix (status)")
        assert remarked(survey, "message-unusable", "1 of 65", "/gnss/fix", "altitude is NaN")
        assert remarked(survey, "message-unusable", "latitude or longitude is NaN")
        assert remarked(survey, "images-without-position", "within 1 s", "--max-gap", "(2)")
        fix = survey.images[0].fix
        assert fix is not None and fix.sigma_source == "default"

    def test_stamps_that_run_backwards_or_jump(self, ingest: Ingest) -> None:
        flight = Flight()
        messages = bags.usual(flight)
        stamped = [message for topic, _, _, message in messages if topic == "/gnss/fix"]
        stamped[12].header.stamp = bags.time(bags.START - 400_000_000)
        stamped[13].header.stamp = bags.time(bags.START + 10**13)
        survey = ingest(messages)
        check(survey, flight)
        assert remarked(survey, "stamp-not-later", "1 of 65", "/gnss/fix")
        assert remarked(survey, "stamp-jump", "1 of 65", "/gnss/fix")

    def test_no_stamps_at_all(self, ingest: Ingest) -> None:
        flight = Flight()
        messages = bags.usual(flight)
        for _, _, _, message in messages:
            if hasattr(message, "header"):
                message.header.stamp = bags.time(0)
        survey = ingest(messages)
        check(survey, flight)
        assert remarked(survey, "messages-without-stamp")

    def test_messages_that_do_not_decode(self, ingest: Ingest) -> None:
        flight = Flight(count=8)
        messages = bags.usual(flight)
        for i, (topic, kind, ns, message) in enumerate(messages):
            if topic == "/gnss/fix" and ns == flight.fix_ns[3]:
                messages[i] = (topic, kind, ns, b"\x00\x01\x00\x00short")
            if "image" in topic and ns == flight.image_ns[1]:
                message.data = message.data[:500]
            if "image" in topic and ns == flight.image_ns[2]:
                message.data, message.format = np.frombuffer(b"not a picture", np.uint8), "h264"
        survey = ingest(messages)
        assert [image.name[6:12] for image in survey.images] == ["000000", *(f"{i:06d}" for i in range(3, 8))]
        assert remarked(
            survey, "image-unreadable", "/camera/image_raw/compressed", "(2): message 1 (", "format 'h264'"
        )
        assert remarked(survey, "message-damaged", "1 messages", "/gnss/fix")

    @pytest.mark.parametrize("storage", list(StoragePlugin))
    def test_damage_in_the_middle(self, ingest: Ingest, tmp_path: Path, storage: StoragePlugin) -> None:
        """What lies before the damage is used, and told to be not all."""
        flight = Flight(count=40)
        messages = sorted(bags.usual(flight), key=lambda one: one[2])
        for _, kind, _, message in messages:
            if kind.endswith("CompressedImage"):  # padded behind its end, for a bag of several chunks
                message.data = np.concatenate([message.data, np.zeros(200_000, np.uint8)])
        bags.write(tmp_path / "bag", messages, Form(storage))
        (file,) = [path for path in (tmp_path / "bag").iterdir() if path.suffix in (".mcap", ".db3")]
        data = bytearray(file.read_bytes())
        # In sqlite3 one page, of a photograph: with damaged branches a base cannot even be opened.
        start, length = int(0.3 * len(data)) // 4096 * 4096, 4096 if storage is StoragePlugin.SQLITE3 else 250_000
        data[start : start + length] = b"\xff" * length
        file.write_bytes(data)
        survey = ingest(tmp_path / "bag")
        assert 5 < len(survey.images) < 20
        assert remarked(survey, "bag-damaged")

    def test_truncated_bag(self, refusal: Refusal, tmp_path: Path) -> None:
        for storage in StoragePlugin:
            bags.write(tmp_path / storage.name, bags.usual(Flight()), Form(storage))
            for path in (tmp_path / storage.name).iterdir():
                if path.suffix in (".mcap", ".db3"):
                    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
        assert "damaged" in refusal(tmp_path / "MCAP")["message"]
        # SQLite reads on as far as its pages go: what is there is too little, or the file is refused.
        assert "damaged" in refusal(tmp_path / "SQLITE3")["message"]

    def test_no_bag(self, refusal: Refusal, tmp_path: Path) -> None:
        (tmp_path / "x.mcap").write_bytes(b"")
        assert "damaged" in refusal(tmp_path / "x.mcap")["message"]
        (tmp_path / "empty").mkdir()
        assert "metadata.yaml" in refusal(tmp_path / "empty")["message"]
        (tmp_path / "x.txt").write_bytes(b"text")
        assert "rosbag2 folder" in refusal(tmp_path / "x.txt")["message"]


class TestWhatIsMissing:
    def test_local_frame_needs_an_origin(self, refusal: Refusal) -> None:
        flight = Flight()
        error = refusal([*bags.poses(flight, "nav_msgs/msg/Odometry"), *bags.images(flight)])
        assert (error["code"], error["field"]) == ("local-frame-without-origin", "--origin")

    def test_no_photographs(self, refusal: Refusal) -> None:
        assert refusal(bags.fixes(Flight()))["code"] == "no-image-topic"

    def test_named_topic(self, refusal: Refusal) -> None:
        error = refusal(bags.usual(Flight()), "--fix-topic", "/imu/data")
        assert (error["code"], error["field"]) == ("topic-type", "--fix-topic")
        assert all(part in error["message"] for part in ("/imu/data", "sensor_msgs/msg/Imu", "/gnss/fix"))

    def test_crs_has_no_meaning(self, refusal: Refusal) -> None:
        error = refusal(bags.usual(Flight()), "--crs", "EPSG:32632")
        assert (error["code"], error["field"]) == ("crs-with-bag", "--crs")

    def test_no_mount(self, ingest: Ingest) -> None:
        flight = Flight()
        messages = [*bags.fixes(flight), *bags.imu(flight), *bags.images(flight)]
        survey = ingest(messages)
        assert all(image.attitude is None and image.fix is not None for image in survey.images)
        assert remarked(survey, "camera-mount-unknown", "--camera-mount")
        assert remarked(survey, "lever-arm-unknown")
        check(ingest(messages, "--camera-mount", "0,-35,0", "--lever-arm", "0.1,-0.2,-0.3"), flight)

    def test_unknown_type_is_no_harm(self, ingest: Ingest) -> None:
        flight = Flight()
        survey = ingest(bags.with_unknown(flight))
        check(survey, flight)

    def test_choice_is_by_rule_and_told(self, ingest: Ingest) -> None:
        flight = Flight()
        raw = bags.imu(flight, topic="/a/data_raw")
        for _, _, _, message in raw:
            message.orientation_covariance[0] = -1
        messages = [
            *bags.usual(flight), *raw, *bags.images(flight, "/depth/image/compressed"),
            *bags.poses(flight, "nav_msgs/msg/Odometry"),
        ]  # fmt: skip
        survey = ingest(messages)
        check(survey, flight)
        assert remarked(survey, "bag-topic-choice", "/gnss/fix, not /localization", "--fix-topic")
        assert remarked(survey, "bag-topic-choice", "/imu/data, not /localization", "--attitude-topic")
        assert remarked(survey, "bag-topic-choice", "not /depth/image/compressed", "--image-topic")


def test_moving_mount(ingest: Ingest) -> None:
    """A gimbal in /tf: each photograph has the mount of its moment."""
    flight = Flight()
    fixed = [one for one in bags.usual(flight) if one[0] != "/tf_static"]
    base, gnss = bags.transforms(flight)[3].transforms
    moving: list[Message] = []
    for i, ns in enumerate(flight.fix_ns):
        turned = Flight(cam_from_body=mount([2.0 * i, -35.0, 0.0]))
        message = bags.transforms(turned, topic="/tf")[3]
        for transform in message.transforms:
            transform.header.stamp = bags.time(ns)
        moving.append(("/tf", "tf2_msgs/msg/TFMessage", int(ns), message))
    survey = ingest([*fixed, *moving])
    for i, image in enumerate(survey.images):
        assert image.attitude is not None
        expected = bags.expected(Flight(cam_from_body=mount([2.0 * (5 + 10 * i), -35.0, 0.0])), survey.origin)[1][i]
        turned_by = log_so3(matrix_from_quat_xyzw(image.attitude.quat_xyzw) @ expected.T)
        assert np.degrees(np.linalg.norm(turned_by)) < 0.01
    assert base.child_frame_id == "camera_optical" and gnss.child_frame_id == "gnss"
