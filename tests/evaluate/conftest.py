"""An evaluated survey, and copies of it to change: the adjustment is real, the Gaussians are the true ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import save_posterior
from pipelines.core.products import load_json, save_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import (
    ADJUSTMENT,
    BY_NAME,
    GAUSSIANS,
    MODEL,
    SIM3_POSTERIOR,
    SPARSE,
    SURVEY,
    TRAIN_POSTERIOR,
)
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.splat.gaussians import transformed, write_gaussians
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import Survey
from tests.scenes import write_workspace
from tests.splat_scenes import CAMERA, Rendered, make_rendered, write_photographs


def solve(workspace: Workspace) -> None:
    """Write what `init-sim3` finds for the survey, and a trained model that keeps it."""
    survey, sparse = load_json(Survey, workspace.path(SURVEY)), read_sparse(workspace.path(SPARSE))
    points = geolocate(survey, sparse, GeolocateOptions()).points
    posterior, _ = estimate_similarity(survey, sparse, points, InitSim3Options())
    solution, root = posterior.solution, workspace.root
    save_json(solution, root / ADJUSTMENT)
    save_posterior(posterior, root / SIM3_POSTERIOR)
    settings = {"max_image_size": CAMERA.width, "background": (0.0, 0.0, 0.0), "sh_degree": 0, "backend": "cpu"}
    model = {**solution.model_dump(), **settings, "iterations": 1, "gaussians": 1}
    save_json(TrainedModel.model_validate(model), root / MODEL)
    save_posterior(posterior, root / TRAIN_POSTERIOR)


def solved_workspace(root: Path, rendered: Rendered) -> Workspace:
    """Return a workspace with photographs, adjustment, and the true Gaussians as the trained model."""
    write_photographs(rendered, root / "photos")
    workspace = write_workspace(root, rendered.survey, rendered.sparse)
    solve(workspace)
    model = load_json(TrainedModel, workspace.path(MODEL))
    write_gaussians(root / GAUSSIANS, transformed(rendered.gaussians, model.similarity.inverse()))
    return workspace


@pytest.fixture(scope="session")
def rendered() -> Rendered:
    """The survey and its truth."""
    return make_rendered()


@pytest.fixture(scope="session")
def evaluated(rendered: Rendered, tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, Outcome]:
    """The survey, evaluated with its Gaussians."""
    workspace = solved_workspace(tmp_path_factory.mktemp("evaluated") / "ws", rendered)
    return workspace, run_stage(workspace, BY_NAME["evaluate"], {"renders": 1})


@pytest.fixture
def altered(evaluated: tuple[Workspace, Outcome], tmp_path: Path) -> Workspace:
    """A copy whose survey or model a test may change."""
    root = tmp_path / "copy"
    shutil.copytree(evaluated[0].root, root, symlinks=True, ignore=shutil.ignore_patterns("evaluate"))
    return Workspace(root)


@pytest.fixture
def untrained(altered: Workspace) -> Workspace:
    """A copy as `init-sim3` leaves it."""
    shutil.rmtree(altered.root / "train")
    return altered
