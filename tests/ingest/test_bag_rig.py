"""Cameras of one bag that expose together: which are a rig, whose rotations `/tf_static` states."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw
from pipelines.survey.survey import Survey
from tests import bags
from tests.bags import Flight, Message
from tests.ingested_bags import Ingest, Refusal, check
from tests.refusals import codes

TURN = exp_so3(np.array([0.02, 0.3, -0.1]))  # other camera ← that of the photographs
MS = 1_000_000
TOPICS = {
    "stereo": ("/left/image_raw/compressed", "/right/image_raw/compressed"),
    "numbered": ("/cam0/compressed", "/cam1/compressed"),
    "one namespace": ("/camera/image_left/compressed", "/camera/image_right/compressed"),
    "two payloads": ("/uav/rgb/image_color/compressed", "/uav/nir/image_mono/compressed"),
}


def pictures(
    flight: Flight, topic: str, frame: str, *, first: int, late_ns: Callable[[int], int] = lambda _: 0
) -> list[Message]:
    """Pictures of a camera; `first` numbers what it shows, and its stamps are late by nanoseconds."""
    kind = "sensor_msgs/msg/CompressedImage"
    stamps = [int(ns) + late_ns(i) for i, ns in enumerate(flight.image_ns)]
    return [
        (topic, kind, ns, bags.make(kind, bags.header(ns, frame), "jpeg", bags.jpeg(first + i)))
        for i, ns in enumerate(stamps)
    ]


def frames(flight: Flight, ns: int | None = None, turn: np.ndarray = TURN) -> Message:
    """`/tf_static` of body, antenna and both cameras; with a time, the link between the cameras moves in `/tf`."""
    kind = "tf2_msgs/msg/TFMessage"
    shift = bags.vector(np.array([0.2, 0.0, 0.0]))
    link = bags.make(
        "geometry_msgs/msg/TransformStamped", bags.header(ns or bags.START, "camera_optical"), "other_optical",
        bags.make("geometry_msgs/msg/Transform", shift, bags.quaternion(turn.T)),
    )  # fmt: skip
    if ns is not None:
        return "/tf", kind, ns, bags.make(kind, [link])
    topic, kind, at, message = bags.transforms(flight)
    return topic, kind, at, bags.make(kind, [*message.transforms, link])


def recorded(flight: Flight, topics: tuple[str, str], late_ns: Callable[[int], int] = lambda _: 0) -> list[Message]:
    one, other = topics
    mine = pictures(flight, one, "camera_optical", first=0)
    theirs = pictures(flight, other, "other_optical", first=100, late_ns=late_ns)
    return [*bags.fixes(flight), *bags.imu(flight), *mine, *theirs]


def beside(survey: Survey) -> dict[str, str]:
    return {each.name: each.beside for each in survey.companions}


@pytest.mark.parametrize("kind", TOPICS)
def test_cameras_that_expose_together_are_a_rig(ingest: Ingest, tmp_path: Path, kind: str) -> None:
    """Stamps differ by up to 4 ms, as of two drivers of one trigger."""
    flight = Flight()
    messages = [frames(flight), *recorded(flight, TOPICS[kind], lambda i: MS * (i % 5))]
    survey = ingest(messages, "--sensor", "all", "--image-topic", TOPICS[kind][0])
    check(survey, flight)
    (folder,) = {each.name.rpartition("/")[0] for each in survey.companions}
    assert beside(survey) == {f"{folder}/frame_{i:06d}.jpg": f"frame_{i:06d}.jpg" for i in range(flight.count)}
    assert len(survey.cameras) == 2
    assert {image.camera_id for image in survey.images} == {1}
    assert {each.camera_id for each in survey.companions} == {2}
    assert "rig" in codes(survey.assumptions)
    assert not {"bag-topic-choice", "other-sensors"} & set(codes((*survey.assumptions, *survey.warnings)))
    for each in survey.companions:
        assert each.stated_quat_xyzw is not None
        apart = log_so3(matrix_from_quat_xyzw(each.stated_quat_xyzw) @ TURN.T)
        assert np.degrees(np.linalg.norm(apart)) < 1e-6
    (workspace,) = tmp_path.glob("ws*")
    for i, each in enumerate(survey.companions):
        assert (workspace / "ingest/images" / each.name).read_bytes() == bags.jpeg(100 + i).tobytes()


def test_one_camera_is_the_default_and_the_rig_is_offered(ingest: Ingest) -> None:
    flight = Flight()
    survey = ingest([frames(flight), *recorded(flight, TOPICS["stereo"])])
    assert survey.companions == () and len(survey.images) == flight.count
    (choice,) = [each for each in survey.assumptions if each.code == "bag-topic-choice"]
    assert "--sensor all" in choice.remedy and "--image-topic" in choice.remedy


def test_the_chosen_camera_is_the_reference_and_each_lens_is_its_own(ingest: Ingest) -> None:
    flight = Flight()
    _, kind, ns, lens = bags.info(flight)
    lens.k[:] = [70.0, 0, 30.5, 0, 71.0, 20.5, 0, 0, 1]
    other = ("/right/camera_info", kind, ns, lens)
    own = ("/left/camera_info", *bags.info(flight)[1:])
    messages = [frames(flight), own, other, *recorded(flight, TOPICS["stereo"])]
    survey = ingest(messages, "--sensor", "all", "--image-topic", TOPICS["stereo"][0])
    assert [camera.sensor for camera in survey.cameras] == ["left", "right"]
    assert [camera.params[:4] for camera in survey.cameras] == [(50.0, 51.0, 32.0, 24.0), (70.0, 71.0, 31.0, 21.0)]
    swapped = ingest(messages, "--sensor", "all", "--image-topic", TOPICS["stereo"][1])
    assert [camera.sensor for camera in swapped.cameras] == ["right", "left"]
    (quat,) = {each.stated_quat_xyzw for each in swapped.companions}
    np.testing.assert_allclose(matrix_from_quat_xyzw(quat), TURN.T, atol=1e-9)


def test_instants_that_one_camera_lacks_have_one_photograph(ingest: Ingest) -> None:
    """Late by 300 ms at two instants, and without `/tf` of the other camera: no rotation is stated."""
    flight = Flight()
    messages = recorded(flight, TOPICS["numbered"], lambda i: 300 * MS if i in (1, 4) else 0)
    survey = ingest([bags.transforms(flight), *messages], "--sensor", "all", "--image-topic", TOPICS["numbered"][0])
    assert len(survey.images) == flight.count
    assert sorted(beside(survey).values()) == [f"frame_{i:06d}.jpg" for i in (0, 2, 3, 5)]
    assert {each.stated_quat_xyzw for each in survey.companions} == {None}


def test_drivers_that_name_no_frame_are_told_apart_by_their_topics(ingest: Ingest) -> None:
    flight = Flight()
    pair = [pictures(flight, topic, "", first=100 * i) for i, topic in enumerate(TOPICS["stereo"])]
    survey = ingest([*bags.fixes(flight), *pair[0], *pair[1]], "--sensor", "all")
    assert len(survey.companions) == flight.count


def test_topics_of_one_camera_are_no_rig(refusal: Refusal) -> None:
    """Raw, compressed and rectified pictures of one camera, by its namespace; and by its frame."""
    flight = Flight()
    usual = [bags.transforms(flight), *bags.fixes(flight), *bags.imu(flight)]
    compressed = pictures(flight, "/camera/image_raw/compressed", "camera_optical", first=0)
    raw = bags.raw_images(flight, "bgr8", lambda bgr: bgr)
    rectified = pictures(flight, "/camera/image_rect/compressed", "camera_optical", first=50)
    error = refusal([*usual, *compressed, *raw, *rectified], "--sensor", "all")
    assert (error["code"], error["field"]) == ("no-rig", "--sensor")


def _alone(flight: Flight) -> list[Message]:
    return [*bags.fixes(flight), *bags.images(flight)]


def _same_pictures(flight: Flight) -> list[Message]:
    pair = [
        pictures(flight, f"/{name}/image/compressed", f"{name}_optical", first=0) for name in ("camera", "other")
    ]
    return [frames(flight), *bags.fixes(flight), *pair[0], *pair[1]]


def _same_frame(flight: Flight) -> list[Message]:
    pair = [
        pictures(flight, f"/{name}/image/compressed", "camera_optical", first=50 * i) for i, name in enumerate("ab")
    ]
    return [frames(flight), *bags.fixes(flight), *pair[0], *pair[1]]


def _not_triggered(flight: Flight) -> list[Message]:
    return [frames(flight), *recorded(flight, TOPICS["stereo"], lambda _: 20 * MS)]


def _on_a_gimbal(flight: Flight) -> list[Message]:
    turns = (exp_so3(np.array([0.0, 0.01 * i, 0.0])) @ TURN for i in range(flight.count))
    moving = [frames(flight, int(ns), turn) for ns, turn in zip(flight.image_ns, turns, strict=True)]
    return [bags.transforms(flight), *recorded(flight, TOPICS["stereo"]), *moving]


@pytest.mark.parametrize(
    ("made", "code", "numbers"),
    [
        (_alone, "no-rig", ()),
        (_same_pictures, "bag-camera-same", ()),
        (_same_frame, "no-rig", ("camera_optical",)),
        (_not_triggered, "no-rig", ("20.0 ms", "5 ms")),
        (_on_a_gimbal, "no-rig", ("2.9°",)),
    ],
)
def test_cameras_that_are_no_rig_are_refused(
    refusal: Refusal, made: Callable[[Flight], list[Message]], code: str, numbers: tuple[str, ...]
) -> None:
    error = refusal(made(Flight()), "--sensor", "all")
    assert (error["code"], error["field"]) == (code, "--sensor")
    assert all(number in error["message"] for number in numbers)


def test_a_bag_has_no_other_sensors(refusal: Refusal) -> None:
    flight = Flight()
    error = refusal([frames(flight), *recorded(flight, TOPICS["stereo"])], "--sensor", "nir")
    assert error["code"] == "bag-and-other-source" and "--image-topic" in str(error)
