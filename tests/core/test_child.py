"""Child processes for native code: results, errors, crashes, and an end with the parent."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipelines.core.child import run_in_child
from pipelines.core.errors import CrashError, DegenerateGeometryError, InputError
from pipelines.core.progress import ProgressTask
from tests.cli_runs import REPOSITORY
from tests.refusals import refused

TASK = "tests.core.child_tasks:work"
posix_only = pytest.mark.skipif(sys.platform == "win32", reason="no process can be sent SIGINT or SIGKILL")


class Recorded:
    """Progress that keeps what it was told."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, int, str]] = []

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        recorded = self

        class Task:
            def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
                recorded.steps.append((name, steps, note))

        yield Task()


def test_result_progress_and_log_come_through(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture
) -> None:
    progress = Recorded()
    assert run_in_child(TASK, {"do": "add", "numbers": [1, 2, 4]}, "", progress) == 7
    assert progress.steps == [("adding", 2, "done")]
    assert ("pipelines.sum", logging.WARNING, "carry 1") in caplog.record_tuples
    assert capfd.readouterr() == ("", "")


def test_errors_come_through() -> None:
    with refused("points-on-a-line", DegenerateGeometryError) as error:
        run_in_child(TASK, {"do": "refuse"}, "")
    assert str(error.value) == "The points lie on a line."
    with refused("folder-missing", InputError) as error:
        run_in_child(TASK, {"do": "refuse a file"}, "")
    assert (error.value.path, error.value.line, error.value.message) == (Path("a.csv"), 3, "There is none.")
    with pytest.raises(RuntimeError, match=r"(?s)child_tasks\.py.*ZeroDivisionError: a defect"):
        run_in_child(TASK, {"do": "defect"}, "")


@posix_only
def test_crash_is_one_error_that_names_the_cause(capfd: pytest.CaptureFixture[str]) -> None:
    with refused("library-crashed", CrashError) as error:
        run_in_child(TASK, {"do": "abort"}, "Try x.")
    assert "(SIGABRT: Check failed: points > 3)" in str(error.value)
    assert str(error.value).endswith(" Try x.")
    assert capfd.readouterr() == ("", "")


@posix_only
def test_interrupt_ends_a_child_that_hears_no_signals(tmp_path: Path) -> None:
    pid = tmp_path / "pid"

    def interrupt() -> None:
        _wait_for(pid)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_in_child(TASK, {"do": "hang", "pid": str(pid)}, "")
    assert time.monotonic() - started < 30
    assert not _runs(int(pid.read_text("ascii")))


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child ends when its native call returns")
def test_child_ends_with_its_parent(tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    arguments = {"do": "hang", "pid": str(pid)}
    code = f"from pipelines.core.child import run_in_child; run_in_child({TASK!r}, {arguments!r}, '')"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen([sys.executable, "-c", code], env=environment) as parent:
        _wait_for(pid)
        parent.kill()
    deadline = time.monotonic() + 10
    while _runs(int(pid.read_text("ascii"))):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _wait_for(file: Path) -> None:
    deadline = time.monotonic() + 60
    while not (file.exists() and file.read_text("ascii")):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False
