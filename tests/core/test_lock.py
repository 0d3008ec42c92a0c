"""The lock of a folder, between processes: one writer, and whoever asks learns who it is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import pytest
from filelock import lock_descriptor, unlock_descriptor

from pipelines.core import lock as locks
from pipelines.core.errors import InputError, WorkspaceBusyError
from pipelines.core.lock import HOLDER, LOCK, WriteLock
from tests.refusals import refused

REPOSITORY = Path(__file__).parents[2]
HOLDING = """
import sys
from pathlib import Path
from pipelines.core.lock import WriteLock
with WriteLock(Path(sys.argv[1])).hold("train"):
    print("holding", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another_process_holding(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the lock until the context ends, or until it is killed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "holding\n"
        yield process
    finally:
        process.communicate("")


def test_writer_in_another_process_is_named(tmp_path: Path) -> None:
    lock = WriteLock(tmp_path)
    with another_process_holding(tmp_path) as holder:
        assert lock.activity() == "train"
        with (
            refused("workspace-busy", WorkspaceBusyError) as error,
            lock.hold("ingest"),
        ):
            pass
        assert f"train in process {holder.pid}" in str(error.value)
        assert lock.activity() == "train"  # whoever was turned away has not put its own name there
    assert lock.activity() is None


def test_killed_writer_leaves_its_name_but_no_lock(tmp_path: Path) -> None:
    with another_process_holding(tmp_path) as holder:
        holder.kill()
        holder.wait(timeout=60)
    assert (tmp_path / HOLDER).read_text(encoding="utf-8") == f"train in process {holder.pid}"
    assert WriteLock(tmp_path).activity() is None
    with WriteLock(tmp_path).hold("ingest"):
        assert WriteLock(tmp_path).activity() == "ingest"


def test_writer_that_asks_does_not_wait_for_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(locks.time, "sleep")
    with WriteLock(tmp_path).hold("train"):
        assert WriteLock(tmp_path).activity() == "train"


def test_error_of_the_writer_ends_its_lock(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), WriteLock(tmp_path).hold("train"):
        raise ZeroDivisionError
    assert WriteLock(tmp_path).activity() is None


def test_asking_makes_no_file(tmp_path: Path) -> None:
    assert WriteLock(tmp_path).activity() is None
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def asked_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A question of somebody else's that holds the lock until we wait, and the name of a killed writer."""
    (tmp_path / HOLDER).write_text("train in process 1", encoding="utf-8")
    with (tmp_path / LOCK).open("wb") as other:
        assert lock_descriptor(other.fileno(), blocking=False)
        monkeypatch.setattr(locks.time, "sleep", lambda _pause_s: unlock_descriptor(other.fileno()))
        yield


@pytest.mark.usefixtures("asked_by_another")
class TestAskedByAnother:
    def test_question_looks_like_no_writer(self, tmp_path: Path) -> None:
        assert WriteLock(tmp_path).activity() is None

    def test_question_turns_no_writer_away(self, tmp_path: Path) -> None:
        with WriteLock(tmp_path).hold("ingest"):
            assert (tmp_path / HOLDER).read_text(encoding="utf-8").startswith("ingest")


def test_folder_that_may_only_be_read_can_be_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    opened = Path.open

    def watch(path: Path, mode: str = "r", **how: str) -> object:
        modes.append(mode)
        return opened(path, mode, **how)

    with WriteLock(tmp_path).hold("train"):
        monkeypatch.setattr(os, "access", lambda _path, _mode: False)
        monkeypatch.setattr(Path, "open", watch)
        assert WriteLock(tmp_path).activity() == "train"
    assert modes[0] == "rb"


@pytest.mark.parametrize("text", [None, b"", b"\xff\xfe"])
def test_unknown_writer(tmp_path: Path, text: bytes | None) -> None:
    """A writer that has not yet written its name, or one of an older version, which writes it elsewhere."""
    with WriteLock(tmp_path).hold("train"):
        (tmp_path / HOLDER).unlink()
        if text is not None:
            (tmp_path / HOLDER).write_bytes(text)
        assert WriteLock(tmp_path).activity() == "another process"
        with refused("workspace-busy", WorkspaceBusyError) as error, WriteLock(tmp_path).hold("sfm"):
            pass
        assert "another process" in str(error.value)


def test_file_system_without_locks_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_handle: BinaryIO, _attempts: int) -> bool:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(locks, "_lock", refuse)
    with refused("workspace-unlockable", InputError) as error, WriteLock(tmp_path).hold("train"):
        pass
    assert "No locks available" in str(error.value)
    assert (tmp_path / LOCK).exists()
    assert not (tmp_path / HOLDER).exists()
