"""The command line as a process: exit codes, signals, pipes, and what `--help` imports."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli_runs import REPOSITORY, finish, start

SLEEPING = """
import time
from tests import fakes
def sleep(stage, options):
    (stage.out / "begun").write_text("")
    time.sleep(60)
fakes.install(train=sleep)
from georef_cli.main import main
main()
"""
BROKEN = """
from tests import fakes
def run(stage, options):
    raise ZeroDivisionError("a defect")
fakes.install(ingest=run)
from georef_cli.main import main
main()
"""
FULL_DISK = BROKEN.replace('ZeroDivisionError("a defect")', 'OSError(28, "No space left on device", "points.npz")')
HELP = """
import sys
from georef_cli.main import main
try:
    main(["--help"])
finally:
    heavy = {"pydantic", "numpy", "torch", "rich", "pycolmap", "numba", "scipy", "cv2"} & set(sys.modules)
    print(sorted(heavy), file=sys.stderr)
"""


def test_help_imports_nothing_heavy() -> None:
    result = finish(start(code=HELP))
    assert result.code == 0
    assert "export-ply" in result.out
    assert result.err == "[]\n"


def test_piped_output_is_the_result_alone(tmp_path: Path, photos: Path) -> None:
    result = finish(start("ingest", tmp_path / "flight", "--images", photos, "--json"))
    assert result.code == 0
    assert json.loads(result.out)["stage"] == "ingest"
    assert "\x1b" not in result.out + result.err


def test_usage_is_2() -> None:
    result = finish(start("status"))
    result.assert_failed(2)
    assert "Missing argument 'WS'" in result.err


def test_unknown_error_keeps_its_traceback(tmp_path: Path, photos: Path) -> None:
    result = finish(start("ingest", tmp_path / "flight", "--images", photos, code=BROKEN))
    result.assert_failed(1)
    assert "Traceback" in result.err
    assert "ZeroDivisionError: a defect" in result.err
    assert "ZeroDivisionError: a defect" in (tmp_path / "flight/logs/ingest.log").read_text()


def test_full_disk_is_a_message(tmp_path: Path, photos: Path) -> None:
    result = finish(start("ingest", tmp_path / "flight", "--images", photos, code=FULL_DISK))
    assert result.code == 1
    assert result.err.splitlines()[-1] == "error: points.npz: the disk is full."
    assert "Traceback" not in result.err


def test_reader_that_has_enough(tmp_path: Path, photos: Path) -> None:
    assert finish(start("ingest", tmp_path / "flight", "--images", photos)).code == 0
    process = start("status", tmp_path / "flight")
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert process.stderr.read() == ""
    assert process.wait(timeout=60) == 1


def test_signs_that_stdout_lacks_are_escaped() -> None:
    """As a pipe on Windows, which has no ≥ and no σ."""
    code = "from georef_cli.main import main; main(['train', '--help'])"
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, check=True, capture_output=True, env=environment, cwd=REPOSITORY)
    assert run.stderr == b""
    assert rb"[\u2265 1]" in run.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no process can be sent these")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_ended_from_outside_and_completed_after(tmp_path: Path, photos: Path, name: str) -> None:
    workspace, number = tmp_path / "flight", signal.Signals[name]
    process = start("run", workspace, "--images", photos, code=SLEEPING)
    deadline = time.monotonic() + 60
    while not (workspace / "train.partial/begun").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    busy = finish(start("sfm", workspace))
    assert busy.code == 1
    assert f"train in process {process.pid}" in busy.err.splitlines()[-1]
    process.send_signal(number)
    ended = finish(process)
    assert ended.out == ""
    assert ended.code == (-number if name == "SIGKILL" else 130)
    assert "Traceback" not in ended.err
    again = finish(start("run", workspace, "--json"))
    assert again.code == 0
    ran = [row["stage"] for row in json.loads(again.out)["stages"] if row["ran"]]
    assert ran == ["train", "evaluate", "export-ply"]
