"""Display of one job: the messages of its process as one line of the progress, and as records of the log."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager

from pipelines.core.messages import MessageReceiver
from pipelines.core.progress import Progress, ProgressTask
from pipelines.core.sentences import duration
from pipelines.engine.job import JobEnd

log = logging.getLogger(__name__)


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
        left = "" if not left_s or math.isinf(left_s) else f"{duration(left_s)} left"
        place = "" if self._name == self._line.place else self._line.place
        self._line.show(0, " · ".join(filter(None, (place, count, self._note, left))))


class JobDisplay(MessageReceiver):
    """Receiver of a job's messages: its tasks are one line, and its log records name it.

    Only warnings are logged by default: many jobs say much.

    Args:
        progress: shows the line.
        name: of the job.
    """

    def __init__(self, progress: Progress, name: str) -> None:
        self._line, self._name = JobLine(progress, name), name
        super().__init__(self._line)

    @property
    def place(self) -> str:
        """Step that the job is at."""
        return self._line.place

    def log(self, name: str, level: int, text: str) -> None:
        """Log a record of the job."""
        shown = level if level >= logging.WARNING else logging.DEBUG
        log.log(shown, "%s: %s", self._name, text)


def tell_end(end: JobEnd) -> None:
    """Log the end of a job."""
    if end.is_done:
        log.info("%s: done (%s)", end.job.name, duration(end.seconds))
    elif end.is_interrupted:
        log.warning("%s: interrupted at %s", end.job.name, end.place or "its start")
    else:
        log.error("%s: failed%s: %s", end.job.name, f" at {end.place}" if end.place else "", end.error)
