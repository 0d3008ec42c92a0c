"""Progress of long work, and interrupts that wait until its step is done and saved.

Library code opens a task and advances it. The command line supplies a `Progress` that draws a bar or prints lines.
The default is silent.
"""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Protocol


class ProgressTask(Protocol):
    """Task that counts its steps; their total may be unknown."""

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Add `steps` to the count.

        Args:
            note: shown behind the bar (`23.1 dB`).
            left_s: seconds that the rest will take, where steps differ; None: as long a step as those before;
                infinite: not known.
        """


class Progress(Protocol):
    """Display of tasks."""

    def task(self, name: str, total: int | None = None) -> AbstractContextManager[ProgressTask]:
        """Open a task that is closed when the context ends."""


class SilentProgress:
    """Progress without output, for library use and tests; it is its own task."""

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task that shows nothing."""
        yield self

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Do nothing."""


SILENT = SilentProgress()


# Attribute of log records with a caution: for the file alone, since the result of the command ends with it.
AT_END = "at_end"

SIGNALS = [signal.SIGINT, signal.SIGTERM]
if sys.platform == "win32":  # There SIGTERM kills without a handler; another process can send Ctrl-Break instead.
    SIGNALS.append(signal.SIGBREAK)


@dataclass
class StopRequest:
    """Whether the user has requested a stop, by a signal."""

    requested: bool = False


@contextmanager
def deferred_interrupts() -> Iterator[StopRequest]:
    """Hold back `SIGNALS` while the context lasts: the first signal sets `requested`, the second interrupts.

    The loop inside reads `requested` after each step, saves, and raises `KeyboardInterrupt` itself. Only the main
    thread receives signals; in other threads `requested` stays false.

    Raises:
        KeyboardInterrupt: a second signal.
    """
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(_signal: int, _frame: FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True

    previous = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            # None stands for a handler that was not set from Python and cannot be set again from here.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
