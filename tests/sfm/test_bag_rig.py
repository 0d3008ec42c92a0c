"""Two cameras of one bag from their messages to the model: their centres at each instant, against the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.products import load_json
from pipelines.core.stages import RIG_MODEL, SPARSE
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import umeyama
from pipelines.geometry.trajectory import mount
from pipelines.simulate.lens import BrownLens, Pose, Renderer, Sensor
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey
from pipelines.survey.survey import Survey
from tests import bags
from tests.bags import Message

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap")
pytest.importorskip("embreex")

WIDTH, HEIGHT = 400, 300
LENSES = tuple(BrownLens("pinhole", WIDTH, HEIGHT, focal, (WIDTH / 2, HEIGHT / 2)) for focal in (340.0, 352.0))
TOPICS, FRAMES = ("/left/image_raw/compressed", "/right/image_raw/compressed"), ("camera_optical", "other_optical")
OFFSET_M = np.array([0.3, 0.02, -0.03])  # of the right camera, in the axes of the left one
TURN = exp_so3(np.radians([1.0, -2.0, 1.5]))  # right ← left


@dataclass
class Circle(bags.Flight):
    """Twelve photographs a second apart, straight down on a circle that the nose follows; it sways by 4°."""

    count: int = 12
    cam_from_body: np.ndarray = field(default_factory=lambda: mount([0.0, -90.0, 0.0]))

    def _angle(self, time_ns: np.ndarray) -> np.ndarray:
        return 2 * np.pi * (time_ns - bags.START) / 1e9 / self.count

    def camera(self, time_ns: np.ndarray) -> np.ndarray:
        angle = self._angle(time_ns)
        return np.stack([14 * np.cos(angle), 14 * np.sin(angle), 42 + 2 * np.sin(3 * angle)], axis=1)

    def enu_from_body(self, time_ns: np.ndarray) -> np.ndarray:
        angle = self._angle(time_ns)
        sway = np.radians(4) * np.stack([np.sin(2 * angle), np.cos(3 * angle), 0 * angle], axis=1)
        forward_right_down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # to the north
        heading = exp_so3(np.outer(angle, [0.0, 0.0, 1.0]))
        return np.asarray(heading @ forward_right_down @ exp_so3(sway))


def recorded(flight: Circle) -> tuple[list[Message], np.ndarray]:
    """Messages of the flight over a town, and the centres (N, 2, 3) of its cameras."""
    scene = fly_survey(SimulateOptions(images=3, size="64x48", targets=0, control=0)).world.scene
    left, turned = flight.camera(flight.image_ns), flight.enu_from_body(flight.image_ns) @ flight.cam_from_body.T
    centers = np.stack([left, left + turned @ OFFSET_M], axis=1)
    rotations = (turned, turned @ TURN.T)
    messages = [*bags.fixes(flight), *bags.imu(flight), frames(flight)]
    for number, (lens, topic, frame) in enumerate(zip(LENSES, TOPICS, FRAMES, strict=True)):
        renderer, rng = Renderer(scene, lens, 4), np.random.default_rng(number)
        messages.append(info(flight, lens, topic, frame))
        for ns, center, rotation in zip(flight.image_ns, centers[:, number], rotations[number], strict=True):
            rgb = renderer.photograph(Pose(center, rotation), Sensor(1.1, (1.0, 1.0, 1.0), 0.5), rng)
            encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])[1].ravel()
            kind = "sensor_msgs/msg/CompressedImage"
            messages.append((topic, kind, int(ns), bags.make(kind, bags.header(ns, frame), "jpeg", encoded)))
    return messages, centers


def frames(flight: Circle) -> Message:
    """`/tf_static` of body, antenna and both cameras."""
    link = bags.make(
        "geometry_msgs/msg/TransformStamped", bags.header(bags.START, FRAMES[0]), FRAMES[1],
        bags.make("geometry_msgs/msg/Transform", bags.vector(OFFSET_M), bags.quaternion(TURN.T)),
    )  # fmt: skip
    topic, kind, ns, message = bags.transforms(flight)
    return topic, kind, ns, bags.make(kind, [*message.transforms, link])


def info(flight: Circle, lens: BrownLens, topic: str, frame: str) -> Message:
    """The lens's CameraInfo, whose pixels are counted from the first one's centre."""
    _, kind, ns, message = bags.info(flight, lens=[0.0] * 5)
    message.header.frame_id, message.width, message.height = frame, lens.width, lens.height
    cx, cy = lens.center_px
    message.k[:] = [lens.focal_px, 0, cx - 0.5, 0, lens.focal_px, cy - 0.5, 0, 0, 1]
    return topic.replace("image_raw/compressed", "camera_info"), kind, ns, message


def test_the_cameras_of_a_bag_keep_their_places_at_each_instant(tmp_path: Path) -> None:
    """From 42 m a pixel is 12 cm; over 1000 tie points in a photograph tell its centre to a sixth of that."""
    flight, workspace = Circle(), Workspace(tmp_path / "ws")
    messages, center = recorded(flight)
    bag = bags.write(tmp_path / "bag", messages)
    ingest = ["ingest", str(workspace.root), "--bag", str(bag), "--sensor", "all", "--image-topic", TOPICS[0]]
    for command in (ingest, ["sfm", str(workspace.root), "--threads", "1"]):
        assert boundary.guarded(cli, command) == 0
    survey = load_json(Survey, workspace.path("ingest/survey.json"))
    number = {image.name: k for k, image in enumerate(survey.images)}
    place = {name: (k, 0) for name, k in number.items()}
    place |= {each.name: (number[each.beside], 1) for each in survey.companions}

    model = read_sparse(workspace.path(RIG_MODEL))
    assert len(place) == 2 * flight.count and sorted(model.image_name) == sorted(place)
    solved = np.full(center.shape, np.nan)
    rotation = np.full((*center.shape[:2], 3, 3), np.nan)
    for name, turn, shift in zip(
        model.image_name, model.rotation_cam_from_local, model.translation_cam_from_local, strict=True
    ):
        solved[place[name]], rotation[place[name]] = -turn.T @ shift, turn
    world = umeyama(solved[:, 0], center[:, 0])
    placed = world.apply(solved.reshape(-1, 3)).reshape(solved.shape)
    error_m = np.linalg.norm(placed - center, axis=2)
    print(error_m.max(axis=0))
    assert error_m.max() < 0.02
    # A pixel is 0.17°; all instants have one rotation of the cameras against each other.
    apart = log_so3(rotation[:, 1] @ np.swapaxes(rotation[:, 0], 1, 2) @ TURN.T)
    assert np.degrees(np.linalg.norm(apart, axis=1)).max() < 0.05
    assert np.ptp(apart, axis=0).max() < 1e-9
    assert sorted(read_sparse(workspace.path(SPARSE)).image_name) == sorted(number)
