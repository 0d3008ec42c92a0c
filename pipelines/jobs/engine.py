"""Jobs, their ends, their display as one line each, and the interface of the engines that run them."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipelines.core.child import MessageReceiver
from pipelines.core.progress import Progress, ProgressTask
from pipelines.core.sentences import duration

log = logging.getLogger(__name__)

INTERRUPTED = 130


@dataclass(frozen=True)
class Job:
    """Command of this program whose repetition completes an earlier, interrupted one.

    Only names and paths travel: a job runs on every machine that sees its paths, and leaves its result there.
    """

    name: str  # for people, unique among the jobs of a run
    arguments: tuple[str, ...]  # of `georef`
    peak_bytes: int  # predicted peak of the memory
    uses_gpu: bool = False  # takes a whole one
    folder: Path | None = None  # of its command; a machine that does not see it cannot run it
    writes: Path | None = None  # in `folder`; needed where its files go through a storage
    reads: tuple[Path, ...] = ()  # further files and folders in `folder` that it needs there


@dataclass(frozen=True)
class JobEnd:
    """End of a job."""

    job: Job
    code: int  # exit code; below zero the signal that ended the process
    seconds: float
    step: str  # that the job was at (`train`); empty if it named none
    error: str  # message of a job that failed, else empty

    @property
    def is_done(self) -> bool:
        """Whether the job has reached its result."""
        return self.code == 0

    @property
    def is_interrupted(self) -> bool:
        """Whether the job was stopped and goes on when it is run again."""
        return self.code == INTERRUPTED


class Engine(Protocol):
    """Runner of jobs."""

    def together(self, jobs: Sequence[Job]) -> int:
        """Return how many of the jobs run at a time at the beginning; at least 1."""

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; one that fails stops no other.

        Args:
            title: what the jobs are, for the display: `missions`.
            jobs: in the order in which they begin where resources allow.
            ended: called in this thread at the end of each job.

        Raises:
            KeyboardInterrupt: the user stopped the run. The jobs that ran have saved their work, and `ended` was
                called for each of them.
        """


class JobDisplay(MessageReceiver):
    """Receiver of a job's messages: its tasks are one line, the outermost, with the task inside as its note.

    Its step is the latest note of the outermost task: the stage that runs. Log records name the job, and only
    warnings are logged by default: many jobs say much.
    """

    def __init__(self, progress: Progress, name: str) -> None:
        super().__init__(self)
        self.step = ""
        self._shown_in, self._name = progress, name
        self._outer: ProgressTask | None = None

    def log(self, name: str, level: int, text: str) -> None:
        shown_level = level if level >= logging.WARNING else logging.DEBUG
        log.log(shown_level, "%s: %s", self._name, text)

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        if self._outer is not None:
            yield _InnerTask(self, name, total)
            return
        with self._shown_in.task(self._name, total) as outer:
            self._outer = outer
            try:
                yield self
            finally:
                self._outer = None

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self.step = note.strip() or self.step
        self.show(steps, self.step)

    def show(self, steps: int, note: str) -> None:
        """Add steps to the line and change its note; the time that a job will still take is not known."""
        if self._outer is not None:
            self._outer.advance(steps, note=note, left_s=math.inf)


class _InnerTask:
    def __init__(self, line: JobDisplay, name: str, total: int | None) -> None:
        self._line, self._name, self._total = line, name, total
        self._done, self._note = 0, ""

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self._done, self._note = self._done + steps, note.strip() or self._note
        count = f"{self._name} {self._done}" + ("" if self._total is None else f"/{self._total}")
        remaining = "" if not left_s or math.isinf(left_s) else f"{duration(left_s)} left"
        step = "" if self._name == self._line.step else self._line.step
        self._line.show(0, " · ".join(filter(None, (step, count, self._note, remaining))))


def tell_end(end: JobEnd) -> None:
    """Log how a job ended: as information, as a warning if it was interrupted, as an error if it failed."""
    if end.is_done:
        log.info("%s: done (%s)", end.job.name, duration(end.seconds))
    elif end.is_interrupted:
        log.warning("%s was interrupted at %s.", end.job.name, end.step or "its start")
    else:
        log.error("%s failed%s. %s", end.job.name, f" at {end.step}" if end.step else "", end.error)
