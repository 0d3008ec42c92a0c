"""How long work tells its progress, without knowing who listens.

Library code opens a task and advances it; the command line supplies a `Progress` that draws a bar or
prints lines. The default says nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class ProgressTask(Protocol):
    """One bar: so many steps of a known (or unknown) total."""

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Count `steps` more; `note` is shown behind the bar (`psnr 23.1 dB`)."""


class Progress(Protocol):
    """A place to open tasks."""

    def task(self, name: str, total: int | None = None) -> AbstractContextManager[ProgressTask]:
        """Open a task that is closed when the context ends."""


class _SilentTask:
    def advance(self, steps: int = 1, note: str = "") -> None:
        """Say nothing."""


class SilentProgress:
    """Progress for library use and tests: says nothing."""

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task that nobody watches."""
        yield _SilentTask()


SILENT = SilentProgress()
