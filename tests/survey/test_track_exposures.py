"""Exposures from photographs and tracks: photographs of a smooth ground, each with its own exposure."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipelines.geometry.cameras import Camera, undistort
from pipelines.geometry.similarity import Similarity
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.scene import SparseScene
from pipelines.train.track_exposures import exposures_from_tracks
from tests.scenes import STATED, TrueScene, make_scene, sparse_model

CAMERA = Camera("SIMPLE_RADIAL", 240, 180, np.array([200.0, 121.0, 88.0, -0.04]))
TEST = 4


def ground_colour(place: np.ndarray) -> np.ndarray:
    """Colours (…, 3) of places (…, 2), which vary over 20 m."""
    east, north = place[..., 0] / 12, place[..., 1] / 12
    tones = np.stack([np.sin(east), np.cos(north + 0.5 * east), np.sin(north) * np.cos(east)], axis=-1)
    return np.asarray(0.45 + 0.12 * tones + 0.12 * np.sin(east + north)[..., None])


def flat_scene() -> TrueScene:
    """A nadir grid over level ground, whose points lie on the ground."""
    scene = make_scene("grid", images=9, points=400)
    flat = scene.point_in_geo * [1.0, 1.0, 0.0]
    return TrueScene(scene.center_in_geo, scene.geo_from_cam, flat, scene.gcp_in_geo, camera=CAMERA)


def photographs(scene: TrueScene, exposure: np.ndarray, folder: Path) -> ImageCache:
    """Photographs through the lens, with exposures (n, 3, 4)."""
    column, row = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    ray = undistort(CAMERA, np.stack([column, row], axis=-1))
    ray = np.concatenate([ray, np.ones((*ray.shape[:2], 1))], axis=2)
    shots = []
    for name, center, rotation, affine in zip(
        scene.names, scene.center_in_geo, scene.geo_from_cam, exposure, strict=True
    ):
        direction = ray @ rotation.T
        place = center[:2] - center[2] * direction[..., :2] / direction[..., 2:]
        colour = ground_colour(place) @ affine[:, :3].T + affine[:, 3]
        (folder / name).write_bytes(cv2.imencode(".png", np.rint(255 * colour)[..., ::-1])[1].tobytes())
        shots.append(Photograph(name, folder / name, CAMERA))
    return ImageCache(folder / "cache", shots, 160)


def test_exposures_of_photographs_follow_from_their_tracks(tmp_path: Path) -> None:
    rng, scene = np.random.default_rng(0), flat_scene()
    exposure = np.tile(np.eye(3, 4), (9, 1, 1))
    exposure[:, range(3), range(3)] += rng.normal(0, 0.1, (9, 1)) + rng.normal(0, 0.03, (9, 3))
    train = np.delete(np.arange(9), TEST)
    exposure[train] -= exposure[train].mean(axis=0) - np.eye(3, 4)
    sparse = sparse_model(scene, STATED, rng)
    setting = SparseScene(sparse, Similarity(), Similarity(), train, np.array([TEST]))
    found = exposures_from_tracks(setting, photographs(scene, exposure, tmp_path))
    place = np.append(ground_colour(rng.uniform(-50, 50, (200, 2))), np.ones((200, 1)), axis=1)
    error = place @ np.swapaxes(found - exposure, 1, 2)
    # Levels of grey are rounded to 1/255, the blur over 5 pixels is about the same in all photographs.
    assert np.sqrt((error**2).mean()) < 1 / 255
