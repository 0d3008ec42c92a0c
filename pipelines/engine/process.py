"""Process of one job: this program again, whose messages become the job's line in the display.

A crash of the process is the end of its job, and of no other. The process stops when its reader is gone
(`georef_cli/sender.py`), so that no job outlives a killed parent for long.
"""

from __future__ import annotations

import json
import logging
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from pipelines.core.messages import MessageReceiver
from pipelines.core.progress import Progress, ProgressTask
from pipelines.core.sentences import duration
from pipelines.engine.job import INTERRUPTED, Job, JobEnd

log = logging.getLogger(__name__)

_TAIL_LINES = 20
_KILLED = "the system killed it, as it does when memory is short: run fewer at a time"


class JobProcess:
    """Running process of a job.

    Args:
        job: the job.
        program: arguments of Python that start this program.
        threads: that the job computes with.
        progress: shows its line.
        ended: gets this object when the process has ended.
    """

    def __init__(
        self, job: Job, program: Sequence[str], threads: int, progress: Progress, ended: queue.Queue[JobProcess]
    ) -> None:
        self.job = job
        self._line = JobLine(progress, job.name)
        self._plain: deque[str] = deque(maxlen=_TAIL_LINES)
        self._ended = ended
        self._started = time.monotonic()
        self._seconds = 0.0
        self._is_interrupted = False
        # A group of its own: Ctrl-C on the terminal reaches the parent alone, which passes it on once.
        self._process = subprocess.Popen(
            [sys.executable, *program, *job.arguments, "--json-progress", "--threads", str(threads)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            **_OWN_GROUP,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def interrupt(self) -> None:
        """Ask the process to save its work and end, as Ctrl-C does."""
        self._is_interrupted = True
        with suppress(OSError):  # It has ended.
            self._process.send_signal(_INTERRUPT)

    def kill(self) -> None:
        """End the process at once, and wait for its end."""
        self._process.kill()
        self._reader.join()

    def end(self) -> JobEnd:
        """Return the end of the process, which has ended."""
        code = self._process.wait()
        if code < 0 and self._is_interrupted:  # before it could handle signals
            code = INTERRUPTED
        return JobEnd(self.job, code, self._seconds, self._line.place, "" if code == 0 else self._error(code))

    def _read(self) -> None:
        receiver = _Receiver(self._line, self.job.name)
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                message = _message(line)
                if message is None or not receiver.take(message):
                    self._plain.append(line.rstrip())
        self._process.wait()
        receiver.close()
        self._seconds = time.monotonic() - self._started
        self._ended.put(self)

    def _error(self, code: int) -> str:
        """Return the message of the process; its last line, below usage or a traceback."""
        said = next((line for line in reversed(self._plain) if line.strip()), "")
        text = said.removeprefix("error: ").removeprefix("Error: ")
        if code < 0:
            ending = _KILLED if code == -_SIGKILL else f"it crashed ({_name(-code)})"
            return f"{ending}: {text}" if text else ending
        return text or f"it ended with exit code {code}"


class JobLine:
    """Progress of a job as one line: its outermost task, with the task inside as its note.

    Attributes:
        place: latest note of the outermost task: the stage that runs.
    """

    def __init__(self, progress: Progress, name: str) -> None:
        self.place = ""
        self._progress, self._name = progress, name
        self._outer: ProgressTask | None = None

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        """Open a task of the job."""
        if self._outer is not None:
            yield _InnerTask(self, name, total)
            return
        with self._progress.task(self._name, total) as outer:
            self._outer = outer
            try:
                yield self
            finally:
                self._outer = None

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Advance the outermost task."""
        self.place = note or self.place
        self.show(steps, self.place)

    def show(self, steps: int, note: str) -> None:
        """Add steps to the line and change its note; the time that a job will still take is not known."""
        if self._outer is not None:
            self._outer.advance(steps, note=note, left_s=math.inf)


class _InnerTask:
    def __init__(self, line: JobLine, name: str, total: int | None) -> None:
        self._line, self._name, self._total = line, name, total
        self._done, self._note = 0, ""

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        """Add steps, and show their count as the note of the line."""
        self._done, self._note = self._done + steps, note.strip() or self._note
        count = f"{self._name} {self._done}" + ("" if self._total is None else f"/{self._total}")
        left = "" if not left_s else f"{duration(left_s)} left"
        place = "" if self._name == self._line.place else self._line.place
        self._line.show(0, " · ".join(filter(None, (place, count, self._note, left))))


class _Receiver(MessageReceiver):
    """Receiver that names the job in its log records, and logs only warnings by default: many jobs say much."""

    def __init__(self, line: JobLine, name: str) -> None:
        super().__init__(line)
        self._name = name

    def log(self, name: str, level: int, text: str) -> None:
        """Log a record of the job."""
        shown = level if level >= logging.WARNING else logging.DEBUG
        log.log(shown, "%s: %s", self._name, text)


def _message(line: str) -> dict[str, Any] | None:
    """Return the message in a line; None for lines of others, as native libraries write them."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) and "kind" in message else None


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


_OWN_GROUP: dict[str, Any]
if sys.platform == "win32":
    _OWN_GROUP = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    _INTERRUPT = signal.CTRL_BREAK_EVENT
    _SIGKILL = 9
else:
    _OWN_GROUP = {"process_group": 0}
    _INTERRUPT = signal.SIGTERM  # SIGINT is ignored by what a shell has started in the background
    _SIGKILL = signal.SIGKILL
