"""Files that survive a power failure: flushed to the disk before a name leads to them."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pipelines.core.errors import StorageError, storage_error

_PROBE_BYTES = 1 << 20


def replace_file(draft: Path, path: Path) -> None:
    """Rename a complete draft to `path`; after a power failure `path` is the old or the new file, whole.

    Raises:
        OSError: the draft cannot be flushed or renamed.
    """
    sync_file(draft)
    draft.replace(path)
    sync_folder(path.parent)


@contextmanager
def replacing(path: Path, draft: Path) -> Iterator[None]:
    """Rename a draft to `path` when it was written; one that cannot be completed keeps no room on a full disk.

    Raises:
        OSError: the file cannot be written; an existing one stays.
    """
    try:
        yield
        replace_file(draft, path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file; an existing file is replaced when the new one is complete.

    Raises:
        OSError: the file cannot be written; the existing one stays.
    """
    replace_texts({path: text})


def replace_texts(texts: Mapping[Path, str]) -> None:
    """Write text files; existing ones are replaced when all new ones are complete.

    Raises:
        OSError: a file cannot be written; the existing ones stay, and no draft is left.
    """
    drafts = {path: path.with_name(f"{path.name}.tmp") for path in texts}
    path = None
    try:
        for path, text in texts.items():
            drafts[path].write_text(text, encoding="utf-8", newline="")
            sync_file(drafts[path])
        for path, draft in drafts.items():
            draft.replace(path)
    except OSError as error:
        for draft in drafts.values():
            with contextlib.suppress(OSError):
                draft.unlink()
        error.filename = str(path)  # a full disk is noticed by `write`, which knows no name
        raise
    for folder in {path.parent for path in texts}:
        sync_folder(folder)


def replace_folder(draft: Path, folder: Path, aside: Path) -> None:
    """Rename a complete and flushed draft to `folder`; an existing folder is moved to `aside` first.

    If the draft cannot be renamed, the existing folder returns to its place.

    Raises:
        OSError: a folder cannot be renamed.
    """
    if folder.exists():
        remove(aside)
        folder.rename(aside)
    try:
        draft.rename(folder)
    except OSError:
        if aside.exists():
            aside.rename(folder)
        raise
    sync_folder(folder.parent)


def sync_file(path: Path) -> None:
    """Flush a file's content to the disk."""
    with path.open("r+b" if os.access(path, os.W_OK) else "rb") as handle:
        os.fsync(handle.fileno())


def sync_folder(path: Path) -> None:
    """Flush the names in a folder to the disk; Windows does so by itself."""
    if sys.platform == "win32":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush all files and folders below a folder, and itself, to the disk."""
    for path in folder.rglob("*"):
        if path.is_symlink():
            continue
        if path.is_dir():
            sync_folder(path)
        elif path.is_file():
            sync_file(path)
    sync_folder(folder)


def storage_failure_of(folder: Path) -> StorageError | None:
    """Return the failure that meets whoever writes a megabyte into a folder, or None."""
    try:
        with tempfile.TemporaryFile(dir=folder) as handle:
            handle.write(bytes(_PROBE_BYTES))
            handle.flush()
            os.fsync(handle.fileno())
    except OSError as error:
        error.filename = str(folder)
        return storage_error(error)
    return None


def remove(path: Path) -> None:
    """Remove a folder, a file, or a symbolic link but not its target; a missing path is no error."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)
