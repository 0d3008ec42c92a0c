"""Progress of long work.

Library code opens a task and advances it. The command line supplies a `Progress` that draws a bar or prints lines.
The default is silent.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class ProgressTask(Protocol):
    """Task that counts its steps; their total may be unknown."""

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Add `steps` to the count.

        Args:
            steps: that are done.
            note: shown behind the bar (`23.1 dB`).
            left_s: seconds that the rest will take, where steps differ; None: as long a step as those before;
                infinite: not known.
        """


class Progress(Protocol):
    """Display of tasks."""

    def task(self, name: str, total: int | None = None) -> AbstractContextManager[ProgressTask]:
        """Open a task that is closed when the context ends."""


class _SilentTask:
    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Do nothing."""


class SilentProgress:
    """Progress without output, for library use and tests."""

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task that shows nothing."""
        yield _SilentTask()


SILENT = SilentProgress()
