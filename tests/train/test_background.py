"""Background points: where no SfM point is, on the ground or in the sky, in the colour of the photograph."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.geometry.cameras import Camera
from pipelines.geometry.similarity import Similarity
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.scene import SparseScene
from pipelines.survey.scene import make_scene as in_model
from pipelines.train.initial_gaussians import background, ground_plane
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")

CAMERA = Camera("PINHOLE", 240, 180, np.array([200.0, 200.0, 120.0, 90.0]))
GREY, BLUE = 90, 200


@pytest.fixture
def scene() -> SparseScene:
    """An orbit that looks at the horizon; SfM points only on the scene's middle."""
    truth, rng = make_scene(images=6, points=400), np.random.default_rng(0)
    cloud = np.column_stack([rng.uniform(-30, 30, (400, 2)), rng.uniform(0, 1, 400)])
    center = truth.center_in_geo * [1.0, 1.0, 0.25]
    forward = -center * [1.0, 1.0, 0.0]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=-1)
    truth = replace(
        truth,
        center_in_geo=center,
        geo_from_cam=rotation,
        point_in_geo=cloud,
        camera=CAMERA,
        geo_from_local=Similarity(),
    )
    noise = Noise(pixel_px=0.0)
    return in_model(
        sparse_model(truth, noise, rng), survey_of(truth, noise, Measured(), rng), Similarity(), np.zeros(3)
    )


@pytest.fixture
def images(scene: SparseScene, tmp_path: Path) -> ImageCache:
    """Photographs that are grey below the horizon and blue above."""
    picture = np.full((180, 240, 3), GREY, np.uint8)
    picture[:90] = (BLUE, 120, 60)  # BGR
    shots = []
    for name in scene.sparse.image_name:
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
        shots.append(Photograph(name, tmp_path / f"{name}.png", CAMERA))
    return ImageCache(tmp_path / "cache", shots, 240)


def test_points_lie_on_the_ground_or_in_the_sky(scene: SparseScene, images: ImageCache) -> None:
    found = background(scene, images, scene.point_in_model)
    middle = np.median(scene.point_in_model, axis=0)
    distance = np.linalg.norm(found.point_in_model - middle, axis=1)
    a, b, c = ground_plane(scene.point_in_model)
    x, y, z = found.point_in_model.T
    ground = np.abs(z - (a * x + b * y + c)) < 1e-6
    radius = np.percentile(np.linalg.norm(scene.point_in_model - middle, axis=1), 90)
    assert ground.sum() > 20
    assert (~ground).sum() > 20
    # The sky is 12 radii from each camera; cameras are within 3 of the middle.
    assert (distance[~ground] > 9 * radius).all()
    assert (distance[ground] < 9 * radius).all()


def test_colours_are_those_of_the_rays(scene: SparseScene, images: ImageCache) -> None:
    found = background(scene, images, scene.point_in_model)
    high = found.point_in_model[:, 2] > 40.0  # above every camera
    assert (found.rgb[high] == (60, 120, BLUE)).all()
    low = np.abs(found.point_in_model[:, 2] - np.percentile(scene.point_in_model[:, 2], 5)) < 1e-6
    assert (found.rgb[low] == GREY).all()


def test_places_with_sfm_points_are_left_to_them(scene: SparseScene, images: ImageCache) -> None:
    found = background(scene, images, scene.point_in_model)
    ground = found.point_in_model[:, 2] < 5.0
    in_the_cloud = (np.abs(found.point_in_model[ground, :2]) < 15.0).all(axis=1)
    assert in_the_cloud.sum() <= 0.02 * len(found.sigma_m)


def test_size_is_that_of_the_cell_seen_from_its_camera(scene: SparseScene, images: ImageCache) -> None:
    found = background(scene, images, scene.point_in_model)
    middle, radius = np.median(scene.point_in_model, axis=0), 0.0
    radius = float(np.percentile(np.linalg.norm(scene.point_in_model - middle, axis=1), 90))
    sky = found.point_in_model[:, 2] > 60.0
    np.testing.assert_allclose(found.sigma_m[sky], 0.5 * 12 * radius * 240 / (24 * 200))
    assert (found.sigma_m > 0).all()


def test_neighbouring_views_do_not_repeat_a_place(scene: SparseScene, images: ImageCache) -> None:
    found = background(scene, images, scene.point_in_model)
    level = np.round(np.log2(found.sigma_m))
    cube = np.floor(found.point_in_model / (2.0 ** (level + 1))[:, None])
    assert len(np.unique(np.column_stack([level, cube]), axis=0)) == len(cube)


def test_cloud_that_fills_the_view_needs_none(scene: SparseScene, images: ImageCache) -> None:
    rng = np.random.default_rng(1)
    everywhere = rng.normal(0, 200, (60_000, 3))
    full = replace(scene, sparse=replace(scene.sparse, point_in_local=everywhere))
    assert len(background(full, images, full.point_in_model).sigma_m) == 0
