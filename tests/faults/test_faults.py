"""Every change that a stage makes to its disk fails once: one message, nothing lost, and the next run completes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core import staleness as states
from pipelines.core.errors import InputError, StorageError
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MODEL
from pipelines.core.workspace import Workspace
from pipelines.geometry.similarity import Similarity
from pipelines.jobs.batch import PlannedMission, run_batch
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.missions import Mission, MissionList
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import simulate
from pipelines.splat.gaussians import write_gaussians
from tests.cli_runs import REPOSITORY, WITH_FAKES
from tests.faults.injection import Disk, Kind, mounted
from tests.photos import write_flight
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of, trained_model, write_workspace
from tests.splat_scenes import RenderedFlight
from tests.tiny_training import true_gaussians

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc"),
]
STATES_OF_A_FIRST_RUN = ("current", "failed", "interrupted", "missing")
DISK = r"the disk|No space left|Input/output"
KINDS: tuple[Kind, ...] = ("full", "failing")


Flags = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """Stage in a workspace that has all its inputs, with the options to run it with."""

    workspace: Workspace
    stage: str
    flags: Flags

    def run(self) -> None:
        """Run the stage, also if its product is current."""
        run_stage(self.workspace, BY_NAME[self.stage], self.flags, force=True)

    @property
    def state(self) -> str:
        """State of the stage."""
        return next(row.state for row in states.status(self.workspace) if row.stage == self.stage)

    def survives(self, kind: Kind, most: int, *, first: bool = False) -> None:
        """Let changes of the stage fail one after the other, at most so many of them, and complete it each time.

        Args:
            kind: of the fault.
            most: number of faults, spread evenly over all changes.
            first: whether no product is there when the fault strikes.
        """
        folder = self.workspace.root / BY_NAME[self.stage].folder
        self.run()
        with Disk(self.workspace.root).mounted() as disk:
            self.run()
        count = len(disk.changes)
        assert count > 8
        for at in np.unique(np.linspace(1, count, min(count, most)).astype(int)).tolist():
            if first:
                shutil.rmtree(folder)
            fault = Disk(self.workspace.root, kind, at)
            try:
                with fault.mounted():
                    self.run()
            except (StorageError, InputError) as error:
                assert re.search(DISK, str(error)) and str(self.workspace.root) in str(error)
                assert "\n" not in str(error)
            moment = fault.changes[min(at, len(fault.changes)) - 1]
            assert self.state in (STATES_OF_A_FIRST_RUN if first else ("current",)), moment
            self.run()
            assert self.state == "current", moment
            left = [path.name for path in self.workspace.root.iterdir() if path.suffix in (".partial", ".old")]
            assert left == [], moment


@pytest.mark.parametrize("first", [True, False], ids=["first", "again"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stage", ["ingest", "train"])
def test_every_change_of_the_runner(
    workspace: Workspace, photos: Path, fake_stages: None, kind: Kind, stage: str, first: bool
) -> None:
    for spec in BY_NAME.values():
        run_stage(workspace, spec, {"images": photos} if spec.name == "ingest" else {})
    trial = Trial(workspace, stage, {"images": photos} if stage == "ingest" else {})
    trial.survives(kind, most=100, first=first)


@pytest.fixture
def solved(tmp_path: Path) -> Workspace:
    """A survey and an SfM model put there by hand, and all that follows up to the initial similarity."""
    rng = np.random.default_rng(4)
    scene = make_scene()
    survey = survey_of(scene, Noise(), Measured(), rng)
    workspace = write_workspace(tmp_path / "ws", survey, sparse_model(scene, Noise(), rng))
    save_json(trained_model(Similarity()), workspace.root / MODEL)
    write_gaussians(workspace.root / GAUSSIANS, true_gaussians(50))
    run_stage(workspace, BY_NAME["geolocate"], {})
    return workspace


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stage", ["geolocate", "init-sim3", "calibrate", "export-ply"])
def test_changes_of_a_stage(solved: Workspace, kind: Kind, stage: str) -> None:
    Trial(solved, stage, {}).survives(kind, most=10)


@pytest.mark.parametrize("kind", KINDS)
def test_changes_of_ingest(tmp_path: Path, kind: Kind) -> None:
    write_flight(tmp_path / "photos", 4)
    flags = {"images": tmp_path / "photos", "copy_images": True}
    Trial(Workspace(tmp_path / "ws"), "ingest", flags).survives(kind, most=10)


def test_changes_of_training_and_evaluation(flights: list[RenderedFlight], one_thread: None) -> None:
    workspace = flights[0].workspace("disk")
    short = {"iterations": 2, "sh_degree": 0, "dense": False, "log_every": 1, "checkpoint_every": 1}
    Trial(workspace, "train", short).survives("full", most=4)
    Trial(workspace, "evaluate", {"renders": 1}).survives("failing", most=2)


@pytest.mark.parametrize("kind", KINDS)
def test_changes_of_the_table_of_a_batch(tmp_path: Path, kind: Kind) -> None:
    """The first table is written before any mission begins; a later one that cannot be written stops none."""
    mission = Mission("north", Workspace(tmp_path / "north"), "north")
    listed = MissionList("valley", tmp_path, (mission,))
    with Disk(tmp_path).mounted() as disk:
        run_batch(listed, [PlannedMission(mission, {})], InstantEngine(), SILENT)
    begun = len(disk.changes) // 3  # of the tables at the beginning, after the mission, and at the end
    for at in (1, begun + 1, 2 * begun + 1):
        engine, told = InstantEngine(), ""
        try:
            with Disk(tmp_path, kind, at).mounted():
                run_batch(listed, [PlannedMission(mission, {})], engine, SILENT)
        except StorageError as error:
            told = str(error)
        assert engine.ended == (at > 1)
        assert str(tmp_path) in told or (kind == "failing" and at == begun + 1), "the last table is whole again"
        assert list(tmp_path.glob("*.tmp")) == []


class InstantEngine:
    """Engine whose jobs end at once."""

    ended = 0

    def together(self, jobs: Sequence[Job]) -> int:
        return len(jobs)

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        for job in jobs:
            self.ended += 1
            ended(JobEnd(job, 0, 1.0, "", ""))


def test_changes_of_the_simulator(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    options = SimulateOptions(images=3, size="64x48", samples="1", targets=0, control=0, threads=1)
    folder = tmp_path / "survey"
    simulate(options, folder)
    before = _content(folder)
    with Disk(tmp_path).mounted() as disk:
        simulate(options, folder, overwrite=True)
    for at in (len(disk.changes) // 2, len(disk.changes) - 1):
        with suppress(OSError, InputError), Disk(tmp_path, "failing", at).mounted():
            simulate(options, folder, overwrite=True)
        assert _content(folder) == before


def _content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def georef(*arguments: object, code: str = "from georef_cli.main import main; main()") -> tuple[int, list[str]]:
    """Run the command line; returns exit code and lines of stderr."""
    command = [sys.executable, "-c", code, "-q", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment, timeout=120)
    return done.returncode, done.stderr.splitlines()


def test_full_disk_under_colmap(tmp_path: Path) -> None:
    """COLMAP aborts its process when its database is full; the user reads one line."""
    pytest.importorskip("embreex")
    photos = tmp_path / "survey"
    layout = {"flight": "grid", "heights": (60.0,), "radius": 10.0, "targets": 0, "control": 0}
    simulate(SimulateOptions(images=6, size="200x150", samples="1", threads=1, **layout), photos)
    disk = tmp_path / "disk"
    with mounted(disk, "600k"):
        command = ("run", disk / "ws", "--images", photos / "images", "--to", "sfm")
        code, lines = georef(*command)
        assert (code, lines[-1:]) == (1, [f"error: {disk / 'ws/sfm.partial'}: the disk is full."])
        assert not [line for line in lines if not line.startswith(("error: ", "warning: "))], lines
        assert states.status(Workspace(disk / "ws"))[1].state in ("failed", "interrupted")
        subprocess.run(["mount", "-o", "remount,size=60m", str(disk)], check=True)
        assert georef("run", disk / "ws", "--to", "sfm")[0] == 0


def test_read_only_workspace(tmp_path: Path, photos: Path) -> None:
    disk = tmp_path / "disk"
    with mounted(disk, "2m"):
        assert georef("run", disk / "ws", "--images", photos, code=WITH_FAKES)[0] == 0
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        assert georef("status", disk / "ws") == (0, [])
        code, lines = georef("run", disk / "ws", "--force", code=WITH_FAKES)
        assert (code, lines) == (
            1,
            [f"error: {disk / 'ws'}: cannot be used as a workspace: Read-only file system."],
        )
