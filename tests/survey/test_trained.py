"""A trained model read back: cameras as they were written, and only with the reconstruction they belong to."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import ADJUSTMENT, MODEL, SIM3
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.survey.solution import Solution, SolvedCamera, SolvedLens, TrainedModel, read_sfm, read_trained
from tests.refusals import refused
from tests.scenes import (
    GEO_FROM_LOCAL,
    Measured,
    Noise,
    initial,
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
        SolvedCamera(
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
    return workspace


def test_cameras_come_back(workspace: Workspace) -> None:
    trained, scene = read_trained(workspace), make_scene(images=5, points=20)
    np.testing.assert_allclose(trained.poses.cam_center_in_model, scene.center_in_geo, atol=1e-9)
    np.testing.assert_allclose(trained.poses.cam_from_model, np.swapaxes(scene.geo_from_cam, 1, 2), atol=1e-12)
    np.testing.assert_array_equal(trained.similarity.apply(np.zeros(3)), [5.0, 6.0, 7.0])
    assert trained.indices("test") == [2]
    assert trained.indices("train") == [0, 1, 3, 4]
    assert read_sfm(workspace, trained).image_name == tuple(camera.name for camera in trained.cameras)


def test_order_of_another_reconstruction_is_refused(workspace: Workspace) -> None:
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(model.model_copy(update={"cameras": model.cameras[::-1]}), workspace.root / MODEL)
    with refused("cameras-of-another-model", InputError) as error:
        read_sfm(workspace, read_trained(workspace))
    assert (error.value.path, error.value.field) == (workspace.root / MODEL, "cameras")


def test_solutions_of_earlier_versions_are_refused_in_one_sentence(workspace: Workspace) -> None:
    """They have no rejected distances, which stood in the other document of `init-sim3`."""
    path = workspace.root / MODEL
    document = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({key: document[key] for key in document if key != "distance_outliers"}), "utf-8")
    assert read_trained(workspace).distance_outliers == ()
    (workspace.root / SIM3).parent.mkdir()
    (workspace.root / SIM3).write_text("{}", "utf-8")
    with refused("solution-of-older-version", InputError) as error:
        read_trained(workspace)
    assert error.value.path == path and "`georef init-sim3`" in error.value.remedy


def test_initial_similarity_takes_the_place_of_the_trained_one(workspace: Workspace) -> None:
    model, start = read_trained(workspace), initial()
    save_json(
        Solution.model_validate(model.model_dump(include=set(Solution.model_fields))),
        workspace.root / ADJUSTMENT,
    )
    with refused("solution-of-older-version", InputError):
        read_trained(workspace, "initial")
    document = load_json(Solution, workspace.path(ADJUSTMENT))
    save_json(document.model_copy(update={"initial": start}), workspace.root / ADJUSTMENT)
    placed = read_trained(workspace, "initial")
    np.testing.assert_allclose(
        placed.similarity.apply(Similarity.from_record(placed.model_from_local).apply(np.eye(3))),
        Similarity.from_record(start.geo_from_local).apply(np.eye(3)),
        atol=1e-9,
    )
    assert placed.geo_from_model.covariance == start.geo_from_local.covariance
    assert placed.cameras == model.cameras


def test_untrained_workspace_names_the_command(workspace: Workspace) -> None:
    (workspace.root / MODEL).unlink()
    with refused("missing-product", MissingProductError) as error:
        read_trained(workspace)
    assert "`georef train" in error.value.remedy


def with_lens(workspace: Workspace, lens: SolvedLens) -> Workspace:
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(model.model_copy(update={"lenses": (lens,)}), workspace.root / MODEL)
    return workspace


def test_lenses_come_back_beside_those_of_sfm(workspace: Workspace) -> None:
    before = read_trained(workspace)
    sfm = read_sfm(workspace, before)
    ((key, camera),) = sfm.cameras.items()
    assert before.with_lenses(sfm).cameras[key] == camera
    params = tuple(camera.params + 1.0)
    after = read_trained(with_lens(workspace, SolvedLens(camera_id=key, model=camera.model, params=params)))
    np.testing.assert_array_equal(after.with_lenses(sfm).cameras[key].params, params)
    np.testing.assert_array_equal(read_sfm(workspace, after).cameras[key].params, camera.params)


def test_lenses_of_another_reconstruction_are_refused(workspace: Workspace) -> None:
    with_lens(workspace, SolvedLens(camera_id=77, model="PINHOLE", params=(1.0, 1.0, 1.0, 1.0)))
    with refused("lenses-of-another-model", InputError):
        read_sfm(workspace, read_trained(workspace))
