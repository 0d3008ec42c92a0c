"""The workspace directory: the contract between the stages.

Every stage owns one folder with a `manifest.json`. A stage writes into `<folder>.partial` and the folder is
renamed when complete, so that a killed stage leaves the previous product whole; the next writer finishes or undoes
a rename that was cut off. One writer at a time holds the workspace's lock.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.lock import WriteLock
from pipelines.core.options import CONFIG_FILE
from pipelines.core.products import load_json, save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import STAGES, StageSpec, producer_of, products_of

MANIFEST = "manifest.json"
TOKEN = "token.txt"
FAILURE = "failure.txt"
REQUESTS = "requests.json"

Resume = Literal["never", "if-same", "always"]


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
    """A workspace directory.

    Attributes:
        root: the directory.
        base: of a variant, the workspace that it is a variant of: it has the photographs, the cache and
            `georef.toml`.
        lent: stage folders that a variant reads elsewhere, by name. It writes none of them.
    """

    root: Path
    base: Workspace | None = None
    lent: Mapping[str, Path] = field(default_factory=dict, hash=False)

    def variant(self, place: str, lent: Mapping[str, Path]) -> Workspace:
        """A workspace at `place` inside this one, in which some stages are run otherwise.

        Args:
            lent: the folders of all stages that are not run in it but read by it.
        """
        return Workspace(self.root / place, self, lent)

    def path(self, product: str) -> Path:
        """Absolute path of a finished product.

        Raises:
            MissingProductError: it is not there; names the command that makes it.
        """
        folder, _, inside = product.partition("/")
        path = self._folder(folder) / inside
        if not path.exists():
            name, home = producer_of(product).name, self.base or self
            raise MissingProductError(product, f"georef {'compare' if self.base else name} {home.root}")
        return path

    def _folder(self, name: str) -> Path:
        return self.lent.get(name, self.root / name)

    def photographs(self, image_dir: str) -> Path:
        """The folder of photographs that a survey names."""
        return (self.base or self).root / image_dir

    @property
    def cache(self) -> Path:
        """Folder of things that can be made again (undistorted images)."""
        return (self.base or self).root / "cache"

    @property
    def config_file(self) -> Path:
        """The workspace's `georef.toml`."""
        return (self.base or self).root / CONFIG_FILE

    def log_file(self, spec: StageSpec) -> Path:
        """Where the log of a stage is kept."""
        return self.root / "logs" / f"{spec.name}.log"

    def manifest(self, spec: StageSpec) -> Manifest | None:
        """The manifest of a finished stage, or None.

        Raises:
            InputError: it is damaged.
        """
        path = self._folder(spec.folder) / MANIFEST
        return load_json(Manifest, path) if path.exists() else None

    def placed_by_hand(self, spec: StageSpec) -> bool:
        """Whether all products of a stage are there, but no stage has made them."""
        folder = self.root / spec.folder
        return not (folder / MANIFEST).exists() and all((self.root / p).exists() for p in products_of(spec))

    def failure(self, spec: StageSpec) -> str | None:
        """The message with which the latest run of a stage failed, or None."""
        path = self.partial(spec) / FAILURE
        return path.read_text(encoding="utf-8") if path.exists() else None

    def partial(self, spec: StageSpec) -> Path:
        """Where a stage writes before it is complete."""
        return self.root / f"{spec.folder}.partial"

    def _old(self, spec: StageSpec) -> Path:
        return self.root / f".{spec.folder}.old"

    @contextmanager
    def lock(self, activity: str) -> Iterator[None]:
        """Hold the workspace for writing, and repair what a killed writer left.

        Args:
            activity: the command that writes, for those who find the workspace busy.

        Raises:
            WorkspaceBusyError: another process holds it.
            InputError: the directory cannot be made or written.
        """
        with WriteLock(self.root).hold(activity):
            for spec in STAGES:
                self._recover(spec)
            yield

    def writer(self) -> str | None:
        """The activity of the process that is writing now (`train`), or None."""
        return WriteLock(self.root).activity()

    def _recover(self, spec: StageSpec) -> None:
        final, old = self.root / spec.folder, self._old(spec)
        if (self.partial(spec) / MANIFEST).exists():  # complete: only the renames are missing
            self._swap(spec)
        elif old.exists() and not final.exists():
            old.rename(final)
        if old.exists():
            shutil.rmtree(old)

    def _swap(self, spec: StageSpec) -> None:
        final, old, partial = self.root / spec.folder, self._old(spec), self.partial(spec)
        (partial / TOKEN).unlink(missing_ok=True)
        if final.exists():
            if old.exists():
                shutil.rmtree(old)
            final.rename(old)
        partial.rename(final)
        if old.exists():
            shutil.rmtree(old)

    def begin(self, spec: StageSpec, token: str, resume: Resume) -> tuple[Path, bool]:
        """Open the partial folder of a stage: as an interrupted run left it, or empty.

        Args:
            token: stands for the inputs and options of the run.
            resume: continue an interrupted run never; if it had the same token, or else begin afresh; always, and
                refuse to begin afresh where one with another token is.

        Returns:
            The folder, and whether it is continued.

        Raises:
            InputError: there is an interrupted run that must be, and cannot be, continued.
        """
        partial = self.partial(spec)
        held = partial / TOKEN
        if spec.resumable and held.exists() and resume != "never":
            if held.read_text(encoding="utf-8") == token:
                (partial / FAILURE).unlink(missing_ok=True)
                return partial, True
            if resume == "always":
                raise InputError(
                    "the interrupted run had other inputs or options: give those, or start afresh without --resume",
                    path=partial,
                )
        held.unlink(missing_ok=True)  # first: a half deleted run must not be taken for one to continue
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
        held.write_text(token, encoding="utf-8")
        return partial, False

    def fail(self, spec: StageSpec, message: str) -> None:
        """Record why a stage could not be completed."""
        (self.partial(spec) / FAILURE).write_text(message, encoding="utf-8")

    def commit(self, spec: StageSpec, manifest: Manifest) -> None:
        """Make the partial folder the stage's product."""
        partial = self.partial(spec)
        draft = partial / f"{MANIFEST}.tmp"
        save_json(manifest, draft)
        draft.replace(partial / MANIFEST)  # from here on it counts as complete, whatever happens
        self._swap(spec)

    def requests(self) -> dict[str, dict[str, Any]]:
        """The flags that each stage was last asked for with, so that `georef run` can complete them.

        Raises:
            InputError: the file is damaged.
        """
        path = self.root / REQUESTS
        if not path.exists():
            return {}
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError("not valid JSON: delete it and give the options again", path=path) from error
        if not isinstance(document, dict) or not all(isinstance(flags, dict) for flags in document.values()):
            raise InputError("not a table of options by stage: delete it and give them again", path=path)
        return document

    def remember(self, flags: Mapping[str, Mapping[str, Any]]) -> None:
        """Record the flags that stages were asked for with, by stage."""
        document = {**self.requests(), **{stage: dict(given) for stage, given in flags.items()}}
        replace_text(self.root / REQUESTS, json.dumps(document, indent=1, default=str) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file; one that is there is replaced when the new one is complete."""
    draft = path.with_suffix(".tmp")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def now() -> datetime:
    """The time for manifests: UTC, seconds."""
    return datetime.now(UTC).replace(microsecond=0)
