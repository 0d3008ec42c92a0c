"""A workspace whose trained model is the truth, written without any training."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pipelines.adjust.measurements import problem_of, start_of
from pipelines.adjust.posterior import Posterior, save_posterior
from pipelines.adjust.solution import adjusted, posterior_of
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import ADJUSTMENT, GAUSSIANS, MODEL, SIM3_POSTERIOR, SPARSE, TRAIN_POSTERIOR
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import write_gaussians
from pipelines.splat.initialise import gaussians_of_size
from pipelines.survey.navigation import load_survey
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import Solution, TrainedModel, read_solution
from tests.once import fill_folder
from tests.scenes import (
    GEO_FROM_LOCAL,
    WITH_GCPS,
    Noise,
    TrueScene,
    make_scene,
    sparse_model,
    survey_of,
    trained_cameras,
    trained_model,
    write_workspace,
)

# In `model` the axes are those of geo, and the origin lies elsewhere.
GEO_FROM_MODEL = Similarity(translation=np.array([40.0, -30.0, 60.0]))
NOISE = Noise(pixel_px=0.3)
IMAGES = 8


def load_adjustment(workspace: Workspace) -> Posterior:
    """Return the adjustment of a workspace: that of its training, else that of init-sim3."""
    sfm = read_sparse(workspace.path(SPARSE))
    return posterior_of(workspace, read_solution(workspace), sfm)


def trained_workspace(root: Path) -> tuple[TrueScene, Workspace]:
    """Return a true scene, and a workspace as `train` leaves it; a Gaussian stands at every SfM point."""
    scene = make_scene(images=IMAGES, points=80)
    return scene, Workspace(fill_folder(root, "trained", partial(_write_trained, scene)))


def _write_trained(scene: TrueScene, root: Path) -> None:
    rng = np.random.default_rng(0)
    survey = survey_of(scene, NOISE, WITH_GCPS, rng)
    images = tuple(
        image.model_copy(update={"timestamp_s": 1.7e9 + index}) for index, image in enumerate(survey.images)
    )
    workspace = write_workspace(root, survey.model_copy(update={"images": images}), sparse_model(scene, NOISE, rng))
    model_from_geo = GEO_FROM_MODEL.inverse()
    poses = CameraPoses(np.swapaxes(scene.geo_from_cam, 1, 2), model_from_geo.apply(scene.center_in_geo))
    cameras = trained_cameras(scene.names, poses, test=(2,))
    save_json(trained_model(GEO_FROM_MODEL, model_from_geo @ GEO_FROM_LOCAL, cameras=cameras), root / MODEL)
    means = model_from_geo.apply(scene.point_in_geo)
    write_gaussians(root / GAUSSIANS, gaussians_of_size(means, np.zeros_like(means), np.ones(len(means))))
    write_adjustment(workspace)


def scene_of(model: Solution, sfm: SparseModel) -> SparseScene:
    """Return the scene that a solution belongs to."""
    every = np.arange(len(sfm.image_name))
    return SparseScene(sfm, Similarity.from_record(model.model_from_local), model.similarity, every, every[:0])


def write_adjustment(workspace: Workspace) -> None:
    """Complete a trained model that was made by hand: its measurements, σ and covariances, at its own state."""
    model, sfm = load_json(TrainedModel, workspace.path(MODEL)), read_sparse(workspace.path(SPARSE))
    scene, survey = scene_of(model, sfm), load_survey(workspace)
    problem = problem_of(scene, model.in_use(survey))
    turned = np.swapaxes(scene.poses.cam_from_model, 1, 2) @ model.poses.cam_from_model
    moved = model.poses.cam_center_in_model - scene.poses.cam_center_in_model
    lens = sfm.lenses.change_to(model.with_lenses(sfm).lenses) if model.lenses else start_of(scene, problem).lens
    correction = np.column_stack([-log_so3(turned), moved])
    state = replace(start_of(scene, problem), correction=correction, lens=lens)
    posterior = adjusted(scene, problem, state, model)
    solved = posterior.solution
    update = {
        name: getattr(solved, name) for name in ("measurements", "sigma_px", "sigma_datum_m", "earlier", "accuracy")
    }
    save_json(model.model_copy(update=update), workspace.root / MODEL)
    save_posterior(posterior, workspace.root / TRAIN_POSTERIOR)


def untrained(workspace: Workspace) -> None:
    """Leave the products of a trained model as those of init-sim3, without Gaussians."""
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(
        Solution.model_validate(model.model_dump(include=set(Solution.model_fields))),
        workspace.root / ADJUSTMENT,
    )
    workspace.path(TRAIN_POSTERIOR).rename(workspace.root / SIM3_POSTERIOR)
    shutil.rmtree(workspace.root / "train")


def own_copy(workspace: Workspace, root: Path) -> Workspace:
    """Return a copy with a cache of its own: those of one flight share theirs, which serves one process alone."""
    shutil.copytree(workspace.root, root, symlinks=True)
    (root / "cache").unlink()
    (root / "cache").mkdir()
    return Workspace(root)
