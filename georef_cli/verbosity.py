"""How much the program says, and how a record of its log reads."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from georef_cli.printable import printable, printable_lines


@dataclass(frozen=True)
class Verbosity:
    """How the program talks: the options of the group."""

    verbose: bool = False
    quiet: bool = False
    traceback: bool = False

    @property
    def level(self) -> int:
        """The least severe level that is told on stderr."""
        return logging.DEBUG if self.verbose else logging.WARNING if self.quiet else logging.INFO


class SafeFormatter(logging.Formatter):
    """Records of one line each, but for tracebacks, in which nothing can steer a terminal."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:
        """Return the lines of a traceback."""
        return printable_lines(super().formatException(ei))


class LineFormatter(SafeFormatter):
    """`message`, or `warning: message`."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno == logging.INFO else f"{record.levelname.lower()}: {text}"
