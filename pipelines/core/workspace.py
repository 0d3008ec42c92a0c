"""Workspace directory: the contract between the stages.

Every stage owns one folder with a `manifest.json`. A stage writes into `<folder>.partial`, and the complete folder
is renamed: a killed stage leaves the previous product whole. The next writer completes or undoes an interrupted
rename. One writer at a time holds the workspace's lock.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from pipelines.core.child import ORPHAN_S
from pipelines.core.errors import InputError, MissingProductError, WorkspaceBusyError, storage_failures
from pipelines.core.files import remove, replace_file, replace_folder, replace_text, sync_tree
from pipelines.core.lock import WriteLock
from pipelines.core.manifest import MANIFEST, Manifest, Memo, damaged_files
from pipelines.core.options import CONFIG_FILE, REQUESTS
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import STAGES, StageSpec, producer_of, products_of

TOKEN = "token.txt"
FAILURE = "failure.txt"
PROGRESS = "progress.txt"
_MOST_TEXT_BYTES = 1 << 20


@dataclass(frozen=True)
class PartialProduct:
    """Folder `<stage folder>.partial`, which a stage writes into until its product is complete.

    It holds the request that the run was begun for, how far it came, and why it failed. The request, as a text, is
    the first file to be deleted: a half deleted folder is never continued.
    """

    folder: Path

    def is_of(self, token: str) -> bool:
        return _text(self.folder / TOKEN) == token

    def request(self) -> tuple[dict[str, Any], dict[str, str]] | None:
        """Return options and fingerprints of the inputs of the run; None if they cannot be read."""
        try:
            config, inputs = json.loads(_text(self.folder / TOKEN) or "")
        except (ValueError, TypeError, RecursionError):
            return None
        return (config, inputs) if isinstance(config, dict) and isinstance(inputs, dict) else None

    def progress(self) -> str | None:
        """Return how far an interrupted run came; None if nothing of it is worth keeping."""
        return _text(self.folder / PROGRESS)

    def how_far(self) -> str:
        """Return how far the run came, and when (`1500 of 7000 iterations, 12 min, saved 2026-05-01 14:30`)."""
        progress = self.progress()
        verb, note = ("begun", TOKEN) if progress is None else (f"{progress}, saved", PROGRESS)
        with contextlib.suppress(OSError):
            moment = datetime.fromtimestamp((self.folder / note).stat().st_mtime).astimezone()
            return f"{verb} {moment:%Y-%m-%d %H:%M}"
        return progress or "half deleted"

    def failure(self) -> str | None:
        """Return the message with which the run failed, or None; a full disk leaves an empty file."""
        return _text(self.folder / FAILURE) or None

    def is_worthless(self) -> bool:
        """Return whether the run failed with nothing worth keeping."""
        return self.failure() is not None and self.progress() is None

    def fail(self, message: str, *, worthless: bool = False) -> None:
        """Record the message with which the run failed; what a worthless run has done may be dropped unasked."""
        with contextlib.suppress(OSError):  # A full disk has no room even for that.
            if worthless:
                (self.folder / PROGRESS).unlink(missing_ok=True)
            (self.folder / FAILURE).write_text(message, encoding="utf-8", errors="backslashreplace")

    def begin(self, token: str) -> None:
        """Make the folder anew for a request."""
        if self.folder.is_dir() and not self.folder.is_symlink():
            (self.folder / TOKEN).unlink(missing_ok=True)
        remove(self.folder)
        self.folder.mkdir(parents=True)
        (self.folder / TOKEN).write_text(token, encoding="utf-8")

    def go_on(self, token: str, *, insist: bool) -> bool:
        """Return whether to go on with a run for this request, and forget its failure; `insist` refuses another."""
        if self.folder.is_symlink() or not (self.folder / TOKEN).is_file():
            return False
        if self.is_of(token):
            (self.folder / FAILURE).unlink(missing_ok=True)
            return True
        if insist:
            message = "holds an interrupted run with other inputs or options."
            remedy = "Give those, or start afresh with --force."
            raise InputError("interrupted-run-differs", message, path=self.folder, remedy=remedy)
        return False


def _text(path: Path) -> str | None:
    try:
        if not path.is_file() or path.stat().st_size > _MOST_TEXT_BYTES:
            return None
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None


DAMAGED = "damaged"

Resume = Literal["never", "if-same", "always"]


@dataclass(frozen=True)
class Summary:
    """Summary of a stage's result, for tables, `--json` and the log.

    The key figure is one line such as "48 of 48 registered". The cautions are those of the inputs too. The
    assumptions stand for what the input does not state; a manifest has none, as they stand in the survey.
    """

    key_figure: str
    values: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[Remark, ...] = ()
    cautions: tuple[Remark, ...] = ()
    assumptions: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class StageRun:
    """Run of one stage: the argument of its `run`, beside the options.

    Attributes:
        workspace: finished products of other stages, to be read through `workspace.path`.
        out: folder to write into; it becomes the stage's folder when complete.
        resumed: whether `out` holds the partial product of an interrupted run with the same inputs and options.
        extends: the stage's finished folder, made from the same inputs with smaller values of its growing options;
            the run may start from it, and does not change it. None: there is none.
        afresh: whether nothing that earlier runs have left may be taken over.
    """

    workspace: Workspace
    out: Path
    progress: Progress = SILENT
    resumed: bool = False
    extends: Path | None = None
    afresh: bool = False

    def record_progress(self, text: str) -> None:
        """Record how far the run has come (`1500 of 7000 iterations`): from now on it is not dropped unasked."""
        replace_text(self.out / PROGRESS, text)


@dataclass(frozen=True)
class Workspace:
    """Workspace directory, or a variant of one that shares some of its products.

    Attributes:
        base: for a variant, the workspace that it varies; that one holds the photographs, the cache and
            `georef.toml`.
        lent: for a variant, stage folders outside it, by name. The variant reads them and never writes them.
        command: for a variant, the command that makes its products.
        outside: for a workspace that cannot be written, the folder that takes all that a stage writes.
        hidden: stage folders that are read as if they did not exist.
    """

    root: Path
    base: Workspace | None = None
    lent: Mapping[str, Path] = field(default_factory=dict, hash=False)
    command: str = ""
    outside: Path | None = None
    hidden: frozenset[str] = frozenset()

    def path(self, product: str) -> Path:
        """Return the path of a finished product; a MissingProductError names the command that makes it."""
        folder, _, inside = product.partition("/")
        path = self._folder(folder) / inside
        if folder in self.hidden or not path.exists():
            raise MissingProductError(product, self.command_of(producer_of(product)))
        return path

    def has(self, product: str) -> bool:
        folder, _, inside = product.partition("/")
        return folder not in self.hidden and (self._folder(folder) / inside).exists()

    def without(self, *specs: StageSpec) -> Workspace:
        """Return the workspace as if these stages had made nothing, to be read."""
        return replace(self, hidden=self.hidden.union(spec.folder for spec in specs))

    def command_of(self, spec: StageSpec) -> str:
        home = (self.base or self).root
        return f"georef {self.command} {home}" if self.command else spec.command(home)

    def _folder(self, name: str) -> Path:
        return self.lent.get(name, self.root / name)

    @property
    def cache(self) -> Path:
        """Folder of files that can be made again (undistorted images)."""
        return (self.outside or (self.base or self).root) / "cache"

    @property
    def config_file(self) -> Path:
        return (self.base or self).root / CONFIG_FILE

    @property
    def written(self) -> Path:
        """Folder that stages write into."""
        return self.outside or self.root

    def is_writable(self) -> bool:
        """Return whether a stage could write here, or another process does."""
        try:
            with WriteLock(self.root).hold("look whether it can be written"):
                return True
        except WorkspaceBusyError:
            return True
        except InputError:
            return False

    def log_file(self, spec: StageSpec) -> Path:
        return self.written / "logs" / f"{spec.name}.log"

    def manifest(self, spec: StageSpec) -> Manifest | None:
        """Return the manifest of a finished stage, or None; an InputError: it is damaged."""
        path = self._folder(spec.folder) / MANIFEST
        return load_json(Manifest, path) if path.exists() and spec.folder not in self.hidden else None

    def placed_by_hand(self, spec: StageSpec) -> bool:
        """Return whether all products of a stage exist without a manifest."""
        folder = self.root / spec.folder
        return not (folder / MANIFEST).exists() and all((self.root / p).exists() for p in products_of(spec))

    def partial(self, spec: StageSpec) -> Path:
        """Return the folder that a stage writes into until it is complete."""
        return self.written / f"{spec.folder}.partial"

    def partial_product(self, spec: StageSpec) -> PartialProduct:
        """Return the partial product of a stage, which may not exist."""
        return PartialProduct(self.partial(spec))

    @contextmanager
    def lock(self, activity: str) -> Iterator[None]:
        """Hold the lock of the workspace, and complete or undo the renames of a killed writer.

        Errors as of `WriteLock.hold`; and a StorageError: the disk failed while the lock was held.
        """
        with storage_failures(self.written), WriteLock(self.written).hold(activity, ORPHAN_S):
            for spec in STAGES:
                final, old = self.written / spec.folder, self.written / f".{spec.folder}.old"
                if (self.partial(spec) / MANIFEST).exists():  # complete: only the renames are missing
                    self._swap(spec)
                elif old.exists() and not final.exists():
                    old.rename(final)
                remove(old)
            yield

    def has_product(self) -> bool:
        """Return whether a stage has ended here, or its folder was put here by hand."""
        return any((self.root / spec.folder).exists() for spec in STAGES)

    def has_begun(self) -> bool:
        """Return whether a command has been at work here."""
        begun = (self.root / REQUESTS, *(self.partial(spec) for spec in STAGES))
        return self.has_product() or any(path.exists() for path in begun)

    def _swap(self, spec: StageSpec) -> None:
        final, old, partial = self.written / spec.folder, self.written / f".{spec.folder}.old", self.partial(spec)
        _refuse_what_is_no_folder(final)
        for name in (TOKEN, PROGRESS):
            (partial / name).unlink(missing_ok=True)
        replace_folder(partial, final, old)
        remove(old)

    def begin(self, spec: StageSpec, token: str, resume: Resume) -> tuple[Path, bool]:
        """Open the partial folder of a stage; return it, and whether it holds an interrupted run to be continued.

        Args:
            spec: the stage; only a resumable one can be continued.
            token: text of the request, from `Request.token`.
            resume: `never` begins afresh; `if-same` continues an interrupted run with the same token, and otherwise
                begins afresh; `always` does the same, but refuses an interrupted run with another token.

        Raises:
            InputError: `resume` refuses the interrupted run, or the stage's folder is a symbolic link or a file.
        """
        partial = self.partial_product(spec)
        _refuse_what_is_no_folder(self.written / spec.folder)
        if spec.resumable and resume != "never" and partial.go_on(token, insist=resume == "always"):
            return partial.folder, True
        partial.begin(token)
        return partial.folder, False

    def commit(self, spec: StageSpec, manifest: Manifest) -> None:
        """Write the manifest, flush all to the disk, and rename the partial folder to the stage's folder."""
        partial = self.partial(spec)
        draft = partial / f"{MANIFEST}.tmp"
        save_json(manifest, draft)
        sync_tree(partial)
        replace_file(draft, partial / MANIFEST)  # It marks the folder as complete, even if the next rename fails.
        self._swap(spec)

    def damaged(self, spec: StageSpec, manifest: Manifest, memo: Memo, *, by_content: bool) -> list[str]:
        """Return the files of a finished product, by workspace path, that are damaged; see `damaged_files`."""
        names = damaged_files(self._folder(spec.folder), manifest, memo, by_content=by_content)
        return [f"{spec.folder}/{name}" for name in names]

    def set_aside(self, product_files: Sequence[str]) -> None:
        """Move files of a product into `damaged/`, under their workspace paths: they may be edits of the user."""
        for name in product_files if self.outside is None else ():  # else nothing takes their place
            target = self.root / DAMAGED / name
            target.parent.mkdir(parents=True, exist_ok=True)
            (self.root / name).replace(target)


def _refuse_what_is_no_folder(folder: Path) -> None:
    if folder.is_symlink():
        message = "is a symbolic link, and a stage replaces its folder as a whole."
        remedy = "Put the folder itself there, or the whole workspace on the other disk."
        raise InputError("stage-folder-is-link", message, path=folder, remedy=remedy)
    if folder.exists() and not folder.is_dir():
        raise InputError(
            "stage-folder-is-file",
            "is a file where the stage's folder belongs.",
            path=folder,
            remedy="Move it away.",
        )
