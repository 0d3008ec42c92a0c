"""Verbosity of the program, and the form of its log lines."""

from __future__ import annotations

import logging
from dataclasses import dataclass


@dataclass(frozen=True)
class Verbosity:
    """Verbosity of the program: the options of the group.

    Attributes:
        verbose: show messages for debugging too.
        quiet: show warnings and errors only.
        traceback: show the traceback of an error.
    """

    verbose: bool = False
    quiet: bool = False
    traceback: bool = False

    @property
    def level(self) -> int:
        """Least severe level that is shown on stderr."""
        return logging.DEBUG if self.verbose else logging.WARNING if self.quiet else logging.INFO


class LineFormatter(logging.Formatter):
    """Formatter of log lines: `message`, or `warning: message`."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno == logging.INFO else f"{record.levelname.lower()}: {text}"
