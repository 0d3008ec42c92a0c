"""Lock that admits one writer at a time to a folder.

The operating system holds the lock and drops it when its holder dies: no stale lock remains. The holder's name has
a file of its own, because on Windows no other process can read a locked file.
"""

import contextlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from filelock import lock_descriptor, unlock_descriptor

from pipelines.core.errors import InputError, WorkspaceBusyError
from pipelines.core.validators import require_text

LOCK = ".lock"
HOLDER = ".lock.holder"
# `activity` takes the lock for an instant. That must neither refuse a writer nor be reported as a writer.
_PATIENCE_S, _PAUSE_S = 0.1, 0.05
_IN_PROCESS = " in process "


@dataclass(frozen=True)
class WriteLock:
    """Right to write in a folder, held by at most one process; the folder is made when the lock is first held."""

    folder: Path

    @contextmanager
    def hold(self, activity: str, patience_s: float = _PATIENCE_S) -> Iterator[None]:
        """Hold the lock while the context lasts; other processes are told the activity: the command that writes.

        Args:
            patience_s: so long another process may still hold the lock.

        Raises:
            WorkspaceBusyError: another process holds the lock; names that process and its activity.
            InputError: the folder cannot be made, written or locked.
        """
        require_text(self.folder)
        with self._locked_file(patience_s) as handle:
            try:
                (self.folder / HOLDER).write_text(f"{activity}{_IN_PROCESS}{os.getpid()}", encoding="utf-8")
                yield
            finally:
                unlock_descriptor(handle.fileno())

    def discard(self) -> None:
        """Delete the files of the lock, which this process holds; a process that waits for them makes new ones."""
        for name in (HOLDER, LOCK):
            with contextlib.suppress(OSError):  # Windows deletes no open file.
                (self.folder / name).unlink(missing_ok=True)

    def _locked_file(self, patience_s: float) -> BinaryIO:
        while True:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                handle = (self.folder / LOCK).open("ab")
            except OSError as error:
                message = f"cannot be used as a workspace: {error.strerror}."
                raise InputError("workspace-unusable", message, path=self.folder) from error
            try:
                locked = _lock(handle, patience_s)
            except OSError as error:
                handle.close()
                raise InputError(
                    "workspace-unlockable", f"cannot be locked: {error.strerror}.", path=self.folder
                ) from error
            if locked and self._is_current(handle):
                return handle
            handle.close()
            if not locked:
                message = f"{self.folder} is being written by {self._holder()}."
                remedy = "Wait for it, or stop it."
                raise WorkspaceBusyError("workspace-busy", message, remedy=remedy)

    def _is_current(self, handle: BinaryIO) -> bool:
        """Return whether the open file still has its name: another process may have discarded it."""
        try:
            return os.path.samestat(os.fstat(handle.fileno()), (self.folder / LOCK).stat())
        except OSError:
            return False

    def activity(self) -> str | None:
        """Return the activity of the process that holds the lock now, or None."""
        path = self.folder / LOCK
        try:
            # A network file system locks only a file that is open for writing.
            with path.open("r+b" if os.access(path, os.W_OK) else "rb") as handle:
                # A running stage asks as well, and must not wait for its own lock.
                is_own = self._holder().endswith(f"{_IN_PROCESS}{os.getpid()}")
                if not _lock(handle, 0.0 if is_own else _PATIENCE_S):
                    return self._holder().partition(_IN_PROCESS)[0]
                unlock_descriptor(handle.fileno())
        except OSError:
            pass  # The lock file does not exist or cannot be opened: no process writes.
        return None

    def _holder(self) -> str:
        """Return the holder's activity and process; valid only while the lock is held."""
        try:
            text = (self.folder / HOLDER).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            text = ""
        return text or "another process"


def _lock(handle: BinaryIO, patience_s: float) -> bool:
    """Return whether the open file could be locked in time."""
    end = time.monotonic() + patience_s
    while not lock_descriptor(handle.fileno(), blocking=False):
        if time.monotonic() >= end:
            return False
        time.sleep(_PAUSE_S)
    return True
