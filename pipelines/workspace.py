"""The workspace directory: the contract between the stages.

Every stage owns one folder with a `manifest.json`. A stage writes into `<folder>.partial` and the folder is
renamed when complete, so that a killed stage leaves the previous product whole; `recover` finishes or undoes a
rename that was cut off. One writer at a time holds an advisory lock, which the system drops when it dies.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from pipelines.config import CONFIG_FILE, InputMarker, StageConfig
from pipelines.errors import InputError, MissingProductError, WorkspaceBusyError
from pipelines.products import load_json, save_json
from pipelines.progress import SILENT, Progress
from pipelines.stages import PIPELINE, StageSpec, producer_of

MANIFEST = "manifest.json"
TOKEN = "token.txt"
REQUESTS = "requests.json"
LOCK = ".lock"


class Manifest(BaseModel):
    """What made a stage's product: inputs, resolved options, versions, time, and its headline."""

    model_config = ConfigDict(extra="forbid")

    format_version: Literal[1] = 1
    stage: str
    config: dict[str, Any]
    inputs: dict[str, str]
    versions: dict[str, str]
    started: datetime
    duration_s: float
    key_figure: str
    values: dict[str, Any]
    warnings: list[str]


@dataclass(frozen=True)
class Summary:
    """What a stage says of its result.

    Attributes:
        key_figure: the headline for tables, e.g. "48 of 48 registered".
        values: plain numbers and strings for `--json`.
        warnings: what the user should look at.
    """

    key_figure: str
    values: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class StageRun:
    """What a stage is handed: where to read, where to write, whom to tell.

    Attributes:
        workspace: read finished products of other stages through `workspace.path`.
        out: the folder to write into; becomes the stage's folder when complete.
        progress: whom to tell of progress.
        resumed: whether `out` holds the partial product of an interrupted run with the same inputs and options.
    """

    workspace: Workspace
    out: Path
    progress: Progress = SILENT
    resumed: bool = False


@dataclass(frozen=True)
class Workspace:
    """A workspace directory."""

    root: Path

    def path(self, product: str) -> Path:
        """Absolute path of a finished product.

        Raises:
            MissingProductError: it is not there; names the command that makes it.
        """
        path = self.root / product
        if not path.exists():
            raise MissingProductError(product, f"georef {producer_of(product).name} {self.root}")
        return path

    @property
    def cache(self) -> Path:
        """Folder of things that can be made again (undistorted images)."""
        return self.root / "cache"

    @property
    def config_file(self) -> Path:
        """The workspace's `georef.toml`."""
        return self.root / CONFIG_FILE

    def manifest(self, spec: StageSpec) -> Manifest | None:
        """The manifest of a finished stage, or None."""
        path = self.root / spec.folder / MANIFEST
        return load_json(Manifest, path) if path.exists() else None

    def partial(self, spec: StageSpec) -> Path:
        """Where a stage writes before it is complete."""
        return self.root / f"{spec.folder}.partial"

    def _old(self, spec: StageSpec) -> Path:
        return self.root / f".{spec.folder}.old"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace for writing, and repair what a killed writer left.

        Raises:
            WorkspaceBusyError: another process holds it.
            InputError: the directory cannot be made or written.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            handle = (self.root / LOCK).open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot be used as a workspace: {error.strerror}", path=self.root) from error
        with handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                handle.seek(0)
                holder = handle.read().strip() or "another process"
                raise WorkspaceBusyError(
                    f"{self.root} is being written by {holder}: wait for it, or stop it"
                ) from None
            handle.truncate(0)
            handle.write(f"process {os.getpid()}")
            handle.flush()
            for spec in PIPELINE:
                self._recover(spec)
            yield

    def _recover(self, spec: StageSpec) -> None:
        final, partial, old = self.root / spec.folder, self.partial(spec), self._old(spec)
        if (partial / MANIFEST).exists():  # complete: only the renames are missing
            self._swap(spec)
        elif old.exists() and not final.exists():
            old.rename(final)
        if old.exists():
            shutil.rmtree(old)

    def _swap(self, spec: StageSpec) -> None:
        final, old = self.root / spec.folder, self._old(spec)
        if final.exists():
            if old.exists():
                shutil.rmtree(old)
            final.rename(old)
        self.partial(spec).rename(final)
        if old.exists():
            shutil.rmtree(old)

    def begin(self, spec: StageSpec, token: str, *, resume: bool) -> tuple[Path, bool]:
        """Open the partial folder of a stage: continued if `resume` and `token` fits, else empty.

        Returns:
            The folder, and whether it is continued.
        """
        partial = self.partial(spec)
        held = partial / TOKEN
        if resume and spec.resumable and held.exists() and held.read_text(encoding="utf-8") == token:
            return partial, True
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
        held.write_text(token, encoding="utf-8")
        return partial, False

    def commit(self, spec: StageSpec, manifest: Manifest) -> None:
        """Make the partial folder the stage's product."""
        partial = self.partial(spec)
        (partial / TOKEN).unlink(missing_ok=True)
        draft = partial / f"{MANIFEST}.tmp"
        save_json(manifest, draft)
        draft.rename(partial / MANIFEST)
        self._swap(spec)

    def requests(self) -> dict[str, dict[str, Any]]:
        """The flags that each stage was last asked for with, so that `georef run` can complete them."""
        path = self.root / REQUESTS
        if not path.exists():
            return {}
        try:
            document: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise InputError("not valid JSON: delete it and give the options again", path=path) from error
        return document

    def remember(self, stage: str, flags: dict[str, Any]) -> None:
        """Record the flags that a stage was asked for with."""
        document = {**self.requests(), stage: flags}
        path = self.root / REQUESTS
        draft = path.with_suffix(".tmp")
        draft.write_text(json.dumps(document, indent=1, default=str) + "\n", encoding="utf-8")
        draft.rename(path)


def now() -> datetime:
    """The time for manifests: UTC, seconds."""
    return datetime.now(UTC).replace(microsecond=0)


def fingerprints(workspace: Workspace, spec: StageSpec, config: StageConfig) -> dict[str, str]:
    """Hashes of everything that decides a stage's result.

    Workspace products by content; files that the options name by content, folders that they name by the name,
    size and modification time of each file (reading gigabytes of photographs at each look would be too slow).

    Raises:
        MissingProductError: a product is not there.
        InputError: a path that an option names does not exist.
    """
    found = {product: _hash_product(workspace.path(product)) for product in spec.reads}
    for name, info in type(config).model_fields.items():
        value = getattr(config, name)
        if value is None or not any(isinstance(mark, InputMarker) for mark in _metadata(info)):
            continue
        path = Path(value)
        if not path.exists():
            raise InputError("no such file or folder", path=path, field="--" + name.replace("_", "-"))
        found[f"--{name}"] = _hash_file(path) if path.is_file() else _hash_listing(path)
    return found


def _metadata(info: Any) -> list[Any]:
    """Markers of a field, also where `InputPath | None` hides them in the union's members."""
    members = getattr(info.annotation, "__args__", ())
    return [*info.metadata, *(mark for member in members for mark in getattr(member, "__metadata__", ()))]


def _hash_file(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _hash_product(path: Path) -> str:
    if path.is_file():
        return _hash_file(path)
    digest = hashlib.sha256()
    for file in sorted(file for file in path.rglob("*") if file.is_file()):
        digest.update(f"{file.relative_to(path)}={_hash_file(file)}\n".encode())
    return digest.hexdigest()


def _hash_listing(path: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(file for file in path.rglob("*") if file.is_file()):
        stat = file.stat()
        digest.update(f"{file.relative_to(path)} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()
