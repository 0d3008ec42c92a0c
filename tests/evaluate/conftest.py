"""An evaluated survey, and copies of it to change."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from tests.scenes import without_hashes


@pytest.fixture(scope="session")
def evaluated(trained: list[tuple[Workspace, Workspace]]) -> tuple[Workspace, Outcome]:
    """The first survey, trained with the geographic losses and evaluated."""
    workspace = trained[0][0]
    return workspace, run_stage(workspace, BY_NAME["evaluate"], {"renders": 1})


@pytest.fixture
def altered(evaluated: tuple[Workspace, Outcome], tmp_path: Path) -> Workspace:
    """A copy whose survey or model a test may change."""
    root = tmp_path / "copy"
    shutil.copytree(evaluated[0].root, root, symlinks=True, ignore=shutil.ignore_patterns("evaluate"))
    workspace = Workspace(root)
    without_hashes(workspace, BY_NAME["train"])
    return workspace
