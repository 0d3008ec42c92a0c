"""Files that survive a power failure, flushed before a name leads to them; and checks before files are read.

A named pipe blocks its reader until somebody writes, and a device may deliver bytes without end. Archives state how
large their content is: a few kilobytes can ask for gigabytes.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import stat
import sys
import tempfile
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from pipelines.core.errors import InputError, StorageError, storage_error

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PROBE_BYTES = 1 << 20


def replace_file(draft: Path, path: Path) -> None:
    """Rename a complete draft to `path`; after a power failure `path` is the old or the new file, whole."""
    sync_file(draft)
    draft.replace(path)
    sync_folder(path.parent)


@contextmanager
def replacing(path: Path, draft: Path | None = None) -> Iterator[Path]:
    """Yield a draft, by default `NAME.tmp` beside `path`, and rename it to `path` when it was written.

    One that cannot be completed keeps no room on a full disk.
    """
    draft = draft or path.with_name(f"{path.name}.tmp")
    try:
        yield draft
        replace_file(draft, path)
    except BaseException:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise


def replace_text(path: Path, text: str) -> None:
    """Write a text file; an existing file is replaced when the new one is complete."""
    replace_texts({path: text})


def replace_texts(texts: Mapping[Path, str]) -> None:
    """Write text files; existing ones are replaced when all new ones are complete, and otherwise stay."""
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
    """Write a file's data to the disk.

    Raises:
        OSError: the file cannot be opened or written.
    """
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


_SPECIAL = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}
# Float32 images and depth maps compress by a factor of two, index arrays by up to eight; more is a forgery.
_MOST_UNPACKED, _SMALL_BYTES = 8, 256 * 1024 * 1024


def file_size(path: Path, *, limit_bytes: int | None = None, kind: str = "file", field: str | None = None) -> int:
    """Return the size of a regular file in bytes, links followed; an InputError: it is none, or above the limit.

    Errors name the kind of the file, and the option that names it.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError("file-unreadable", f"cannot be read: {reason}.", path=path, field=field) from error
    if not stat.S_ISREG(status.st_mode):
        other = _SPECIAL.get(stat.S_IFMT(status.st_mode), "not a regular file")
        raise InputError(
            "not-a-file", f"cannot be read: it is {other}.", path=path, field=field, remedy="Give a file."
        )
    if limit_bytes is not None and status.st_size > limit_bytes:
        size, limit = status.st_size / 2**20, limit_bytes / 2**20
        message = f"is too large for a {kind}: {size:.0f} MiB (limit {limit:.0f} MiB)."
        raise InputError("file-too-large", message, path=path, field=field)
    return status.st_size


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of the system while a file is read into an `InputError` of the file."""
    try:
        yield
    except OSError as error:
        raise InputError("file-unreadable", f"cannot be read: {error.strerror}", path=path) from error


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an NPZ file, or all, without pickle.

    The header of each array is compared with the size of its entry before any data are read.

    Raises:
        InputError: unreadable, without one of the arrays, of objects, or with arrays that unpack to more than eight
            times the file (and 256 MiB).
    """
    limit_bytes = max(_SMALL_BYTES, _MOST_UNPACKED * file_size(path))
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            missing = [name for name in names or () if name not in entries]
            if missing:
                raise InputError("array-missing", f"has no array {missing[0]!r}.", path=path)
            wanted = entries if names is None else {name: entries[name] for name in names}
            total = sum(entry.file_size for entry in wanted.values())
            if total > limit_bytes:
                raise ValueError(f"its arrays unpack to {total / 2**20:.0f} MiB (limit {limit_bytes / 2**20:.0f})")
            return {name: _read_array(archive, entry) for name, entry in wanted.items()}
    except InputError:
        raise
    except Exception as error:  # of zipfile, of its decompressors, and of Python's grammar, which reads the headers
        raise InputError("npz-damaged", f"is not a readable NPZ file: {error}", path=path) from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    from numpy.lib import format as npy

    with archive.open(entry) as stream:
        shape, dtype = _header(stream)
        body = entry.file_size - stream.tell()
    if dtype.hasobject:
        raise ValueError("Object arrays cannot be loaded when allow_pickle=False")
    promised = math.prod(shape) * dtype.itemsize
    if promised != body:
        raise ValueError(f"the header of {entry.filename} promises {promised} bytes, the entry holds {body}")
    with archive.open(entry) as stream:
        array: NDArray[Any] = npy.read_array(stream, allow_pickle=False)
    return array


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    from numpy.lib import format as npy  # numpy costs time, and every command imports this file

    version = npy.read_magic(stream)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version} of NPY is unknown")
    shape, _, dtype = readers[version](stream)
    if any(not isinstance(length, int) or length < 0 for length in shape):
        raise ValueError(f"no array has the shape {shape}")
    return shape, dtype
