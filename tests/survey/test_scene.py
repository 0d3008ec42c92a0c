"""The scene in the frame `model`: where things lie, and which images are for what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.rotations import exp_so3
from pipelines.survey.scene import initial_scene
from pipelines.survey.solution import SolvedLens
from tests.refusals import numbers, refused
from tests.scenes import initial, material, trained_cameras, trained_model

pytestmark = pytest.mark.usefixtures("one_thread")


def test_model_is_geo_but_for_a_shift_of_whole_metres() -> None:
    truth, sparse, survey = material()
    scene = initial_scene(sparse, survey, initial())
    shift = scene.geo_from_model.translation
    assert (shift == np.round(shift)).all()
    assert np.abs(np.median(scene.point_in_model, axis=0)).max() <= 0.5
    np.testing.assert_allclose(scene.point_in_model + shift, truth.point_in_geo, atol=1e-9)
    np.testing.assert_allclose(scene.poses.cam_center_in_model + shift, truth.center_in_geo, atol=1e-9)
    np.testing.assert_allclose(scene.poses.cam_from_model, np.swapaxes(truth.geo_from_cam, 1, 2), atol=1e-12)


def test_split_is_the_surveys_and_only_of_registered_images() -> None:
    _, sparse, survey = material()
    images = [
        image.model_copy(update={"split": "test" if i in (1, 5) else "train"})
        for i, image in enumerate(survey.images)
    ]
    lost = survey.images[0].model_copy(update={"name": "lost.jpg"})
    scene = initial_scene(sparse, survey.model_copy(update={"images": (*images, lost)}), initial())
    assert scene.test.tolist() == [1, 5]
    assert scene.train.tolist() == [0, 2, 3, 4, 6, 7]
    few = tuple(image.model_copy(update={"split": "test"}) for image in images[:-1])
    with refused("too-few-training-images", DegenerateGeometryError) as error:
        initial_scene(sparse, survey.model_copy(update={"images": (*few, images[-1])}), initial())
    assert numbers(str(error.value))[0] == 1


def test_scene_at_a_solution_shows_what_its_cameras_see() -> None:
    """SfM's model is bent, its lens wrong: the points of the solution lie where the true cameras see them."""
    truth, sparse, survey = material()
    right = initial_scene(sparse, survey, initial())
    (number, lens), rng = next(iter(sparse.cameras.items())), np.random.default_rng(1)
    params = lens.params.copy()
    params[0] *= 1.01
    turn = exp_so3(rng.normal(0, 0.002, (len(sparse.image_name), 3)))
    bent = replace(
        sparse,
        cameras={number: replace(lens, params=params)},
        rotation_cam_from_local=turn @ sparse.rotation_cam_from_local,
        translation_cam_from_local=sparse.translation_cam_from_local + rng.normal(0, 0.01, turn.shape[:2]),
        point_in_local=1.02 * sparse.point_in_local,
    )
    scene = initial_scene(bent, survey, initial())
    shift = scene.geo_from_model.translation
    poses = CameraPoses(np.swapaxes(truth.geo_from_cam, 1, 2), truth.center_in_geo - shift)
    solution = trained_model(
        scene.geo_from_model, scene.model_from_local, cameras=trained_cameras(sparse.image_name, poses)
    ).model_copy(update={"lenses": (SolvedLens(camera_id=number, model=lens.model, params=tuple(lens.params)),)})
    solved = scene.at(solution)
    assert np.linalg.norm(scene.point_in_model + shift - truth.point_in_geo, axis=1).max() > 0.5
    seen = refined_points(right.network).point_in_world + right.geo_from_model.translation
    np.testing.assert_allclose(solved.point_in_model + shift, seen, atol=1e-3)
    np.testing.assert_allclose(solved.poses.cam_center_in_model, poses.cam_center_in_model, atol=1e-9)
    np.testing.assert_allclose(solved.poses.cam_from_model, poses.cam_from_model, atol=1e-9)
    np.testing.assert_array_equal(solved.sparse.cameras[number].params, lens.params)
    assert (solved.train == right.train).all()
    assert (solved.geo_from_model.translation == shift).all()
