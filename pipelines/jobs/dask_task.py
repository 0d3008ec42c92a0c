"""Dask's side of a cluster: the job on a worker, which is a process of this program, and the nodes themselves.

The payload is a document of names and paths. The program that runs is fixed. The nodes are Dask's own programs with
the options that a safe cluster of this package needs.
"""

from __future__ import annotations

import dataclasses
import os
import queue
import threading
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypedDict

from pipelines import __version__
from pipelines.core import child
from pipelines.core.child import python_environment
from pipelines.core.errors import GeorefError
from pipelines.core.json_values import JsonValue
from pipelines.core.machine import available_cores
from pipelines.jobs.cluster import CORES, GPU, MEMORY, ClusterAddress
from pipelines.jobs.local import JobProcess, ProcessEnd
from pipelines.jobs.storage import Parcel, arguments_in, worker_exchange

UNFIT = "unfit"  # kind of the end of a job that its worker cannot run; another one may
_SENT = ("log", "begin", "advance", "end")
_SEND_EVERY_S = 0.25


class JobRequest(TypedDict):
    """Request to a worker: the arguments of `georef`, by this version, as one attempt at a job."""

    topic: str  # of the events that the engine reads
    attempt: str
    version: str
    arguments: list[str]
    token: str  # file that a worker sees if it shares the folder of the job; empty: none
    parcel: Parcel | None  # parts that come from a storage; None: the folder is shared


def run_job(request: JobRequest) -> None:
    """Run a job on this worker until it ends, or until nobody wants it any more.

    A job is not wanted when the engine has cancelled it, when the engine or the scheduler is gone, and when this
    worker closes. Its process then saves its work, as after Ctrl-C.
    """
    from distributed import get_worker

    worker = get_worker()
    events = _Events(worker, request)
    events.flush(started=True)
    end = _obstacle(request) or _run_where_its_files_are(worker, request, events)
    events.flush(ended=dataclasses.asdict(end))


def _obstacle(request: JobRequest) -> ProcessEnd | None:
    """Return why this worker cannot run the job; None: it can."""
    if request["version"] != __version__:
        return ProcessEnd(1, 0.0, f"has georefgs {__version__} instead of {request['version']}", UNFIT)
    if request["token"] and not Path(request["token"]).is_file():
        return ProcessEnd(1, 0.0, f"does not see {Path(request['token']).parent}", UNFIT)
    return None


_DaskWorker = Any  # distributed.Worker


def _run_where_its_files_are(worker: _DaskWorker, request: JobRequest, events: _Events) -> ProcessEnd:
    parcel, arguments = request["parcel"], request["arguments"]
    if parcel is None:
        return _run(worker, arguments, events)
    scratch = Path(worker.local_directory).resolve() / request["attempt"]
    started = time.monotonic()
    try:
        with worker_exchange(parcel, scratch):
            return _run(worker, arguments_in(parcel, arguments, scratch), events)
    except GeorefError as error:
        return ProcessEnd(1, time.monotonic() - started, str(error), error.kind)


def _run(worker: _DaskWorker, arguments: Sequence[str], events: _Events) -> ProcessEnd:
    ends: queue.Queue[ProcessEnd] = queue.Queue()
    key = worker.get_current_task()
    cores = int(worker.state.total_resources.get(CORES, available_cores()))
    threads = max(cores // worker.state.nthreads, 1)
    try:
        running = JobProcess(child.THIS_PROGRAM, arguments, threads, events.take, ends.put)
    except OSError as error:
        return ProcessEnd(1, 0.0, f"The process cannot be started: {error.strerror}.")
    is_wanted = True
    while True:
        try:
            return ends.get(timeout=_SEND_EVERY_S)
        except queue.Empty:
            events.flush()
        task = worker.state.tasks.get(key)
        goes_on = worker.status.name in ("running", "paused") and task is not None and task.state == "executing"
        if is_wanted and not goes_on:
            is_wanted = False
            running.interrupt()


class _Events:
    """Sender of a job's messages; steps that follow each other are added up, so that many become few."""

    def __init__(self, worker: _DaskWorker, request: JobRequest) -> None:
        self._worker, self._request = worker, request
        self._lock = threading.Lock()
        self._messages: list[dict[str, Any]] = []

    def take(self, message: Mapping[str, JsonValue]) -> bool:
        """Return whether a message was one of progress or of the log, and keep it until `flush`."""
        if message["kind"] not in _SENT:
            return False
        with self._lock:
            last = self._messages[-1] if self._messages else {"kind": ""}
            if message["kind"] == last["kind"] == "advance":
                self._messages[-1] = {
                    **message,
                    "steps": last["steps"] + message["steps"],
                    "note": message["note"] or last["note"],
                }
            else:
                self._messages.append(dict(message))
        return True

    def flush(self, **content: JsonValue) -> None:
        """Send the messages that were kept, and one event with this content, if any."""
        with self._lock:
            messages, self._messages = self._messages, []
        events: list[dict[str, Any]] = [{"messages": messages}, content]
        for event in events:
            if any(event.values()):
                self._worker.log_event(self._request["topic"], {"attempt": self._request["attempt"], **event})


# The pages of the status servers are not encrypted and ask for no certificate.
_PRIVATE_PAGES = ("--no-dashboard", "--dashboard-address", "127.0.0.1:0")


def run_scheduler(listen: ClusterAddress) -> None:
    """Run a scheduler until it is interrupted."""
    from distributed.cli.dask_scheduler import main

    scheme = listen.url.partition(":")[0]
    address_options = ("--protocol", scheme, "--host", listen.host, "--port", str(listen.port))
    _call(main, [*address_options, *listen.dask_options(), *_PRIVATE_PAGES])


def run_worker(
    scheduler: ClusterAddress, *, jobs: int, cores: int, memory_bytes: int, gpus: int, name: str | None = None
) -> None:
    """Run a worker until it is interrupted, or its scheduler ends.

    It runs at most so many jobs at a time, which share cores and memory; each takes a GPU if it uses one.
    """
    from distributed.cli.dask_worker import main

    resources = f"{MEMORY}={memory_bytes},{CORES}={cores}" + (f",{GPU}={gpus}" if gpus else "")
    # Dask's own limit of memory counts the worker alone; the jobs are processes of their own.
    options = ["--nthreads", str(jobs), "--memory-limit", "0", "--resources", resources]
    here = ["--host", "127.0.0.1"] if scheduler.certificates is None else []
    named = [] if name is None else ["--name", name]
    _call(main, [scheduler.url, *options, *here, *named, *scheduler.dask_options(), *_PRIVATE_PAGES])


def _call(main: object, arguments: Sequence[str]) -> None:
    """Run a program of Dask with encryption demanded where it has a certificate."""
    import dask

    os.environ.update(python_environment())  # Nannies spawn the processes of their workers by this environment.
    is_encrypted = "--tls-cert" in arguments
    with dask.config.set({"distributed.comm.require-encryption": is_encrypted}):
        main(args=list(arguments), standalone_mode=False)  # type: ignore[operator]


@contextmanager
def folder_tokens(folders: Iterable[Path | None]) -> Iterator[dict[Path | None, str]]:
    """Put a token into each folder while the context lasts, and return their paths by folder.

    By this file a worker recognises that it shares a folder, and not only its name.
    """
    name = f".georef-{uuid.uuid4().hex}"
    tokens: dict[Path | None, str] = {
        folder: str(folder.absolute() / name) for folder in folders if folder is not None
    }
    try:
        for token in tokens.values():
            Path(token).touch()
        yield tokens
    finally:
        for token in tokens.values():
            with suppress(OSError):
                Path(token).unlink()
