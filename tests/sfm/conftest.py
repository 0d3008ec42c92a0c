"""Fixtures for `sfm`."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from pipelines.core.products import save_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from tests.once import make_once
from tests.sfm_scenes import CONFIG, FLIGHT, Photographs, survey_of


@pytest.fixture(scope="session")
def photographs(between_processes: Path) -> Photographs:
    """Nadir lines over a small town."""
    pytest.importorskip("embreex")
    from pipelines.simulate.stage import simulate

    root = between_processes / "nadir_lines"
    make_once({root: partial(simulate, FLIGHT)})
    truth = json.loads((root / "truth.json").read_text())
    return Photographs(root / "images", dict(zip(truth["images"], truth["centers"], strict=True)))


@pytest.fixture(scope="session")
def mapped(photographs: Photographs, between_processes: Path) -> Workspace:
    """A workspace whose sfm has run, which nobody changes."""

    def make(root: Path) -> None:
        root.mkdir()
        (root / "photos").symlink_to(photographs.folder)
        save_json(survey_of(photographs.names), root / SURVEY)
        run_stage(Workspace(root), BY_NAME["sfm"], CONFIG.model_dump(exclude_unset=True))

    root = between_processes / "mapped"
    make_once({root: make})
    return Workspace(root)
