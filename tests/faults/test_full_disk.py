"""Report, blocks and batch on a real disk that is full: one message, nothing half-written, and a second try."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.core import staleness as states
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from tests.cli_runs import Result, finish, start
from tests.killed import GEOREF, ONE_THREAD, PATIENCE_S, assert_same, georef

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mounts a disk in memory"),
]
STAGES = {"report": "report", "blocks": "train", "batch": "train"}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk in memory of 120 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=120m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("this process may not mount a disk: run as root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(disk: Path, left_bytes: int) -> Path:
    """Fill a disk up to some bytes, and return the file that does so."""
    ballast = disk / "ballast"
    with ballast.open("wb") as file:
        file.write(bytes(shutil.disk_usage(disk).free - left_bytes))
    return ballast


@pytest.mark.parametrize(
    ("what", "left_kib"),
    [
        *(("report", left_kib) for left_kib in (0, 600)),
        *(("batch", left_kib) for left_kib in (0, 1500)),
        *(("blocks", left_kib) for left_kib in (150, 3000)),
    ],
)
def test_full_disk(finished: Workspace, disk: Path, tmp_path: Path, what: str, left_kib: int) -> None:
    """The disk has room for parts of the work; what was made before stays as it is."""
    spec = BY_NAME[STAGES[what]]
    workspace = Workspace(disk / "valley/ws")
    shutil.copytree(finished.root, workspace.root)
    shutil.rmtree(workspace.root / spec.folder)
    command = {
        "report": ("report", workspace.root, *ONE_THREAD),
        "blocks": ("train", workspace.root, "--blocks", 2, *ONE_THREAD),
        "batch": ("batch", disk / "valley", "--to", "train", *ONE_THREAD),
    }[what]
    ballast = fill(disk, left_kib << 10)
    failed: Result = finish(start(*command, "-q", code=GEOREF), PATIENCE_S)
    assert failed.code == 1, failed.err
    *of_jobs, last = [line for line in failed.err.splitlines() if line.startswith("error: ")]
    assert len(of_jobs) <= (2 if what == "blocks" else 0), "one message; of blocks, one for each job that ended"
    for line in (*of_jobs, last):
        assert re.search(rf"{disk}\S*: the disk is full", line)
    assert "Traceback" not in failed.err and "workspace or output" not in failed.err
    assert not (workspace.root / spec.folder).exists()
    assert list(disk.rglob("*.tmp")) == []
    states.status(workspace)
    ballast.unlink()
    georef(*command)
    assert next(row.state for row in states.status(workspace) if row.stage == spec.name) == "current"
    if what != "blocks":
        assert_same(workspace.root / spec.folder, finished.root / spec.folder)
