"""Copies of products outside the workspace: complete or absent, and never over a file by accident."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from pipelines.core.durable import replace_file
from pipelines.core.errors import InputError, storage_failures
from pipelines.core.validators import require_text


def check_target(target: Path, *, overwrite: bool) -> None:
    """Check, before the work begins, that its result can be written to `target`.

    Raises:
        InputError: the folder is missing, or the file exists and may not be replaced.
    """
    require_text(target)
    if not target.parent.is_dir():
        raise InputError("no such folder: make it first", path=target.parent)
    if target.exists() and not overwrite:
        raise InputError("exists already: --force replaces it", path=target)


def deliver(source: Path, target: Path) -> None:
    """Copy a file and its sidecars (`source.*`) to `target`.

    The copies appear, or replace older files, when all of them are complete.

    Raises:
        StorageError: the target cannot be written.
    """
    family = sorted(source.parent.glob(f"{source.name}*"))
    targets = [target.with_name(target.name + member.name.removeprefix(source.name)) for member in family]
    drafts = [path.with_name(f".{path.name}.partial") for path in targets]
    try:
        with storage_failures():
            _copy(family, drafts, targets)
    finally:
        for draft in drafts:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)


def _copy(family: list[Path], drafts: list[Path], targets: list[Path]) -> None:
    for member, draft in zip(family, drafts, strict=True):
        shutil.copyfile(member, draft)
    for draft, path in zip(drafts, targets, strict=True):
        replace_file(draft, path)
