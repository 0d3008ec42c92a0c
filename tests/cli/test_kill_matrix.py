"""Training, blocks, batch and every deliverable, killed at random moments and completed by the same command.

A moment is a part of the time that the stage took undisturbed, counted from the appearance of its partial folder:
two or three for each stage, drawn with `SEED`. With one thread, each product is that of an undisturbed run, but for
times.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pipelines.core import staleness as states
from pipelines.core.manifest import Manifest
from pipelines.core.stages import BY_NAME, DELIVERABLES, StageSpec
from pipelines.core.workspace import Workspace
from tests.killed import ONE_THREAD, assert_same, georef, killed

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="no process can be sent SIGKILL"),
]

SEED = 20
MATRIX = ["train", "evaluate", "export-ply", *(spec.name for spec in DELIVERABLES)]


def manifest_of(workspace: Workspace, spec: StageSpec) -> Manifest:
    manifest = workspace.manifest(spec)
    assert manifest is not None
    return manifest


def moments(name: str) -> Iterator[float]:
    """Three parts of a duration, in order of time."""
    yield from np.sort(np.random.default_rng([SEED, *name.encode()]).uniform(0, 1, 3)).tolist()


def copied(workspace: Workspace, folder: Path) -> Workspace:
    """A copy of the same name, which enters reports."""
    shutil.copytree(workspace.root, folder / workspace.root.name)
    return Workspace(folder / workspace.root.name)


def assert_tidy(workspace: Workspace) -> None:
    assert [row.stage for row in states.status(workspace) if row.state not in ("current", "stale")] == []
    assert [path.name for path in workspace.root.rglob("*") if path.suffix in (".partial", ".old", ".tmp")] == []


@pytest.mark.parametrize("stage", MATRIX)
def test_a_stage(finished: Workspace, tmp_path: Path, stage: str) -> None:
    """Killed twice without an older product, and as soon as it made one anew with --force."""
    workspace, spec = copied(finished, tmp_path), BY_NAME[stage]
    took_s = manifest_of(finished, spec).duration_s
    command = (*spec.command(workspace.root).split()[1:], *ONE_THREAD)
    first, middle, _ = moments(stage)
    kills = 0
    for part, force in ((first, ()), (middle, ()), (0.0, ("--force",))):
        if not force:
            shutil.rmtree(workspace.root / spec.folder)
        kills += killed((*command, *force), workspace.partial(spec).exists, part * took_s)
        states.status(workspace)  # whoever looks sees no half-written file
        georef(*command)
        assert_same(workspace.root / spec.folder, finished.root / spec.folder)
        assert_tidy(workspace)
    assert kills > 0


def test_blocks(finished: Workspace, tmp_path: Path) -> None:
    """Three kills in one training: solution, scaffold, blocks and seams are processes of their own."""
    whole, workspace = (copied(finished, tmp_path / name) for name in ("whole", "killed"))
    spec = BY_NAME["train"]
    for each in (whole, workspace):
        shutil.rmtree(each.root / spec.folder)
    georef("train", whole.root, "--blocks", 2, *ONE_THREAD)
    took_s, command = manifest_of(whole, spec).duration_s, ("train", workspace.root, "--blocks", 2, *ONE_THREAD)
    for number, part in enumerate(moments("blocks")):
        # From the second on, the time that is left counts.
        assert killed(command, workspace.partial(spec).exists, part * took_s / (number + 1)), number
        states.status(workspace)
    georef(*command)
    for folder in ("train", "blocks/scaffold/scaffold", "blocks/0/block", "blocks/1/block", "blocks/seams/seams"):
        assert_same(workspace.root / folder, whole.root / folder)


def test_batch(finished: Workspace, tmp_path: Path) -> None:
    """Three kills in one batch of two missions, which are processes of their own."""
    folder, spec = tmp_path / "valley", BY_NAME["train"]
    missions = [Workspace(folder / name) for name in "ab"]
    for mission in missions:
        shutil.copytree(finished.root, mission.root)
        shutil.rmtree(mission.root / spec.folder)
    command = ("batch", folder, "--to", "train", *ONE_THREAD)
    took_s = manifest_of(finished, spec).duration_s
    for part in moments("batch"):
        killed(command, (folder / "valley.batch.json").exists, 2 + part * took_s)
        for mission in missions:
            states.status(mission)
    done = georef(*command, "--json")
    assert {row["state"] for row in done.document["missions"]} <= {"done", "current"}
    for mission in missions:
        assert_same(mission.root / spec.folder, finished.root / spec.folder)
