"""Copies of products outside the workspace: complete or absent, and never over a file by accident."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from pipelines.core.durable import remove, replace_file, replace_folder
from pipelines.core.errors import InputError, storage_failures
from pipelines.core.manifest import MANIFEST
from pipelines.core.stages import StageSpec
from pipelines.core.validators import require_text


def refuse_other_format(target: Path, spec: StageSpec, *, folder: bool) -> None:
    """Refuse a target whose name says another format than the stage writes, or a folder with other content.

    Args:
        target: path that the user gave.
        spec: the stage.
        folder: whether it delivers a folder.

    Raises:
        InputError: the suffix of the name is not that of the product, or the folder is not an older deliverable.
    """
    suffix = Path(spec.product).suffix
    if folder and target.is_dir() and not (target / Path(spec.product).name).exists():
        raise InputError(
            f"is a folder that {spec.name} did not write, and would be replaced: give a new name", path=target
        )
    if folder and target.suffix and not target.is_dir():
        raise InputError(f"{spec.name} writes a folder, not a {target.suffix} file: give a folder", path=target)
    if not folder and target.suffix.lower() != suffix:
        named = f"a {target.suffix} file" if target.suffix else "a name without a suffix"
        raise InputError(f"{spec.name} writes {suffix}, not {named}: end the name with {suffix}", path=target)


def check_target(target: Path, *, overwrite: bool) -> None:
    """Check, before the work begins, that its result can be written to `target`.

    Raises:
        InputError: the folder is missing, or the target exists and may not be replaced.
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


def deliver_folder(source: Path, target: Path) -> None:
    """Copy a stage's folder, without its manifest, to `target`, where it appears when it is complete.

    Raises:
        StorageError: the target cannot be written.
    """
    draft, aside = (target.with_name(f".{target.name}.{part}") for part in ("partial", "old"))
    try:
        with storage_failures():
            remove(draft)
            shutil.copytree(source, draft, ignore=shutil.ignore_patterns(MANIFEST))
            replace_folder(draft, target, aside)
    finally:
        with contextlib.suppress(OSError):
            remove(draft)
            if target.exists():
                remove(aside)


def _copy(family: list[Path], drafts: list[Path], targets: list[Path]) -> None:
    for member, draft in zip(family, drafts, strict=True):
        shutil.copyfile(member, draft)
    for draft, path in zip(drafts, targets, strict=True):
        replace_file(draft, path)
