"""What the viewer's files have in common: one writer at a time, clear failures, and steps that can be undone.

Several viewers may show one workspace. Each change reads the file again, changes the records that it is about, and
writes the file whole: nothing is lost of what another viewer has saved meanwhile.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pipelines.core.errors import storage_failures
from pipelines.core.lock import WriteLock

FOLDER = "view"  # of the workspace: what the user saves in the viewer
_PATIENCE_S = 5.0  # for another viewer, which holds the folder for the time of one write
_MOST_STEPS = 100


@contextmanager
def changing(folder: Path) -> Iterator[None]:
    """Hold the right to change the viewer's files in a folder.

    Raises:
        WorkspaceBusyError: another process holds it for too long.
        InputError: the folder cannot be made or locked.
        StorageError: the disk is full or fails.
    """
    with storage_failures():
        try:
            with WriteLock(folder).hold("georef view", _PATIENCE_S):
                yield
        except OSError as error:
            error.filename = error.filename or str(folder)
            raise


class History:
    """Steps that can be undone, the last one first."""

    def __init__(self) -> None:
        self._steps: deque[tuple[str, Callable[[], object]]] = deque(maxlen=_MOST_STEPS)

    def add(self, step: str, undo: Callable[[], object]) -> None:
        """Add a step that was taken.

        Args:
            step: in words, for the user.
            undo: undoes it; a step whose undoing fails can be undone again.
        """
        self._steps.append((step, undo))

    def undo(self) -> str | None:
        """Undo the last step and return it in words; None: there is none."""
        if not self._steps:
            return None
        step, undo = self._steps[-1]
        undo()
        self._steps.pop()
        return step
