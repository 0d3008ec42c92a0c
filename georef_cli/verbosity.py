"""Verbosity of the program, the form of its log lines, and its messages for programs (`--json-progress`)."""

import logging
import signal
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any, TextIO

from pipelines.core.child import MessageSender
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

    def formatException(self, ei: Any) -> str:
        return printable_lines(super().formatException(ei))


class LineFormatter(SafeFormatter):
    """Formatter of log lines: `message`, or `warning: message`."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno == logging.INFO else f"{record.levelname.lower()}: {text}"


class StderrSender(MessageSender):
    """Sender that interrupts its process when its reader is gone, as Ctrl-C does: nobody waits for the result."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._has_reader = True

    def send(self, kind: str, **content: Any) -> None:
        if not self._has_reader:
            return
        try:
            super().send(kind, **content)
        except OSError:
            self._has_reader = False
            signal.raise_signal(signal.SIGTERM)


@cache
def stderr_sender() -> StderrSender:
    """Return the sender on stderr, always the same: the lines of threads must not mix."""
    return StderrSender(sys.stderr)
