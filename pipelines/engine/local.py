"""Engine on this machine: as many processes at a time as cores and memory allow."""

from __future__ import annotations

import logging
import math
import queue
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from pipelines.core import restart
from pipelines.core.interrupts import deferred_interrupts
from pipelines.core.progress import Progress
from pipelines.engine.display import JobDisplay, tell_end
from pipelines.engine.job import Job, JobEnd
from pipelines.engine.process import JobProcess, ProcessEnd

log = logging.getLogger(__name__)

_LOOK_EVERY_S = 0.2
_USABLE = 0.9  # of the free memory: other programs grow, too


@dataclass(frozen=True)
class LocalEngine:
    """Engine that runs jobs as processes of this machine.

    Attributes:
        at_a_time: most jobs at a time.
        cores: that the jobs share.
        free_bytes: memory that the jobs share; None: unknown, only their number is limited.
        program: arguments of Python that start this program.
    """

    at_a_time: int
    cores: int
    free_bytes: int | None = None
    program: tuple[str, ...] = field(default_factory=lambda: restart.THIS_PROGRAM)

    def together(self, jobs: Sequence[Job]) -> int:
        """Return how many of the jobs run at a time at the beginning; see `Engine`."""
        return max(len(self._startable(jobs, [])), 1)

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; see `Engine`.

        A job that needs more memory than there is runs alone. Smaller jobs pass one that has to wait for memory.
        """
        threads = max(self.cores // self.together(jobs), 1)
        waiting, running = list(jobs), dict[str, _RunningJob]()

        def end_of(end: JobEnd) -> None:
            tell_end(end)
            task.advance(left_s=math.inf)
            ended(end)

        finished: queue.Queue[JobEnd] = queue.Queue()
        with progress.task(title, len(jobs)) as task, deferred_interrupts() as stop:
            try:
                is_stopping = False
                while running or (waiting and not stop.requested):
                    if not stop.requested:
                        for job in self._startable(waiting, [other.job for other in running.values()]):
                            log.info("%s: started with %d thread%s", job.name, threads, "" if threads == 1 else "s")
                            waiting.remove(job)
                            try:
                                running[job.name] = _RunningJob(job, self.program, threads, progress, finished)
                            except OSError as error:  # a command line that is too long, no more processes
                                end_of(JobEnd(job, 1, 0.0, "", f"cannot be started: {error.strerror}"))
                    elif not is_stopping:
                        is_stopping = True
                        log.warning("stopping %d %s: Ctrl-C again ends them at once", len(running), title)
                        for job_process in running.values():
                            job_process.interrupt()
                    try:
                        end = finished.get(timeout=_LOOK_EVERY_S)
                    except queue.Empty:
                        continue
                    del running[end.job.name]
                    end_of(end)
            finally:
                for job_process in running.values():
                    job_process.kill()
            if stop.requested:
                raise KeyboardInterrupt

    def _startable(self, waiting: Iterable[Job], running: Sequence[Job]) -> list[Job]:
        """Return the waiting jobs that may start beside those that run."""
        beside = list(running)
        for job in waiting:
            if self._admits(job, beside):
                beside.append(job)
        return beside[len(running) :]

    def _admits(self, job: Job, running: Sequence[Job]) -> bool:
        """Return whether a job may run beside others."""
        if not running:
            return True
        if len(running) >= self.at_a_time or (job.uses_gpu and any(other.uses_gpu for other in running)):
            return False
        needed = job.peak_bytes + sum(other.peak_bytes for other in running)
        return self.free_bytes is None or needed <= _USABLE * self.free_bytes


class _RunningJob(JobProcess):
    """Process of a job, whose messages are shown, and whose end is put into a queue."""

    def __init__(
        self, job: Job, program: Sequence[str], threads: int, progress: Progress, finished: queue.Queue[JobEnd]
    ) -> None:
        self.job, self._finished = job, finished
        self._display = JobDisplay(progress, job.name)
        super().__init__(program, job.arguments, threads, self._display.take, self._put)

    def _put(self, end: ProcessEnd) -> None:
        self._display.close()
        self._finished.put(JobEnd(self.job, end.code, end.seconds, self._display.place, end.error))
