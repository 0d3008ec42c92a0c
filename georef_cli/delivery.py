"""Copies of products outside the workspace: never half written, never over a file by accident."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from pipelines.errors import InputError


def check_target(target: Path, *, overwrite: bool) -> None:
    """See before the work begins that its result can be put at `target`.

    Raises:
        InputError: the folder is missing, or the file exists and may not be replaced.
    """
    if not target.parent.is_dir():
        raise InputError("no such folder: make it first", path=target.parent)
    if target.exists() and not overwrite:
        raise InputError("exists already: --force replaces it", path=target)


def deliver(sources: Sequence[Path], targets: Sequence[Path]) -> None:
    """Copy files; a target appears, or is replaced, only when all copies are complete.

    Raises:
        InputError: a target cannot be written.
    """
    drafts = [target.with_name(f".{target.name}.partial") for target in targets]
    try:
        for source, draft in zip(sources, drafts, strict=True):
            shutil.copyfile(source, draft)
        for draft, target in zip(drafts, targets, strict=True):
            draft.replace(target)
    except PermissionError as error:
        raise InputError("cannot be written", path=targets[0].parent) from error
    finally:
        for draft in drafts:
            draft.unlink(missing_ok=True)
