"""Engine on the workers of a Dask cluster.

The engine chooses the worker of each job, as the local engine chooses which jobs run together; Dask carries jobs
and events. A job ends with the event of its worker. Only the cancellation of its task stops a job: Ctrl-C, the end
of the engine and the end of the scheduler all cancel it, and the job saves its work.
"""

from __future__ import annotations

import logging
import math
import queue
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pipelines import __version__
from pipelines.core.errors import ClusterError, WorkspaceBusyError
from pipelines.core.json_values import JsonValue
from pipelines.core.progress import Progress, ProgressTask, StopRequest, deferred_interrupts
from pipelines.jobs.cluster import GPU, MEMORY, ClusterAddress, Worker, connected, worker_for, workers_of
from pipelines.jobs.dask_task import UNFIT, JobRequest, folder_tokens, run_job
from pipelines.jobs.engine import INTERRUPTED, Job, JobDisplay, JobEnd, tell_end
from pipelines.jobs.local import ProcessEnd
from pipelines.jobs.storage import EngineExchange, Storage

if TYPE_CHECKING:
    from distributed import Client, Future

log = logging.getLogger(__name__)

MOST_FAILURES = 3
# Failures that may belong to the machine, or to the moment. Bad input fails everywhere.
_LOST = "lost"
_TRIED_AGAIN = ("backend", "crash", "defect", "resources", "storage", _LOST)
_LOOK_EVERY_S = 0.2
# A cancelled job that waits behind those of another command never begins, and sends no event of its end.
_START_PATIENCE_S = 3.0
_REFRESH_EVERY_S = 1.0
# A process whose worker was killed saves its work, and holds its lock meanwhile.
_BUSY_PAUSE_S, _BUSY_PATIENCE_S = 3.0, 600.0


@dataclass
class PendingJob:
    """Job that has not ended."""

    job: Job
    token: str  # file that its worker must see
    failures: int = 0
    avoided: set[str] = field(default_factory=set)  # workers on which it has failed
    not_before: float = 0.0  # time of the next attempt at the earliest
    busy_since: float | None = None  # its folder is locked by another process; None: it is not


@dataclass
class _Attempt:
    pending: PendingJob
    worker: Worker
    future: Future[None]
    display: JobDisplay
    since: float
    has_started: bool = False


@dataclass
class ClusterRun:
    """Jobs of one call of the engine: their workers, their events, and their further attempts after failures."""

    client: Client
    waiting: list[PendingJob]  # in the order in which they begin where resources allow
    at_a_time: int  # most jobs
    exchange: EngineExchange | None  # through which files go; None: they are shared
    ended: Callable[[JobEnd], None]
    progress: Progress  # shows a line for each job that runs
    task: ProgressTask  # counts those that have ended

    def __post_init__(self) -> None:
        self._running: dict[str, _Attempt] = {}
        self._workers: dict[str, Worker] = {}
        self._unfit: set[str] = set()
        self._refreshed = -math.inf
        self._warned = ""
        self._topic = f"georef-{uuid.uuid4().hex}"
        self._events: queue.Queue[dict[str, Any]] = queue.Queue()
        self.client.subscribe_topic(self._topic, lambda event: self._events.put(event[1]))

    def until_all_have_ended(self, title: str, stop: StopRequest) -> None:
        """Start jobs where there is room, and act on their events until all have ended."""
        is_stopping, stopped = False, math.inf
        while self._running or (self.waiting and not stop.requested):
            if stop.requested and not is_stopping:
                is_stopping, stopped = True, time.monotonic()
                log.warning("Stopping %d %s. Ctrl-C again does not wait for them.", len(self._running), title)
                for attempt in self._running.values():
                    attempt.future.cancel()
            self._refresh(is_stopping)
            if not is_stopping:
                self._start()
            self._take_events(is_stopping)
            if time.monotonic() - stopped > _START_PATIENCE_S:
                for name in [name for name, attempt in self._running.items() if not attempt.has_started]:
                    self._finish(name, ProcessEnd(INTERRUPTED, 0.0))

    def close(self) -> None:
        """Cancel what still runs, and close its lines."""
        for attempt in self._running.values():
            attempt.display.close()
        if self.client.status == "running":
            self.client.cancel([attempt.future for attempt in self._running.values()])
            self.client.unsubscribe_topic(self._topic)

    def _refresh(self, is_stopping: bool) -> None:
        """Update the workers from the scheduler; a job of a lost worker has failed there."""
        if time.monotonic() - self._refreshed < _REFRESH_EVERY_S:
            return
        try:
            if self.client.status != "running":
                raise OSError
            described = self.client.scheduler_info()["workers"]
        except (OSError, TimeoutError, RuntimeError) as error:
            for name, attempt in list(self._running.items()):
                self._finish(name, ProcessEnd(INTERRUPTED, time.monotonic() - attempt.since))
            raise ClusterError(
                "scheduler-lost",
                "The scheduler is lost; the jobs save their work and stop.",
                remedy="Start scheduler and workers, then repeat the command, which continues.",
            ) from error
        self._workers = {
            address: worker for address, worker in workers_of(described).items() if address not in self._unfit
        }
        self._refreshed = time.monotonic()
        for name, attempt in list(self._running.items()):
            # Dask cancels all tasks when its scheduler is lost, too; but then the program does not come here.
            is_cancelled = attempt.future.status == "cancelled" and not is_stopping
            if is_cancelled or attempt.worker.address not in described:
                attempt.future.cancel()
                seconds = time.monotonic() - attempt.since
                why = "its task was cancelled" if is_cancelled else "its worker was lost"
                self._end(name, ProcessEnd(1, seconds, why, _LOST), is_stopping)

    def _start(self) -> None:
        if self._unfit and not self._workers and not self._running:
            raise ClusterError("no-worker", f"No worker can run the jobs. {self._warned}")
        now = time.monotonic()
        for pending in list(self.waiting):
            if len(self._running) >= self.at_a_time:
                return
            if now < pending.not_before:
                continue
            by_worker: dict[str, list[Job]] = {}
            for attempt in self._running.values():
                by_worker.setdefault(attempt.worker.address, []).append(attempt.pending.job)
            worker = worker_for(pending.job, self._workers, by_worker, pending.avoided)
            if worker is not None:
                self.waiting.remove(pending)
                self._submit(pending, worker)
        if self.waiting and not self._running and all(pending.not_before <= now for pending in self.waiting):
            wanted = "a GPU" if self._workers else f"{MEMORY}, as those of `georef cluster worker` do"
            text = f"The jobs wait, because no worker offers {wanted}."
            if text != self._warned:
                self._warned = text
                log.warning("%s", text, extra={"code": "no-worker-yet"})

    def _submit(self, pending: PendingJob, worker: Worker) -> None:
        attempt = uuid.uuid4().hex
        request = JobRequest(
            topic=self._topic,
            attempt=attempt,
            version=__version__,
            arguments=list(pending.job.arguments),
            token=pending.token,
            parcel=None if self.exchange is None else self.exchange.send(pending.job, attempt),
        )
        resources = {MEMORY: min(pending.job.peak_bytes, worker.memory_bytes)}
        if pending.job.uses_gpu:
            resources[GPU] = 1
        log.info("%s: started on %s", pending.job.name, worker.name)
        future = self.client.submit(
            run_job, request, key=f"georef-{attempt}", workers=[worker.address], resources=resources, pure=False
        )
        future.add_done_callback(lambda future: self._events.put({"attempt": attempt, "future": future}))
        display = JobDisplay(self.progress, pending.job.name)
        self._running[attempt] = _Attempt(pending, worker, future, display, time.monotonic())

    def _take_events(self, is_stopping: bool) -> None:
        """Act on the events that have come, after waiting for one."""
        try:
            event = self._events.get(timeout=_LOOK_EVERY_S)
            while True:
                self._take(event, is_stopping)
                event = self._events.get_nowait()
        except queue.Empty:
            return

    def _take(self, event: Mapping[str, JsonValue], is_stopping: bool) -> None:
        name = event["attempt"]
        attempt = self._running.get(name)
        if attempt is None:  # It has ended.
            return
        for message in event.get("messages", ()):
            attempt.display.take(message)
        if "started" in event:
            if attempt.has_started:  # Dask began it again on a worker that was restarted under the same address.
                attempt.pending.failures += 1
            attempt.has_started = True
        if "ended" in event:
            self._end(name, ProcessEnd(**event["ended"]), is_stopping)
        elif "future" in event and attempt.future.status == "error":
            seconds = time.monotonic() - attempt.since
            self._end(name, ProcessEnd(1, seconds, f"{attempt.future.exception()}", _LOST), is_stopping)

    def _end(self, name: str, end: ProcessEnd, is_stopping: bool) -> None:
        """Finish an attempt, or let its job wait for the next one."""
        attempt = self._running[name]
        pending, worker = attempt.pending, attempt.worker
        if is_stopping:
            self._finish(name, end if end.kind != _LOST else ProcessEnd(INTERRUPTED, end.seconds))
        elif end.kind == UNFIT:
            self._unfit.add(worker.address)
            self._workers.pop(worker.address, None)
            self._warned = f"{worker.name} gets no jobs, because it {end.error}."
            log.warning("%s", self._warned, extra={"code": "worker-unfit"})
            self._repeat(name)
        elif end.kind == _LOST and not attempt.has_started:
            self._repeat(name)
        elif end.code == INTERRUPTED:  # Its worker closes.
            log.warning(
                "%s was interrupted on %s and continues on another worker.",
                pending.job.name, worker.name, extra={"code": "job-moved"},
            )  # fmt: skip
            pending.avoided.add(worker.address)
            self._repeat(name)
        elif end.kind == WorkspaceBusyError.kind and self._may_wait(pending):
            self._repeat(name, _BUSY_PAUSE_S)
        elif end.code < 0 or end.kind in _TRIED_AGAIN:
            pending.failures += 1
            pending.avoided.add(worker.address)
            if pending.failures >= MOST_FAILURES:
                text = f"failed {pending.failures} times, at last on {worker.name}. {end.error}"
                self._finish(name, ProcessEnd(end.code, end.seconds, text, end.kind))
            else:
                log.warning(
                    "%s failed on %s and is tried again. %s",
                    pending.job.name, worker.name, end.error, extra={"code": "job-repeated"},
                )  # fmt: skip
                self._repeat(name)
        else:
            self._finish(name, end)

    def _may_wait(self, pending: PendingJob) -> bool:
        """Return whether another process may still hold the lock of the job's folder."""
        now = time.monotonic()
        pending.busy_since = now if pending.busy_since is None else pending.busy_since
        return now - pending.busy_since < _BUSY_PATIENCE_S

    def _repeat(self, name: str, pause_s: float = 0.0) -> None:
        attempt = self._running.pop(name)
        attempt.display.close()
        attempt.pending.not_before = time.monotonic() + pause_s
        self.waiting.insert(0, attempt.pending)

    def _finish(self, name: str, end: ProcessEnd) -> None:
        attempt = self._running.pop(name)
        attempt.display.close()
        if self.exchange is not None:
            self.exchange.collect(attempt.pending.job)
        job_end = JobEnd(attempt.pending.job, end.code, end.seconds, attempt.display.step, end.error)
        tell_end(job_end)
        self.task.advance(left_s=math.inf)
        self.ended(job_end)


@dataclass(frozen=True)
class DaskEngine:
    """Engine that runs jobs on the workers of a Dask cluster.

    A job whose worker is lost, or that fails for a reason that may belong to the machine, is tried again, on
    another worker if there is one; after three failures it has failed. Workers that join are used, also later.
    """

    cluster: ClusterAddress
    at_a_time: int | None = None  # most jobs; None: as many as the workers take
    storage: Storage | None = None  # of files; None: the workers share the folders of the jobs

    def together(self, jobs: Sequence[Job]) -> int:
        with connected(self.cluster) as client:
            workers = workers_of(client.scheduler_info()["workers"])
        running: dict[str, list[Job]] = {}
        for job in jobs:
            if (worker := worker_for(job, workers, running)) is not None:
                running.setdefault(worker.address, []).append(job)
        count = sum(map(len, running.values()))
        return max(min(count, self.at_a_time or count), 1)

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        """Run jobs until all have ended; see `Engine`.

        Raises:
            ClusterError: there is no scheduler, it is lost, or no worker can run the jobs.
            InputError: a job needs files that cannot go through the storage.
            StorageError: the storage failed.
        """
        exchange = None
        if self.storage is not None:
            self.storage.check()
            exchange = EngineExchange(self.storage)
        with (
            connected(self.cluster) as client,
            folder_tokens([job.folder for job in jobs if exchange is None]) as tokens,
            progress.task(title, len(jobs)) as task,
            deferred_interrupts() as stop,
        ):
            waiting = [PendingJob(job, tokens.get(job.folder, "")) for job in jobs]
            at_a_time = self.at_a_time or len(jobs)
            run = ClusterRun(client, waiting, at_a_time, exchange, ended, progress, task)
            try:
                run.until_all_have_ended(title, stop)
            finally:
                run.close()
            if stop.requested:
                raise KeyboardInterrupt
