"""Interrupts at a time of one's own choosing: a loop ends its step and saves before it stops; a library that never
looks up is left to itself."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import TypeVar

ResultT = TypeVar("ResultT")
SIGNALS = [signal.SIGINT, signal.SIGTERM]
if sys.platform == "win32":  # where SIGTERM ends a process unheard, Ctrl-Break is what another process can send
    SIGNALS.append(signal.SIGBREAK)
_LOOK_UP_S = 0.2


@dataclass
class StopRequest:
    """Whether the user has asked to stop."""

    requested: bool = False


@contextmanager
def deferred_interrupts() -> Iterator[StopRequest]:
    """Hold back `SIGNALS` while the context lasts: the first sets `requested`, a second one interrupts.

    The loop inside looks at `requested` after each step, saves, and raises `KeyboardInterrupt` itself. Only the
    main thread receives signals; in any other the request stays unset.
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


def interruptible(work: Callable[[], ResultT]) -> ResultT:
    """The result of long work in a library that lets go of Python but hears no signals.

    It runs in a thread of its own, so that `SIGNALS` interrupt the wait for it; the thread then goes on until the
    process ends, which it does not hold up.
    """
    results: list[ResultT] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # raised again where it is awaited
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_LOOK_UP_S)
    if errors:
        raise errors[0]
    return results[0]
