"""Faults of the disk: the n-th change below a folder fails, or a folder is a small disk of its own."""

from __future__ import annotations

import builtins
import errno
import io
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import pytest

Kind = Literal["full", "failing"]
_NEEDS_ROOM = ("open", "write", "mkdir")  # A full disk can still rename, flush and delete.


@dataclass
class Disk:
    """Disk below a folder.

    Attributes:
        folder: of the workspace.
        kind: "full" from the n-th change on; or "failing" with an input/output error at the n-th change alone.
        at: n, counted from 1; 0: no fault.
        changes: what was changed so far: "write …/points.npz".
    """

    folder: Path
    kind: Kind = "full"
    at: int = 0
    changes: list[str] = field(default_factory=list)

    def change(self, action: str, path: Any) -> None:
        """Count a change.

        Raises:
            OSError: the fault.
        """
        if isinstance(path, int):
            path = Path(f"/proc/self/fd/{path}").readlink()
        place = Path(os.fsdecode(path))
        if not place.is_relative_to(self.folder):
            return
        self.changes.append(f"{action} {place.relative_to(self.folder)}")
        count = len(self.changes)
        if self.kind == "full" and self.at and count >= self.at and action in _NEEDS_ROOM:
            raise _error(errno.ENOSPC, action, place)
        if self.kind == "failing" and count == self.at:
            raise _error(errno.EIO, action, place)

    @contextmanager
    def mounted(self) -> Iterator[Disk]:
        """Let changes below the folder go over this disk."""
        real_open = io.open

        def patched_open(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            if isinstance(file, int) or not set(mode) & set("wax"):
                return real_open(file, mode, *args, **kwargs)
            self.change("open", file)
            return _opened(self, os.fspath(file), mode, *args, **kwargs)

        def counted(action: str) -> Any:
            real = getattr(os, action)

            def call(path: Any, *args: Any, **kwargs: Any) -> Any:
                self.change(action, path)
                return real(path, *args, **kwargs)

            return mock.patch.object(os, action, call)

        with (
            mock.patch.object(io, "open", patched_open),
            mock.patch.object(builtins, "open", patched_open),
            counted("mkdir"),
            counted("rename"),
            counted("replace"),
            counted("fsync"),
        ):
            yield self


def _error(number: int, action: str, place: Path) -> OSError:
    """Return the error of the system: that of a write names no file."""
    return OSError(number, os.strerror(number), *(() if action == "write" else (str(place),)))


class _File(io.FileIO):
    """File whose writes are counted."""

    disk: Disk

    def write(self, data: Any) -> int:
        """Write to the disk."""
        self.disk.change("write", self.name)
        return super().write(data)


def _opened(
    disk: Disk, path: str, mode: str, buffering: int = -1, encoding: str | None = None,
    errors: str | None = None, newline: str | None = None,
) -> Any:  # fmt: skip
    raw = _File(path, mode.replace("b", "").replace("t", ""))
    raw.disk = disk
    if buffering == 0:
        return raw
    buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
    return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)


@contextmanager
def mounted(folder: Path, size: str) -> Iterator[None]:
    """Mount a small memory disk, if this process may."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("this process may not mount a disk")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def filled(folder: Path) -> Iterator[None]:
    """Fill the disk of a folder to the last byte while the context lasts."""
    ballast = folder / "ballast"
    try:
        with suppress(OSError), ballast.open("wb", buffering=0) as handle:
            while True:
                handle.write(bytes(4096))
        yield
    finally:
        ballast.unlink()
