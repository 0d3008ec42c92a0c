"""The scene in the frame `model`: where things lie, and which images are for what."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.survey.scene import initial_scene
from tests.refusals import numbers, refused
from tests.scenes import initial, material

pytestmark = pytest.mark.usefixtures("one_thread")

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
