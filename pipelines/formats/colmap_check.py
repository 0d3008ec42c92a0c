"""Check of a COLMAP model before COLMAP reads it: every count fits the file, and every reference exists.

COLMAP trusts the counts in its binary files. A forged track length of 2³⁶ is read for ever, past the end of the
file. Layouts after `reconstruction_io_binary.cc` and `reconstruction_io_text.cc` of COLMAP 4.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.files import file_size

FILES = ("rigs", "cameras", "frames", "images", "points3D")
_REQUIRED = ("cameras", "images", "points3D")
_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_LONGEST_NAME = 4096
# Parameters of COLMAP's camera models by number of the model, from SIMPLE_PINHOLE on.
_CAMERA_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_INVALID_CAMERA = "has a camera model that is unknown"
_INVALID_NAME = "has a name that is not UTF-8"


class _CutOffError(ValueError):
    """A record that reaches beyond the end of its file."""


def check_model_files(folder: Path) -> None:
    """Refuse a COLMAP model, binary or text, whose files do not hold what they state.

    Raises:
        InputError: no model, not regular files, or counts and sizes that disagree; names the file.
    """
    if not folder.is_dir():
        raise InputError("no such folder; expected a COLMAP model (cameras, images, points3D)", path=folder)
    suffix = next((s for s in (".bin", ".txt") if all((folder / (n + s)).exists() for n in _REQUIRED)), None)
    if suffix is None:
        raise InputError(
            "not a readable COLMAP model: cameras, images and points3D, all .bin or all .txt, are needed",
            path=folder,
        )
    for name in FILES:
        file = folder / (name + suffix)
        if not file.exists():
            continue
        size = file_size(file)
        if suffix == ".bin":
            _check_binary(file, size, _RECORDS[name])
        elif name == "images":
            _check_text(file)


def _check_binary(file: Path, size: int, record_end: Callable[[_Bytes, int], int]) -> None:
    cut_off = "shorter than the number of its records says: it is truncated, copy it again"
    if size < 8:
        raise InputError(cut_off, path=file)
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        record = _Bytes(data, size)
        (count,) = struct.unpack_from("<Q", data)
        if count > size:
            raise InputError(cut_off, path=file)
        at = 8
        for number in range(count):
            try:
                at = record_end(record, at)
            except _CutOffError as error:
                raise InputError(f"{cut_off} (record {number + 1} of {count})", path=file) from error
            except ValueError as error:
                raise InputError(f"record {number + 1} of {count} {error}: it is damaged", path=file) from error
        if at != size:
            raise InputError(f"has {size - at} bytes behind its {count} records: it is damaged", path=file)


def _check_text(file: Path) -> None:
    with file.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                raise InputError(_INVALID_NAME, path=file, line=number) from error


@dataclass(frozen=True)
class _Bytes:
    """Content of a file, read within its size."""

    data: mmap.mmap
    size: int

    def unsigned(self, at: int, width: int) -> int:
        self.end(at + width)
        return int.from_bytes(self.data[at : at + width], "little")

    def end(self, at: int) -> int:
        """Return the end of a record, which lies inside the file."""
        if at > self.size:
            raise _CutOffError
        return at


def _camera(record: _Bytes, at: int) -> int:
    model = record.unsigned(at + 4, 4)
    if model >= len(_CAMERA_PARAMS):
        raise ValueError(_INVALID_CAMERA)
    return record.end(at + 24 + 8 * _CAMERA_PARAMS[model])


def _image(record: _Bytes, at: int) -> int:
    name_at = at + 64
    name_end = record.data.find(b"\0", name_at, min(record.size, name_at + _LONGEST_NAME))
    if name_end < 0:
        raise _CutOffError
    try:
        record.data[name_at:name_end].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(_INVALID_NAME) from error
    return record.end(name_end + 9 + _OBSERVATION_BYTES * record.unsigned(name_end + 1, 8))


def _point(record: _Bytes, at: int) -> int:
    return record.end(at + 51 + _TRACK_BYTES * record.unsigned(at + 43, 8))


def _frame(record: _Bytes, at: int) -> int:
    return record.end(at + 68 + 16 * record.unsigned(at + 64, 4))


def _rig(record: _Bytes, at: int) -> int:
    sensors = record.unsigned(at + 4, 4)
    at = record.end(at + 8 + (8 if sensors else 0))
    if sensors > record.size:
        raise _CutOffError
    for _ in range(sensors - 1):
        at = record.end(at + 9 + (56 if record.unsigned(at + 8, 1) else 0))
    return at


_RECORDS: dict[str, Callable[[_Bytes, int], int]] = {
    "rigs": _rig, "cameras": _camera, "frames": _frame, "images": _image, "points3D": _point,
}  # fmt: skip
