"""Folders that go through an object store, where machines share no disk.

A part is a file or folder inside a folder of jobs, such as a workspace. The store holds an index of it, and one
object for each file in the state that the index lists; an object is never changed. The index is written after the
objects, so that an interrupted copy leaves the part as it was. Only files whose size or time differs are copied.
Engine and workers exchange the named parts of one folder, and no others.
"""

import hashlib
import json
import logging
import os
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypedDict
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, ValidationError

from pipelines.core.errors import BackendUnavailableError, GeorefError, InputError, StorageError
from pipelines.core.sentences import fault_sentence
from pipelines.core.validators import stays_inside
from pipelines.jobs.engine import Job

log = logging.getLogger(__name__)

_MOST_INDEX_BYTES = 256 * 1024 * 1024
# Files that belong to one machine, that can be made again, or that are being written.
_LEFT_OUT_NAMES = (".lock", ".lock.holder")
_LEFT_OUT_FOLDERS = ("cache",)
_DRAFT = ".tmp"
_AT_ONCE = 64
# Stores of buckets; to make a folder there would make a bucket that is misspelt.
_WITHOUT_FOLDERS = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl")

Writer = Literal["engine", "worker"]


class PartIndex(BaseModel):
    """Index of a part.

    Attributes:
        part: its relative path.
        attempt: at the job that the part was sent for; workers of earlier attempts may not write any more.
        writer: who wrote it; `worker`: the engine has not collected it.
        files: size in bytes and time of change in nanoseconds by path, relative to the folder of the part.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format_version: Literal[1] = 1
    part: str
    attempt: str
    writer: Writer
    files: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Storage:
    """Store that a URL of fsspec names, such as `s3://bucket/prefix` or `file:///mnt/exchange`.

    All methods raise a StorageError if the store cannot be reached, and a BackendUnavailableError if a library for
    this kind of store is not installed.
    """

    url: str

    def check(self) -> None:
        """Connect to the store."""
        with self._reached():
            store, home = self._folder_in_store("")
            store.exists(home)

    def index(self, part: str) -> PartIndex | None:
        """Return the index of a part, or None; an InputError: it is damaged, or leads out of its part."""
        with self._reached():
            store, home = self._folder_in_store(part)
            url = f"{home}.json"
            if not store.exists(url):
                return None
            if store.size(url) > _MOST_INDEX_BYTES:
                raise InputError("file-too-large", "is too large for an index.", path=url)
            try:
                index = PartIndex.model_validate_json(store.cat_file(url))
            except ValidationError as error:
                message = f"is a damaged index. {fault_sentence(error.errors()[0])} Delete it."
                raise InputError("index-damaged", message, path=url) from error
            if index.part != part or not all(name == "." or stays_inside(name) for name in index.files):
                raise InputError(
                    "index-leaves-part", "lists files outside its part.", path=url, remedy="Delete it."
                )
            return index

    def send(self, folder: Path, part: str, writer: Writer, attempt: str = "") -> PartIndex:
        """Copy a part of a folder into the store for an attempt at a job, and delete there what it has no more.

        A file that vanishes meanwhile, as when a stage ends, makes the copy start anew. A StorageError tells a
        worker that another attempt at its job has taken over.
        """
        with self._reached():
            (store, home), before = self._folder_in_store(part), self.index(part)
            if writer == "worker" and before is not None and before.attempt != attempt:
                raise StorageError("attempt-superseded", f"Another attempt at the job of {part} has taken over.")
            held = set() if before is None else {_digest(name, *state) for name, state in before.files.items()}
            if urlsplit(self.url).scheme not in _WITHOUT_FOLDERS:
                store.makedirs(home, exist_ok=True)
            while True:
                files = dict(_files_of(folder / part))
                try:
                    keys = {name: _digest(name, *state) for name, state in files.items()}
                    for names in _batches([name for name, key in keys.items() if key not in held]):
                        places = [f"{home}/{keys[name]}" for name in names]
                        store.put([str(folder / part / name) for name in names], places)
                        held.update(keys[name] for name in names)
                    break
                except FileNotFoundError:
                    if all((folder / part / name).exists() for name in files):
                        raise
            index = PartIndex(part=part, attempt=attempt, writer=writer, files=files)
            if index != before:
                self.write_index(index)
                wanted = set(keys.values())
                for url in store.ls(home, detail=False):
                    if url.rpartition("/")[2] not in wanted:
                        store.rm_file(url)
            return index

    def fetch(self, folder: Path, part: str, before: PartIndex | None = None) -> PartIndex | None:
        """Copy a part from the store into a folder, and return its index, if any; a file that is newer there stays.

        Files that the folder had sent `before`, and that are no longer listed, are deleted.
        """
        with self._reached():
            (store, home), index = self._folder_in_store(part), self.index(part)
            if index is None:
                return None
            older = [name for name, state in index.files.items() if _is_older(folder / part / name, state)]
            for names in _batches(older):
                paths = [folder / part / name for name in names]
                for path in paths:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    if not path.parent.resolve().is_relative_to(folder.resolve()):
                        raise InputError(
                            "path-leaves-folder", "leads out of the folder through a symbolic link.", path=path
                        )
                drafts = [path.with_name(path.name + _DRAFT) for path in paths]
                objects = [f"{home}/{_digest(name, *index.files[name])}" for name in names]
                store.get(objects, [str(draft) for draft in drafts])
                for name, path, draft in zip(names, paths, drafts, strict=True):
                    time_ns = index.files[name][1]
                    os.utime(draft, ns=(time_ns, time_ns))
                    draft.replace(path)
            for name, state in ({} if before is None else before.files).items():
                if name not in index.files and _state_of(folder / part / name) == tuple(state):
                    (folder / part / name).unlink()
            return index

    def write_index(self, index: PartIndex) -> None:
        with self._reached():
            store, home = self._folder_in_store(index.part)
            store.pipe_file(f"{home}.json", json.dumps(index.model_dump(mode="json")).encode())

    def _folder_in_store(self, part: str) -> tuple[Any, str]:
        """Return the library of the store, and the folder of a part's objects as that library writes it."""
        import fsspec

        store, root = fsspec.core.url_to_fs(self.url)
        return store, f"{root.rstrip('/')}/{_digest(part)}"

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """Turn failures of the store into known ones while the context lasts."""
        try:
            yield
        except GeorefError:
            raise
        except ImportError as error:
            raise BackendUnavailableError("extra-missing", f"{self.url} needs a library: {error}.") from error
        except Exception as error:  # Each library of a store has exceptions of its own.
            raise StorageError(
                "storage-unreachable", f"{self.url} failed with {type(error).__name__}: {error}."
            ) from error


def _files_of(path: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    """Yield the files of a part: path relative to it, size and time of change."""
    if path.is_file():
        if (state := _state_of(path)) is not None:
            yield ".", state
        return
    for folder, folders, names in os.walk(path):
        inside = PurePosixPath(Path(folder).relative_to(path).as_posix())
        if inside == PurePosixPath("."):
            folders[:] = [name for name in folders if name not in _LEFT_OUT_FOLDERS]
        for name in names:
            relative = str(inside / name)
            if name in _LEFT_OUT_NAMES or name.endswith(_DRAFT) or not stays_inside(relative):
                continue
            if (state := _state_of(Path(folder) / name)) is not None:
                yield relative, state


def _is_older(path: Path, state: tuple[int, int]) -> bool:
    """Return whether a file is missing, or older than a state or of another size."""
    present = _state_of(path)
    return present is None or (present != state and present[1] <= state[1])


def _state_of(path: Path) -> tuple[int, int] | None:
    """Return size and time of change of a file; None: there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _batches(names: list[str]) -> Iterator[list[str]]:
    """Yield the names of files that are copied at once."""
    for start in range(0, len(names), _AT_ONCE):
        yield names[start : start + _AT_ONCE]


def _digest(*parts: str | int) -> str:
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:32]


_SAVE_EVERY_S = 60.0


class Parcel(TypedDict):
    """Parts of a job, as a worker is told: those that it reads, and the one that it reads and writes.

    The parts are relative to the folder of the engine, which stands at the beginning of paths in the arguments.
    """

    url: str
    folder: str
    attempt: str
    reads: list[str]
    writes: str


class EngineExchange:
    """Side of the engine, whose folder has everything before and after a run."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._sent: dict[str, PartIndex] = {}

    def send(self, job: Job, attempt: str) -> Parcel:
        """Put what an attempt at a job needs into the storage, after collecting what an earlier one left there.

        Raises:
            InputError: the job names no parts, or a part lies outside its folder.
        """
        if job.folder is None or job.writes is None:
            message = f"is not supported by {job.name}, whose files are not known."
            remedy = "Use a shared folder."
            raise InputError("storage-not-supported", message, field="--storage", remedy=remedy)
        folder = job.folder.resolve()
        writes, *reads = [_part(folder, path) for path in (job.writes, *job.reads)]
        self._collect(folder, writes)
        for part in reads:
            self._storage.send(folder, part, "engine")
        self._sent[writes] = self._storage.send(folder, writes, "engine", attempt)
        return Parcel(url=self._storage.url, folder=str(job.folder), attempt=attempt, reads=reads, writes=writes)

    def collect(self, job: Job) -> None:
        """Take the results of a job into the folder of the engine."""
        if job.folder is not None and job.writes is not None:
            self._collect(job.folder.resolve(), _part(job.folder.resolve(), job.writes))

    def _collect(self, folder: Path, part: str) -> None:
        index = self._storage.index(part)
        if index is not None and index.writer == "worker":
            self._storage.fetch(folder, part, self._sent.get(part))
            self._storage.write_index(index.model_copy(update={"writer": "engine"}))


@contextmanager
def worker_exchange(parcel: Parcel, scratch: Path) -> Iterator[None]:
    """Fetch the parts of a job into a scratch folder, and put its results back when the context ends.

    Meanwhile results are put back every minute, so that a lost worker loses little. The scratch folder is deleted
    in the end.
    """
    storage, stopped = Storage(parcel["url"]), threading.Event()

    def save() -> None:
        while not stopped.wait(_SAVE_EVERY_S):
            try:
                storage.send(scratch, parcel["writes"], "worker", parcel["attempt"])
            except GeorefError as error:
                log.warning("Results were not copied to the storage; the next attempt is in a minute. %s", error)

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
    try:
        return path.resolve().relative_to(folder).as_posix()
    except ValueError:
        message = f"lies outside {folder}. With --storage all that a job reads lies in one folder."
        raise InputError("path-leaves-folder", message, path=path) from None
