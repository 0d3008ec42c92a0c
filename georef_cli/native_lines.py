"""Lines that libraries write to standard error by themselves, as records of the log.

OpenCV, libtiff, libpng, GDAL, glog and OpenMP write to file descriptor 2 and know no `sys.stderr`. That descriptor
becomes a pipe whose lines are logged, and standard error belongs to this program alone: with `--json-progress` each
of its lines is JSON, whatever a library says.
"""

import io
import logging
import os
import secrets
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from pipelines.core.child import MessageSender

_STDERR = 2
_MOST_OF_A_LINE = 300
_MOST_LINES = 1000  # of a process: thousands of photographs bring forth the same warning each
_PATIENCE_S = 1.0  # a process that this one has started may keep the pipe open

log = logging.getLogger(__name__)


class _Reader(threading.Thread):
    """Thread that logs the lines of a pipe until nobody can write into it."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(daemon=True)
        self._descriptor = descriptor
        self._mark = secrets.token_hex(16)
        self._marked = threading.Event()

    def run(self) -> None:
        count = 0
        with os.fdopen(self._descriptor, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if line.strip() == self._mark:
                    self._marked.set()
                    continue
                count += bool(line.strip())
                if line.strip() and count <= _MOST_LINES:
                    log.debug("a library wrote: %s", line.strip()[:_MOST_OF_A_LINE])
                if count == _MOST_LINES:
                    log.debug("further lines of libraries are not logged")

    def catch_up(self) -> None:
        """Wait until all lines written so far are logged: a mark behind them has been read."""
        self._marked.clear()
        with suppress(OSError):
            os.write(_STDERR, f"\n{self._mark}\n".encode())
            self._marked.wait(_PATIENCE_S)


_readers: list[_Reader] = []  # one while the context lasts


@contextmanager
def native_lines_logged() -> Iterator[None]:
    """Log what native code writes to file descriptor 2, at DEBUG: seen with `--verbose` and in the stages' logs.

    `sys.stderr` becomes a stream of its own to where descriptor 2 has led. Python's warnings become records, too. A
    process without that descriptor, or whose `sys.stderr` is replaced already, stays as it is.
    """
    before = sys.__stderr__
    if before is None or sys.stderr is not before or not _leads_to_stderr(before):
        yield
        return
    before.flush()
    kept = os.dup(_STDERR)
    reading, writing = os.pipe()
    os.dup2(writing, _STDERR)
    os.close(writing)
    log.setLevel(logging.DEBUG)  # The logs of the stages have these lines without --verbose too.
    reader = _Reader(reading)
    reader.start()
    _readers.append(reader)
    logging.captureWarnings(True)
    sys.stderr = os.fdopen(kept, "w", encoding=before.encoding, errors=before.errors, buffering=1)
    try:
        yield
    finally:
        _readers.remove(reader)
        # What native code writes while the process ends is dropped: nobody reads it any more.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, _STDERR)
        os.close(nowhere)
        reader.join(_PATIENCE_S)


def native_lines_caught_up() -> None:
    """Wait until what native code has written so far is logged, so that a stage's log has its lines."""
    for reader in _readers:
        reader.catch_up()


def _leads_to_stderr(stream: TextIO) -> bool:
    try:
        os.fstat(_STDERR)
        return stream.fileno() == _STDERR
    except (OSError, ValueError):
        return False


class SentLines(io.TextIOBase):
    """Text stream whose lines are sent as records of the log: for what Python itself writes to `sys.stderr`."""

    def __init__(self, sender: MessageSender) -> None:
        self._sender, self._line = sender, ""

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        for line in filter(str.strip, lines):
            with suppress(OSError):
                self._sender.send("log", name=__name__, level=logging.WARNING, text=line)
        return len(text)
