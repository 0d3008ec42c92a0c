"""Real stages, ended at any moment: what is left must be a workspace that `georef run` completes.

One workspace is led through all kills, so that the whole costs about two pipelines and the imports between them.
"""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pipelines.core import staleness as states
from pipelines.core.products import load_json
from pipelines.core.stages import PIPELINE, SPLAT, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.splat.gaussians import read_gaussians
from pipelines.survey.survey import Survey
from pipelines.train.trainer import load_checkpoint
from tests.cli_runs import Result, finish, start
from tests.killed import GEOREF, PATIENCE_S, asked, georef

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="no process can be sent SIGTERM or SIGKILL"),
]

# The process ends itself by SIGKILL just ahead of a system call: `mkdir <workspace>/sfm.partial`.
ENDING_ITSELF = """
import os, signal, sys
moment = sys.argv.pop(1)
def kill_at(event, arguments):
    if event in ("open", "os.mkdir", "os.rename", "os.remove") and moment in f"{event} {arguments[0]}":
        os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(kill_at)
from georef_cli.main import main
main()
"""
# Moments in native code, which tells nobody where it is: the kill comes from outside, a moment after a file has
# appeared. Of the changes to the disk there is one: all are tried in tests/core and tests/faults. Each run goes on
# from where the last was killed.
MOMENTS: tuple[tuple[str, float | None], ...] = (
    ("sfm.partial/database.db", 0.1),  # features
    ("sfm.partial/pairs.txt", 0.0),  # matches are there, and not verified
    ("sfm.partial/mapping", 0.02),  # mapping
    ("train.partial/metrics.jsonl", 0.0),  # iterations
    ("os.rename {ws}/train.partial/checkpoint.tmp", None),
)
STOPS = (
    ("sfm.partial/mapping", signal.SIGINT),
    ("train.partial/metrics.jsonl", signal.SIGTERM),
    ("train.partial/metrics.jsonl", signal.SIGINT),  # when it has grown: some iterations later
)
NOISE_OF_LIBRARIES = ("Traceback", "***", "@ ", "terminate called", "Aborted", "Segmentation")


@pytest.fixture(scope="session")
def whole(survey: Path) -> Workspace:
    """A workspace that nobody disturbed."""
    workspace = Workspace(survey.parent / "whole")
    georef("run", workspace.root, *asked(survey))
    return workspace


def test_killed_at_every_stage_and_completed(survey: Path, whole: Workspace) -> None:
    workspace = Workspace(survey.parent / "killed")
    arguments = asked(survey)
    for moment, delay_s in MOMENTS:
        if delay_s is None:
            code = ENDING_ITSELF
            process = start(moment.format(ws=workspace.root), "run", workspace.root, *arguments, code=code)
        else:
            process = start("run", workspace.root, *arguments, code=GEOREF)
            _wait_for(process, workspace, moment)
            time.sleep(delay_s)
            process.kill()
        ended = _finish(process)
        assert ended.code == -signal.SIGKILL, f"{moment}: {ended.err}"
        states.status(workspace)  # whoever looks sees no half-written file
        if (workspace.root / "requests.json").exists():
            arguments = ()  # from here on the workspace knows what was asked for
    _assert_completes(workspace, whole, arguments)


def test_stopped_by_the_user_and_resumed(survey: Path, whole: Workspace) -> None:
    workspace = Workspace(survey.parent / "stopped")
    command: tuple[object, ...] = ("run", workspace.root, *asked(survey)[:-1], "100")
    for watched, number in STOPS:
        process = start(*command, code=GEOREF)
        _wait_for(process, workspace, watched)
        process.send_signal(number)
        sent = time.monotonic()
        ended = _finish(process)
        assert time.monotonic() - sent < 60  # a few photographs, pairs or iterations, also on a busy machine
        ended.assert_failed(130)
        assert ended.err.splitlines()[-1] == "interrupted. What is done is kept: the same command continues."
        assert not [word for word in NOISE_OF_LIBRARIES if word in ended.err]
        command = ("run", workspace.root)
    assert "100; the same command continues" in ended.err
    checkpoint = load_checkpoint(workspace.root / "train.partial/checkpoint.npz")
    resumed = _finish(start("train", workspace.root, "--resume", code=GEOREF))
    assert resumed.code == 0
    assert f"resumed at iteration {int(checkpoint['iteration'])}\n" in resumed.err
    rows = (workspace.root / "train/metrics.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(row)["iteration"] for row in rows] == list(range(10, 101, 10))


def test_sixteen_kills_at_random(survey: Path, whole: Workspace) -> None:
    workspace = Workspace(survey.parent / "soak")
    rng = np.random.default_rng(7)
    for kill in range(16):
        force = ("--force",) if kill % 5 == 4 else ()
        process = start("run", workspace.root, *asked(survey), *force, code=GEOREF)
        try:
            process.wait(timeout=float(rng.uniform(0.3, 7.0)))
        except subprocess.TimeoutExpired:
            process.kill()
        assert _finish(process).code in (-signal.SIGKILL, 0)
        if workspace.root.is_dir():  # a slow machine may not have come that far
            states.status(workspace)
    _assert_completes(workspace, whole, asked(survey))


def _finish(process: subprocess.Popen[str]) -> Result:
    return finish(process, PATIENCE_S)


def _wait_for(process: subprocess.Popen[str], workspace: Workspace, pattern: str) -> None:
    """Wait until a new file has appeared in the workspace, one has grown, or a folder was made anew."""
    before = _changes(workspace, pattern)
    deadline = time.monotonic() + 240
    while process.poll() is None and all(
        changed <= before.get(path, -1) for path, changed in _changes(workspace, pattern).items()
    ):
        assert time.monotonic() < deadline
        time.sleep(0.002)


def _changes(workspace: Workspace, pattern: str) -> dict[Path, int]:
    changes = {}
    for path in workspace.root.glob(pattern):
        with contextlib.suppress(FileNotFoundError):
            stat = path.stat()
            changes[path] = stat.st_mtime_ns if path.is_dir() else stat.st_size
    return changes


def _assert_completes(workspace: Workspace, whole: Workspace, arguments: tuple[str, ...]) -> None:
    """`georef run` ends well, and leaves what an undisturbed run leaves: no more, no less, and all of it whole."""
    done = _finish(start("run", workspace.root, *arguments, "--json", code=GEOREF))
    assert done.code == 0, done.err
    assert [row["stage"] for row in done.document["stages"]] == [spec.name for spec in PIPELINE]
    assert [row.state for row in states.status(workspace)] == ["current"] * len(PIPELINE)
    assert _files(workspace) == _files(whole)
    assert load_json(Survey, workspace.path(SURVEY)) == load_json(Survey, whole.path(SURVEY))
    assert len(read_gaussians(workspace.path(SPLAT))) > 0
    assert load_json(GeorefSidecar, sidecar_path(workspace.path(SPLAT))).scale == 1.0
    reports = [json.loads((w.root / "evaluate/report.json").read_text("utf-8")) for w in (workspace, whole)]
    assert [report["checkpoints"]["triangulated"]["count"] for report in reports] == [8, 8]
    # Two runs with other matches and views differ by what 40 iterations leave open, not by a broken half.
    psnr = [report["photometric"]["test"]["psnr"] for report in reports]
    assert psnr[0] == pytest.approx(psnr[1], abs=1.5)


def _files(workspace: Workspace) -> set[str]:
    """Every file but logs and what can be made again; drafts and half folders would show up here."""
    everything = (path.relative_to(workspace.root) for path in workspace.root.rglob("*") if path.is_file())
    return {path.as_posix() for path in everything if path.parts[0] not in ("logs", "cache")}
