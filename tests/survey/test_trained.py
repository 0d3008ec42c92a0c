"""A trained model read back: cameras as they were written, and only with the reconstruction they belong to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import write_gaussians
from pipelines.splat.initialise import gaussians_of_size
from pipelines.survey.trained_model import TrainedCamera, TrainedLens, TrainedModel
from pipelines.survey.trained_survey import load_trained
from tests.refusals import refused
from tests.scenes import (
    GEO_FROM_LOCAL,
    Measured,
    Noise,
    make_scene,
    sparse_model,
    survey_of,
    trained_model,
    write_workspace,
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    scene, rng = make_scene(images=5, points=20), np.random.default_rng(0)
    sparse = sparse_model(scene, Noise(), rng)
    workspace = write_workspace(tmp_path, survey_of(scene, Noise(), Measured(), rng), sparse)
    rotation = np.swapaxes(scene.geo_from_cam, 1, 2)
    cameras = tuple(
        TrainedCamera(
            name=name,
            split="test" if index == 2 else "train",
            quat_xyzw=tuple(quat_xyzw_from_matrix(rotation[index])),
            translation=tuple(-rotation[index] @ scene.center_in_geo[index]),
        )
        for index, name in enumerate(scene.names)
    )
    geo_from_model = Similarity(translation=np.array([5.0, 6.0, 7.0]))
    model = trained_model(geo_from_model, GEO_FROM_LOCAL, cameras=cameras)
    save_json(model, tmp_path / MODEL)
    write_gaussians(tmp_path / GAUSSIANS, gaussians_of_size(np.zeros((2, 3)), np.zeros((2, 3)), np.ones(2)))
    return workspace


def test_cameras_come_back(workspace: Workspace) -> None:
    trained, scene = load_trained(workspace), make_scene(images=5, points=20)
    np.testing.assert_allclose(trained.poses.cam_center_in_model, scene.center_in_geo, atol=1e-9)
    np.testing.assert_allclose(trained.poses.cam_from_model, np.swapaxes(scene.geo_from_cam, 1, 2), atol=1e-12)
    np.testing.assert_array_equal(trained.geo_from_model.apply(np.zeros(3)), [5.0, 6.0, 7.0])
    assert trained.indices("test") == [2]
    assert trained.indices("train") == [0, 1, 3, 4]
    assert len(trained.gaussians) == 2


def test_order_of_another_reconstruction_is_refused(workspace: Workspace) -> None:
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(model.model_copy(update={"cameras": model.cameras[::-1]}), workspace.root / MODEL)
    with refused("cameras-of-another-model", InputError) as error:
        load_trained(workspace)
    assert (error.value.path, error.value.field) == (workspace.root / MODEL, "cameras")


def test_untrained_workspace_names_the_command(workspace: Workspace) -> None:
    (workspace.root / MODEL).unlink()
    with refused("missing-product", MissingProductError) as error:
        load_trained(workspace)
    assert error.value.hint is not None and "`georef train" in error.value.hint


def with_lens(workspace: Workspace, lens: TrainedLens) -> Workspace:
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(model.model_copy(update={"lenses": (lens,)}), workspace.root / MODEL)
    return workspace


def test_lenses_come_back_beside_those_of_sfm(workspace: Workspace) -> None:
    before = load_trained(workspace)
    ((key, camera),) = before.sfm.cameras.items()
    assert before.sparse.cameras[key] == camera
    params = tuple(camera.params + 1.0)
    after = load_trained(with_lens(workspace, TrainedLens(camera_id=key, model=camera.model, params=params)))
    np.testing.assert_array_equal(after.sparse.cameras[key].params, params)
    np.testing.assert_array_equal(after.sfm.cameras[key].params, camera.params)


def test_lenses_of_another_reconstruction_are_refused(workspace: Workspace) -> None:
    with_lens(workspace, TrainedLens(camera_id=77, model="PINHOLE", params=(1.0, 1.0, 1.0, 1.0)))
    with refused("lenses-of-another-model", InputError):
        load_trained(workspace)
