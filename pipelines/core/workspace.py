"""Workspace directory: the contract between the stages.

Every stage owns one folder with a `manifest.json`. A stage writes into `<folder>.partial`, and the complete folder
is renamed: a killed stage leaves the previous product whole. The next writer completes or undoes an interrupted
rename. One writer at a time holds the workspace's lock.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, FiniteFloat, model_validator

from pipelines.core.cautions import Caution
from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.files import file_size
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
    """Record of how a product was made: inputs, resolved options, versions, time, and key figure.

    Attributes:
        format_version: version of the manifest's format.
        stage: the subcommand.
        config: resolved options by field.
        inputs: SHA-256 by product or flag, from `fingerprints`.
        versions: versions of this package and its libraries.
        started: UTC.
        duration_s: wall-clock time.
        key_figure: one line for tables.
        values: plain numbers and strings for `--json`.
        warnings: messages that the user should read.
        cautions: limits of the product, those of its inputs among them.
    """

    model_config = ConfigDict(extra="forbid")

    format_version: Literal[1] = 1
    stage: str
    config: dict[str, Any]
    inputs: dict[str, str]
    versions: dict[str, str]
    started: datetime
    duration_s: FiniteFloat
    key_figure: str
    values: dict[str, Any]
    warnings: list[str]
    cautions: tuple[Caution, ...] = ()

    @model_validator(mode="after")
    def _ends_in_the_calendar(self) -> Manifest:
        try:
            _ = self.finished
        except OverflowError as error:
            raise ValueError("duration_s: ends beyond the calendar") from error
        return self

    @property
    def finished(self) -> datetime:
        """Time at which the stage ended, UTC."""
        return self.started + timedelta(seconds=self.duration_s)


@dataclass(frozen=True)
class Summary:
    """Summary of a stage's result, for tables, `--json` and the log.

    Attributes:
        key_figure: one line for tables, e.g. "48 of 48 registered".
        values: plain numbers and strings for `--json`.
        warnings: messages that the user should read.
        cautions: limits of the product, those of its inputs among them.
    """

    key_figure: str
    values: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    cautions: tuple[Caution, ...] = ()


@dataclass(frozen=True)
class StageRun:
    """Run of one stage: the argument of its `run`, beside the options.

    Attributes:
        workspace: finished products of other stages, to be read through `workspace.path`.
        out: folder to write into; it becomes the stage's folder when complete.
        progress: shows the stage's tasks.
        resumed: whether `out` holds the partial product of an interrupted run with the same inputs and options.
    """

    workspace: Workspace
    out: Path
    progress: Progress = SILENT
    resumed: bool = False


@dataclass(frozen=True)
class Workspace:
    """Workspace directory, or a variant of one that shares some of its products.

    Attributes:
        root: the directory.
        base: for a variant, the workspace that it varies; that one holds the photographs, the cache and
            `georef.toml`.
        lent: for a variant, stage folders outside it, by name. The variant reads them and never writes them.
    """

    root: Path
    base: Workspace | None = None
    lent: Mapping[str, Path] = field(default_factory=dict, hash=False)

    def variant(self, place: str, lent: Mapping[str, Path]) -> Workspace:
        """Return a variant in the folder `place` of this workspace; some stages run in it with other options.

        Args:
            place: path relative to `root`.
            lent: by name, the folders of all stages that the variant reads but does not run.
        """
        return Workspace(self.root / place, self, lent)

    def path(self, product: str) -> Path:
        """Return the path of a finished product.

        Raises:
            MissingProductError: the product does not exist; names the command that makes it.
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
        """Return the path of the folder of photographs that a survey names."""
        return (self.base or self).root / image_dir

    @property
    def cache(self) -> Path:
        """Folder of files that can be made again (undistorted images)."""
        return (self.base or self).root / "cache"

    @property
    def config_file(self) -> Path:
        """Path of the workspace's `georef.toml`."""
        return (self.base or self).root / CONFIG_FILE

    def log_file(self, spec: StageSpec) -> Path:
        """Return the path of a stage's log."""
        return self.root / "logs" / f"{spec.name}.log"

    def manifest(self, spec: StageSpec) -> Manifest | None:
        """Return the manifest of a finished stage, or None.

        Raises:
            InputError: the manifest is damaged.
        """
        path = self._folder(spec.folder) / MANIFEST
        return load_json(Manifest, path) if path.exists() else None

    def placed_by_hand(self, spec: StageSpec) -> bool:
        """Return whether all products of a stage exist without a manifest."""
        folder = self.root / spec.folder
        return not (folder / MANIFEST).exists() and all((self.root / p).exists() for p in products_of(spec))

    def failure(self, spec: StageSpec) -> str | None:
        """Return the message with which the latest run of a stage failed, or None."""
        path = self.partial(spec) / FAILURE
        return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else None

    def partial(self, spec: StageSpec) -> Path:
        """Return the folder that a stage writes into until it is complete."""
        return self.root / f"{spec.folder}.partial"

    def _old(self, spec: StageSpec) -> Path:
        return self.root / f".{spec.folder}.old"

    @contextmanager
    def lock(self, activity: str) -> Iterator[None]:
        """Hold the lock of the workspace, and complete or undo the renames of a killed writer.

        Args:
            activity: the command that writes, for the error message of other processes.

        Raises:
            WorkspaceBusyError: another process holds the lock.
            InputError: the directory cannot be made or written.
        """
        with WriteLock(self.root).hold(activity):
            for spec in STAGES:
                self._recover(spec)
            yield

    def writer(self) -> str | None:
        """Return the activity of the process that is writing now (`train`), or None."""
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
            spec: the stage; only a resumable one can be continued.
            token: hash of the inputs and options of the run.
            resume: `never` begins afresh; `if-same` continues an interrupted run with the same token, and otherwise
                begins afresh; `always` does the same, but refuses an interrupted run with another token.

        Returns:
            The folder, and whether it holds a run to be continued.

        Raises:
            InputError: `resume` is `always`, and the interrupted run has another token.
        """
        partial = self.partial(spec)
        held = partial / TOKEN
        if spec.resumable and held.is_file() and resume != "never":
            if held.read_text(encoding="utf-8", errors="replace") == token:
                (partial / FAILURE).unlink(missing_ok=True)
                return partial, True
            if resume == "always":
                raise InputError(
                    "the interrupted run had other inputs or options: give those, or start afresh without --resume",
                    path=partial,
                )
        held.unlink(missing_ok=True)  # first, so that a half deleted run is never continued
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
        held.write_text(token, encoding="utf-8")
        return partial, False

    def fail(self, spec: StageSpec, message: str) -> None:
        """Record the message with which a stage failed."""
        (self.partial(spec) / FAILURE).write_text(message, encoding="utf-8")

    def commit(self, spec: StageSpec, manifest: Manifest) -> None:
        """Write the manifest, and rename the partial folder to the stage's folder."""
        partial = self.partial(spec)
        draft = partial / f"{MANIFEST}.tmp"
        save_json(manifest, draft)
        draft.replace(partial / MANIFEST)  # The manifest marks the folder as complete, even if the rename fails.
        self._swap(spec)

    def requests(self) -> dict[str, dict[str, Any]]:
        """Return the flags that stages were last requested with, by stage; `georef run` starts from them.

        Raises:
            InputError: `requests.json` is damaged.
        """
        path = self.root / REQUESTS
        if not path.exists():
            return {}
        file_size(path)
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise InputError("not valid JSON: delete it and give the options again", path=path) from error
        if not isinstance(document, dict) or not all(isinstance(flags, dict) for flags in document.values()):
            raise InputError("not a table of options by stage: delete it and give them again", path=path)
        return document

    def remember(self, flags: Mapping[str, Mapping[str, Any]]) -> None:
        """Record the flags that stages were requested with, by stage."""
        document = {**self.requests(), **{stage: dict(given) for stage, given in flags.items()}}
        replace_text(self.root / REQUESTS, json.dumps(document, indent=1, default=str) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file; an existing file is replaced when the new one is complete."""
    draft = path.with_suffix(".tmp")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def now() -> datetime:
    """Return the present time for manifests: UTC, whole seconds."""
    return datetime.now(UTC).replace(microsecond=0)
