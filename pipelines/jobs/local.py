"""Engine on this machine, the process of one job, and the engine in use, which the command line chooses.

A process is this program again, which tells its progress, its log and its error as messages. Its crash is the end
of its job, and of no other. It saves its work and ends when its reader is gone (`georef_cli/verbosity.py`), so that
no job outlives a killed parent for long.
"""

import json
import logging
import math
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from pipelines.core import child
from pipelines.core.child import python_command, python_environment
from pipelines.core.json_values import JsonValue
from pipelines.core.machine import free_main_memory_bytes, thread_count
from pipelines.core.progress import Progress, deferred_interrupts
from pipelines.jobs.engine import INTERRUPTED, Engine, Job, JobDisplay, JobEnd, tell_end

log = logging.getLogger(__name__)

_TAIL_LINES = 20
_KILLED = "The system killed the process, as it does when memory is short. Run fewer at a time (--at-a-time)."


@dataclass(frozen=True)
class ProcessEnd:
    """End of a process: exit code, below zero the signal that ended it, and if it failed its message.

    The kind is that of the failure (`GeorefError.kind`); empty if it did not tell.
    """

    code: int
    seconds: float
    error: str = ""
    kind: str = ""


class JobProcess:
    """Running process of a job, by the arguments of Python that start this program, and those of the program.

    `take` gets the messages in a thread; it returns false for one that is none of progress or log. `ended` is
    called at the end of the process, in the same thread.
    """

    def __init__(
        self,
        program: Sequence[str],
        arguments: Sequence[str],
        threads: int,
        take: Callable[[Mapping[str, JsonValue]], bool],
        ended: Callable[[ProcessEnd], None],
    ) -> None:
        self._take, self._ended = take, ended
        self._kind = ""
        self._plain: deque[str] = deque(maxlen=_TAIL_LINES)
        self._started = time.monotonic()
        self._is_interrupted = False
        # A group of its own: Ctrl-C on the terminal reaches the parent alone, which passes it on once.
        self._process = subprocess.Popen(
            python_command([*program, *arguments, "--json-progress", "--threads", str(threads)]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=python_environment(),
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

    def _read(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                message = _message(line)
                if message is not None and message["kind"] == "error":
                    self._kind = str(message.get("error_kind", ""))
                    self._plain.extend(str(message.get("text", "")).splitlines())
                elif message is None or not self._take(message):
                    self._plain.append(line.rstrip())
        code = self._process.wait()
        if code < 0 and self._is_interrupted:  # before it could handle signals
            code = INTERRUPTED
        seconds = time.monotonic() - self._started
        self._ended(ProcessEnd(code, seconds, "" if code == 0 else self._error(code), self._kind))

    def _error(self, code: int) -> str:
        """Return the message of the process; its last line, below usage or a traceback."""
        said = next((line for line in reversed(self._plain) if line.strip()), "")
        text = said.removeprefix("error: ").removeprefix("Error: ")
        if code < 0:
            name = next((known.name for known in signal.Signals if known == -code), f"signal {-code}")
            end = _KILLED if code == -_SIGKILL else f"The process crashed ({name})."
            return f"{end} {text}".rstrip()
        return text or f"The process ended with exit code {code}."


def _message(line: str) -> dict[str, Any] | None:
    """Return the message in a line; None for lines of others, as native libraries write them."""
    try:
        message = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) and "kind" in message else None


_OWN_GROUP: dict[str, Any]
if sys.platform == "win32":
    _OWN_GROUP = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    _INTERRUPT = signal.CTRL_BREAK_EVENT
    _SIGKILL = 9
else:
    _OWN_GROUP = {"process_group": 0}
    _INTERRUPT = signal.SIGTERM  # SIGINT is ignored by what a shell has started in the background
    _SIGKILL = signal.SIGKILL


_LOOK_EVERY_S = 0.2
_USABLE = 0.9  # of the free memory: other programs grow, too


@dataclass(frozen=True)
class LocalEngine:
    """Engine that runs jobs as processes of this machine."""

    at_a_time: int
    cores: int  # that the jobs share
    free_bytes: int | None = None  # likewise; None: unknown, only the number of jobs is limited
    # arguments of Python that start this program
    program: tuple[str, ...] = field(default_factory=lambda: child.THIS_PROGRAM)

    def together(self, jobs: Sequence[Job]) -> int:
        return max(len(self._startable(jobs, [])), 1)

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; see `Engine`.

        A job that needs more memory than there is runs alone. Smaller jobs pass one that has to wait for memory.
        """
        threads = max(self.cores // self.together(jobs), 1)
        waiting, running = list(jobs), dict[Job, JobProcess]()
        finished: queue.Queue[JobEnd] = queue.Queue()

        def start(job: Job) -> JobProcess:
            display = JobDisplay(progress, job.name)

            def put(end: ProcessEnd) -> None:
                display.close()
                finished.put(JobEnd(job, end.code, end.seconds, display.step, end.error))

            return JobProcess(self.program, job.arguments, threads, display.take, put)

        def end_of(end: JobEnd) -> None:
            tell_end(end)
            task.advance(left_s=math.inf)
            ended(end)

        with progress.task(title, len(jobs)) as task, deferred_interrupts() as stop:
            try:
                is_stopping = False
                while running or (waiting and not stop.requested):
                    if not stop.requested:
                        for job in self._startable(waiting, list(running)):
                            log.info("%s: started with %d thread%s", job.name, threads, "" if threads == 1 else "s")
                            waiting.remove(job)
                            try:
                                running[job] = start(job)
                            except OSError as error:  # a command line that is too long, no more processes
                                end_of(JobEnd(job, 1, 0.0, "", f"The process cannot be started: {error.strerror}."))
                    elif not is_stopping:
                        is_stopping = True
                        log.warning("Stopping %d %s. Ctrl-C again ends them at once.", len(running), title)
                        for job_process in running.values():
                            job_process.interrupt()
                    try:
                        end = finished.get(timeout=_LOOK_EVERY_S)
                    except queue.Empty:
                        continue
                    del running[end.job]
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
            needed = job.peak_bytes + sum(other.peak_bytes for other in beside)
            has_room = (
                len(beside) < self.at_a_time
                and not (job.uses_gpu and any(other.uses_gpu for other in beside))
                and (self.free_bytes is None or needed <= _USABLE * self.free_bytes)
            )
            if has_room or not beside:
                beside.append(job)
        return beside[len(running) :]


_CHOSEN: ContextVar[Engine | None] = ContextVar("engine", default=None)


@contextmanager
def chosen_engine(engine: Engine) -> Iterator[None]:
    """Let the stages that run in this context share their work with an engine; the runner knows of none."""
    token = _CHOSEN.set(engine)
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def failed_of(title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> list[JobEnd]:
    """Run jobs on the engine in use, as `Engine.run` does, and return the ends of those that have failed.

    By default, they are processes that share all cores and the free memory.
    """
    failed: list[JobEnd] = []

    def take(end: JobEnd) -> None:
        if not (end.is_done or end.is_interrupted):
            failed.append(end)
        ended(end)

    if jobs:
        cores = thread_count()
        engine = _CHOSEN.get() or LocalEngine(cores, cores, free_main_memory_bytes())
        engine.run(title, jobs, take, progress)
    return failed
