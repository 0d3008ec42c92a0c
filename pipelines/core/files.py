"""Checks of input files before they are opened: what can be read to its end, and how much memory it asks for.

A named pipe blocks its reader until somebody writes, and a device may deliver bytes without end. Archives state how
large their content is: a few kilobytes can ask for gigabytes.
"""

from __future__ import annotations

import math
import stat
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError

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
    """Return the size of a regular file in bytes; symbolic links are followed.

    Args:
        path: of the file.
        limit_bytes: largest size that is accepted.
        kind: what the file is, for errors.
        field: option that names the file, for errors.

    Raises:
        InputError: no such file, a folder, pipe, socket or device, or a file larger than the limit.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"cannot be read: {reason}", path=path, field=field) from error
    if not stat.S_ISREG(status.st_mode):
        other = _SPECIAL.get(stat.S_IFMT(status.st_mode), "no regular file")
        raise InputError(f"cannot be read: it is {other}, give a file", path=path, field=field)
    if limit_bytes is not None and status.st_size > limit_bytes:
        size, limit = status.st_size / 2**20, limit_bytes / 2**20
        raise InputError(
            f"{size:.0f} MiB is too large for a {kind} (limit {limit:.0f} MiB)", path=path, field=field
        )
    return status.st_size


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read arrays of an NPZ file, without pickle.

    The header of each array is compared with the size of its entry before any data are read.

    Args:
        path: of the file.
        names: arrays to read; None for all.

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
                raise InputError(f"array {missing[0]!r} is missing", path=path)
            wanted = entries if names is None else {name: entries[name] for name in names}
            total = sum(entry.file_size for entry in wanted.values())
            if total > limit_bytes:
                raise ValueError(f"its arrays unpack to {total / 2**20:.0f} MiB (limit {limit_bytes / 2**20:.0f})")
            return {name: _read_array(archive, entry) for name, entry in wanted.items()}
    except InputError:
        raise
    except Exception as error:  # of zipfile, of its decompressors, and of Python's grammar, which reads the headers
        raise InputError(f"not a readable NPZ file: {error}", path=path) from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(entry) as stream:
        shape, dtype = _header(stream)
        body = entry.file_size - stream.tell()
    if dtype.hasobject:
        raise ValueError("Object arrays cannot be loaded when allow_pickle=False")
    promised = math.prod(shape) * dtype.itemsize
    if promised != body:
        raise ValueError(f"the header of {entry.filename} promises {promised} bytes, the entry holds {body}")
    with archive.open(entry) as stream:
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version} of NPY is unknown")
    shape, _, dtype = readers[version](stream)
    if any(not isinstance(length, int) or length < 0 for length in shape):
        raise ValueError(f"no array has the shape {shape}")
    return shape, dtype
