"""PLY files of points, read in chunks: binary, with the vertices first.

A PLY has no CRS. Faces and other elements after the vertices are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.formats.cloud_chunk import CloudChunk

_HEADER_LIMIT = 64 * 1024
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
    "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_CLASS_NAMES = ("classification", "scalar_Classification", "scalar_classification")
_TIME_NAMES = ("gps_time", "scalar_GpsTime", "GpsTime")
_COARSEST_M = 5e-4  # half a step of float32 coordinates that is still exact enough


@dataclass(frozen=True)
class PlyCloudFile:
    """PLY file of points; see `CloudFile`.

    Attributes:
        dtype: of a vertex.
        offset: of the first vertex in the file.
    """

    path: Path
    count: int
    dtype: np.dtype[np.void]
    offset: int
    crs: str | None = None

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`.

        Raises:
            InputError: coordinates are too large for the precision of their type.
        """
        rows = np.memmap(self.path, dtype=self.dtype, mode="r", offset=self.offset, shape=(self.count,))
        for first in range(0, self.count, size):
            part = rows[first : first + size]
            position = np.column_stack([part[axis] for axis in "xyz"]).astype(np.float64)
            self._check_precision(position)
            classes = self._column(part, _CLASS_NAMES)
            none = np.zeros(len(part), dtype=bool)
            yield CloudChunk(
                position,
                np.zeros(len(part), np.uint8) if classes is None else np.clip(classes, 0, 255).astype(np.uint8),
                none,
                none,
                self._column(part, _TIME_NAMES),
            )

    def _column(self, part: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
        known = [name for name in names if name in (self.dtype.names or ())]
        return part[known[0]].astype(np.float64) if known else None

    def _check_precision(self, position: np.ndarray) -> None:
        if self.dtype["x"].itemsize == 8:
            return
        largest = float(np.nanmax(np.abs(position), initial=0.0))
        if np.isfinite(largest) and np.spacing(np.float32(largest)) / 2 > _COARSEST_M:
            raise InputError(
                f"coordinates of {largest:.0f} in single precision are rounded to "
                f"{np.spacing(np.float32(largest)):.3f}: write the PLY with double coordinates, or LAZ",
                path=self.path,
            )


def open_cloud_ply(path: Path) -> PlyCloudFile:
    """Return a PLY file of points whose header agrees with its size.

    Raises:
        InputError: no such file, not a binary PLY, without coordinates, or cut off.
    """
    size = file_size(path)
    with path.open("rb") as stream:
        start = stream.read(_HEADER_LIMIT)
    head, end, rest = start.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not end or lines[:1] != [["ply"]]:
        raise InputError("not a PLY file", path=path)
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    if form not in _ORDERS:
        raise InputError(f"a PLY of format {form[:30]!r}: write it as binary_little_endian", path=path)
    count, columns = _vertices(path, lines)
    dtype = np.dtype([(name, _ORDERS[form] + kind) for name, kind in columns])
    offset = len(head) + len(end) + (2 if rest[:1] == b"\r" else 1)
    if count < 1 or offset + count * dtype.itemsize > size:
        raise InputError(
            f"the header promises {count} points of {dtype.itemsize} bytes, the file has {max(size - offset, 0)}: "
            "it is empty, cut off or damaged",
            path=path,
        )
    return PlyCloudFile(path, count, dtype, offset)


def _vertices(path: Path, lines: list[list[str]]) -> tuple[int, list[tuple[str, str]]]:
    """Return the number of vertices, and name and type of their properties."""
    elements = [place for place, line in enumerate(lines) if line[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if len(first) != 3 or first[1] != "vertex" or not first[2].isdecimal() or len(first[2]) > 15:
        raise InputError("expected `element vertex` and its number first", path=path)
    until = elements[1] if len(elements) > 1 else len(lines)
    columns = []
    for line in lines[elements[0] + 1 : until]:
        if line[:1] != ["property"]:
            continue
        if len(line) != 3 or line[1] not in _KINDS:
            raise InputError(f"cannot read the property {' '.join(line[1:])[:60]!r} of the vertices", path=path)
        columns.append((line[2], _KINDS[line[1]]))
    names = [name for name, _ in columns]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing or len(set(names)) != len(names):
        raise InputError(
            "expected the properties x, y and z, and no name twice", path=path, field=(missing or names)[0]
        )
    return int(first[2]), columns
