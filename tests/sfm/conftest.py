"""Fixtures for `sfm`."""

from __future__ import annotations

import json

import pytest

from pipelines.core.products import save_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from tests.sfm_scenes import CONFIG, FLIGHT, Photographs, survey_of


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Photographs:
    """Nadir lines over a small town."""
    pytest.importorskip("embreex")
    from pipelines.simulate.stage import simulate

    root = tmp_path_factory.mktemp("simulated") / "survey"
    simulate(FLIGHT, root)
    truth = json.loads((root / "truth.json").read_text())
    return Photographs(root / "images", dict(zip(truth["images"], truth["centers"], strict=True)))


@pytest.fixture(scope="session")
def mapped(photographs: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A workspace whose sfm has run."""
    root = tmp_path_factory.mktemp("flight")
    (root / "photos").symlink_to(photographs.folder)
    save_json(survey_of(photographs.names), root / SURVEY)
    workspace = Workspace(root)
    run_stage(workspace, BY_NAME["sfm"], CONFIG.model_dump(exclude_unset=True))
    return workspace
