"""Verbosity of the program, the form of its log lines, and its messages for programs (`--json-progress`)."""

import logging
import os
import select
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from types import TracebackType
from typing import TextIO

from pipelines.core.child import ORPHAN_S, MessageSender
from pipelines.core.json_values import JsonValue
from pipelines.core.sentences import printable, printable_lines


@dataclass(frozen=True)
class Verbosity:
    """Verbosity of the program: the options of the group and of the command together."""

    verbose: bool = False
    quiet: bool = False
    traceback: bool = False
    json_progress: bool = False

    @property
    def level(self) -> int:
        return logging.DEBUG if self.verbose else logging.WARNING if self.quiet else logging.INFO


class SafeFormatter(logging.Formatter):
    """Formatter of records in one line each, but for tracebacks; nothing in them can steer a terminal."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))

    def formatException(
        self, ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
    ) -> str:
        return printable_lines(super().formatException(ei))


class LineFormatter(SafeFormatter):
    """Formatter of log lines: `message`, or `warning: message`."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno == logging.INFO else f"{record.levelname.lower()}: {text}"


class StderrSender(MessageSender):
    """Sender that interrupts its process when its reader is gone, as Ctrl-C does: nobody waits for the result.

    The process ends soon, whatever it does: it may hold the lock of a folder, which the command that was killed
    needs when it is given again.
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._has_reader = True
        if sys.platform != "win32":  # has no poll
            with suppress(OSError, ValueError):  # a stream without a descriptor
                threading.Thread(target=_end_without_reader, args=(stream.fileno(),), daemon=True).start()

    def send(self, kind: str, **content: JsonValue) -> None:
        if not self._has_reader:
            return
        try:
            super().send(kind, **content)
        except OSError:
            self._has_reader = False
            if sys.platform == "win32":
                signal.raise_signal(signal.SIGTERM)


def _end_without_reader(descriptor: int) -> None:
    """Wait until a pipe has lost its reader, and end this process; of what is no pipe, wait for ever."""
    watched = select.poll()
    watched.register(descriptor, 0)  # errors are always told
    if any(event & (select.POLLERR | select.POLLHUP) for _, event in watched.poll()):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.8 * ORPHAN_S)
        os._exit(1)


@cache
def stderr_sender() -> StderrSender:
    """Return the sender on stderr, always the same: the lines of threads must not mix."""
    return StderrSender(sys.stderr)
