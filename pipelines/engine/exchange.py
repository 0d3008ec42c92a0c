"""Exchange of a job's files between engine and workers through a storage: named parts of one folder, no others."""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

from pipelines.core.errors import GeorefError, InputError
from pipelines.engine.job import Job
from pipelines.engine.storage import PartIndex, Storage

log = logging.getLogger(__name__)

_SAVE_EVERY_S = 60.0


class Parcel(TypedDict):
    """Parts of a job, as a worker is told.

    Attributes:
        url: of the storage.
        folder: of the engine; it stands at the beginning of paths in the arguments.
        attempt: at the job.
        reads: parts that the job reads, relative to the folder.
        writes: part that the job reads and writes.
    """

    url: str
    folder: str
    attempt: str
    reads: list[str]
    writes: str


class EngineExchange:
    """Side of the engine, whose folder has everything before and after a run.

    Args:
        storage: that the workers use.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._sent: dict[str, PartIndex] = {}

    def send(self, job: Job, attempt: str) -> Parcel:
        """Put what an attempt at a job needs into the storage, after collecting what an earlier one left there.

        Raises:
            InputError: the job names no parts, or a part lies outside its folder.
            StorageError: the storage failed.
        """
        if job.folder is None or job.writes is None:
            raise InputError(f"{job.name} cannot run through a storage: use a shared folder", field="--storage")
        folder = job.folder.resolve()
        writes, *reads = [_part(folder, path) for path in (job.writes, *job.reads)]
        self._collect(folder, writes)
        for part in reads:
            self._storage.send(folder, part, "engine")
        self._sent[writes] = self._storage.send(folder, writes, "engine", attempt)
        return Parcel(url=self._storage.url, folder=str(job.folder), attempt=attempt, reads=reads, writes=writes)

    def collect(self, job: Job) -> None:
        """Take the results of a job into the folder of the engine.

        Raises:
            InputError: the index in the storage is damaged.
            StorageError: the storage failed.
        """
        if job.folder is not None and job.writes is not None:
            self._collect(job.folder.resolve(), _part(job.folder.resolve(), job.writes))

    def _collect(self, folder: Path, part: str) -> None:
        index = self._storage.index(part)
        if index is not None and index.writer == "worker":
            self._storage.fetch(folder, part, self._sent.get(part))
            self._storage.mark_collected(index)


@contextmanager
def worker_exchange(parcel: Parcel, scratch: Path) -> Iterator[None]:
    """Fetch the parts of a job into a scratch folder, and put its results back when the context ends.

    Meanwhile results are put back every minute, so that a lost worker loses little.

    Args:
        parcel: the parts.
        scratch: folder of this job, which is deleted in the end.

    Raises:
        InputError: an index in the storage is damaged.
        StorageError: the storage failed.
    """
    storage, stopped = Storage(parcel["url"]), threading.Event()

    def save() -> None:
        while not stopped.wait(_SAVE_EVERY_S):
            try:
                storage.send(scratch, parcel["writes"], "worker", parcel["attempt"])
            except GeorefError as error:
                log.warning("results were not put back, next attempt in a minute: %s", error)

    saving = threading.Thread(target=save, daemon=True)
    try:
        for part in (*parcel["reads"], parcel["writes"]):
            storage.fetch(scratch, part)
        scratch.mkdir(parents=True, exist_ok=True)
        saving.start()
        yield
        stopped.set()
        saving.join()
        storage.send(scratch, parcel["writes"], "worker", parcel["attempt"])
    finally:
        stopped.set()
        shutil.rmtree(scratch, ignore_errors=True)


def arguments_in(parcel: Parcel, arguments: Sequence[str], scratch: Path) -> list[str]:
    """Return the arguments of a job with the scratch folder in place of the engine's folder."""
    here, there = f"{parcel['folder']}/", f"{scratch}/"
    return [f"{argument}/".replace(here, there).removesuffix("/") for argument in arguments]


def _part(folder: Path, path: Path) -> str:
    """Return a path relative to a folder.

    Raises:
        InputError: it lies outside.
    """
    try:
        return path.resolve().relative_to(folder).as_posix()
    except ValueError:
        raise InputError(
            f"lies outside {folder}: with --storage everything that a job reads lies in one folder", path=path
        ) from None
