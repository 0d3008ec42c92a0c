"""Delayed interrupts: a loop ends its step and saves first."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SIGNALS = [signal.SIGINT, signal.SIGTERM]
if sys.platform == "win32":  # There SIGTERM kills without a handler; another process can send Ctrl-Break instead.
    SIGNALS.append(signal.SIGBREAK)


@dataclass
class StopRequest:
    """Flag that a signal sets: whether the user has requested a stop."""

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
