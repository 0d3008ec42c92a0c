"""Point clouds of any file format, as read in chunks, and their PLY files.

Coordinates are written as doubles, so that no offset can be lost. CloudCompare reads them and offers a shift for
its display. Programs that keep float32 coordinates need the LAZ. A PLY has no CRS. PLYs are read in chunks, binary
or ASCII, with the vertices first; of meshes, `triangle_mesh.py` reads the faces.
"""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from plyfile import PlyData, PlyElement

from pipelines.core.errors import InputError
from pipelines.core.files import reading
from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, Rows
from pipelines.formats.splat_ply import PLY_TYPES, ply_header
from pipelines.geodesy.geotiff_keys import FileCrs


@dataclass(frozen=True)
class CloudChunk(Rows):
    """P points of a file."""

    position: FloatArray  # (P, 3) in the file's CRS, easting or longitude first
    classification: ByteArray  # (P,) class of LAS; 0: never classified
    overlap: BoolArray  # (P,) whether another strip covers the place better
    withheld: BoolArray  # (P,) whether the producer has withdrawn the point
    gps_time_s: FloatArray | None  # (P,) time as the file has it; None: the file has none


class CloudFile(Protocol):
    """File of points whose header has been checked."""

    @property
    def path(self) -> Path: ...
    @property
    def count(self) -> int: ...
    @property
    def crs(self) -> FileCrs: ...
    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`."""


_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CLASS_NAMES = ("classification", "scalar_Classification", "scalar_classification")
_TIME_NAMES = ("gps_time", "scalar_GpsTime", "GpsTime")
_COARSEST_M = 5e-4  # largest rounding error of float32 coordinates that is accepted


@dataclass(frozen=True)
class PlyCloudFile:
    """PLY file of points; see `CloudFile`. `dtype` is that of a vertex, `offset` the bytes before the first one.

    Of an ASCII file, `is_text`, `offset` is that of the first line of a vertex.
    """

    path: Path
    count: int
    dtype: np.dtype[np.void]
    offset: int
    crs: FileCrs = field(default_factory=FileCrs)
    is_text: bool = False
    is_single: bool = False  # whether the header calls the coordinates floats of 32 bits

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`.

        Raises:
            InputError: coordinates are too large for the precision of their type.
        """
        for part in self._text_parts(size) if self.is_text else self._binary_parts(size):
            position = np.column_stack([part[axis] for axis in "xyz"]).astype(np.float64)
            if self.is_single:
                check_precision(position, np.float32, self.path)
            classes, none = self._column(part, _CLASS_NAMES), np.zeros(len(part), dtype=bool)
            kinds = np.zeros(len(part)) if classes is None else np.clip(classes, 0, 255)
            yield CloudChunk(position, kinds.astype(np.uint8), none, none, self._column(part, _TIME_NAMES))

    def _binary_parts(self, size: int) -> Iterator[np.ndarray]:
        rows = np.memmap(self.path, dtype=self.dtype, mode="r", offset=self.offset, shape=(self.count,))
        for first in range(0, self.count, size):
            yield rows[first : first + size]

    def _text_parts(self, size: int) -> Iterator[np.ndarray]:
        names = self.dtype.names or ()
        with reading(self.path), self.path.open("rb") as file:
            file.seek(self.offset)
            for first in range(0, self.count, size):
                lines = list(itertools.islice(file, min(size, self.count - first)))
                try:
                    if len(lines) < min(size, self.count - first):
                        raise ValueError(f"there are {first + len(lines)} of {self.count} lines of vertices")
                    values = np.array([line.split()[: len(names)] for line in lines], dtype=np.float64)
                    part = np.empty(len(lines), self.dtype)
                    set_columns(part, names, values.reshape(len(lines), len(names)))
                except (ValueError, OverflowError) as error:
                    message = f"The vertices of the PLY are damaged: {str(error)[:160]}"
                    raise InputError("file-damaged", message, path=self.path) from error
                yield part

    def rest(self) -> list[bytes]:
        """Return the lines after those of the vertices of an ASCII file."""
        with reading(self.path), self.path.open("rb") as file:
            file.seek(self.offset)
            return list(itertools.islice(file, self.count, None))

    def _column(self, part: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
        known = [name for name in names if name in (self.dtype.names or ())]
        return part[known[0]].astype(np.float64) if known else None


def check_precision(position: FloatArray, kind: type[np.floating[Any]], path: Path) -> None:
    """Refuse coordinates (P, 3) that numbers of a kind round by more than half a millimetre."""
    largest = float(np.nanmax(np.abs(position), initial=0.0))
    if np.isfinite(largest) and np.spacing(kind(largest)) / 2 > _COARSEST_M:
        step = np.spacing(kind(largest))
        message = f"Coordinates of {largest:.0f} m in single precision are rounded to {step:.3f} m."
        remedy = "Write the file with double coordinates, or LAZ."
        raise InputError("single-precision", message, path=path, remedy=remedy)


def open_cloud_ply(path: Path) -> PlyCloudFile:
    """Return a PLY file of points whose header agrees with its size.

    Raises:
        InputError: no such file, not a binary PLY, without coordinates, or cut off.

    Examples:
        >>> write_point_ply(Path("cloud.ply"), np.array([[10.0, 20.0, 498.5]]), np.zeros((1, 3), np.uint8))
        >>> file = open_cloud_ply(Path("cloud.ply"))
        >>> file.count, next(file.chunks(1000)).position.tolist()
        (1, [[10.0, 20.0, 498.5]])
    """
    lines, offset, size = ply_header(path)
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    is_text = form == "ascii"
    if form not in _ORDERS and not is_text:
        message = f"The format of the PLY is {form[:30]!r}."
        remedy = "Write it as binary_little_endian."
        raise InputError("ply-format", message, path=path, remedy=remedy)
    count, columns = _vertices(path, lines)
    kinds = [(name, "<f8" if is_text else _ORDERS[form] + kind) for name, kind in columns]
    dtype = np.dtype(kinds)
    least = 2 * len(columns) if is_text else dtype.itemsize  # bytes of a point
    if count < 1 or offset + count * least > size:
        message = f"The header promises {count} points of {least} bytes, the file has {max(size - offset, 0)}."
        raise InputError("size-differs", f"{message} It is empty, cut off or damaged.", path=path)
    is_single = "f4" in (kind for name, kind in columns if name in "xyz")
    return PlyCloudFile(path, count, dtype, offset, is_text=is_text, is_single=is_single)


def _vertices(path: Path, lines: list[list[str]]) -> tuple[int, list[tuple[str, str]]]:
    """Return the number of vertices, and name and type of their properties."""
    elements = [number for number, line in enumerate(lines) if line[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if len(first) != 3 or first[1] != "vertex" or not first[2].isdecimal() or len(first[2]) > 15:
        raise InputError("ply-elements", "The first element of the PLY is not a number of vertices.", path=path)
    until = elements[1] if len(elements) > 1 else len(lines)
    columns = []
    for line in lines[elements[0] + 1 : until]:
        if line[:1] != ["property"]:
            continue
        if len(line) != 3 or line[1] not in PLY_TYPES:
            message = f"The property {' '.join(line[1:])[:60]!r} of the vertices has no known type of fixed size."
            raise InputError("ply-properties", message, path=path)
        columns.append((line[2], PLY_TYPES[line[1]]))
    names = [name for name, _ in columns]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing or len(set(names)) != len(names):
        message = "The vertices have no x, y and z, or two properties of one name."
        raise InputError("ply-coordinates", message, path=path, field=(missing or names)[0])
    return int(first[2]), columns


@dataclass(frozen=True)
class CloudPoints(Rows):
    """P points in a CRS."""

    position: FloatArray  # (P, 3), easting or longitude first
    normal: Float32Array  # (P, 3) unit vectors along the axes of the CRS
    rgb: ByteArray  # (P, 3)
    cov_m2: Float32Array  # (P, 3, 3) covariance in m², axes east, north, up; NaN: unknown
    classification: ByteArray  # (P,) class of LAS: 2 ground, 1 anything else, 0 not classified

    @property
    def sigma_h_m(self) -> Float32Array:
        """Horizontal σ (P,) in metres: √(σ_E² + σ_N²); NaN: unknown."""
        return np.asarray(np.sqrt(self.cov_m2[:, 0, 0] + self.cov_m2[:, 1, 1]))

    @property
    def sigma_v_m(self) -> Float32Array:
        """Vertical σ (P,) in metres; NaN: unknown."""
        return np.asarray(np.sqrt(self.cov_m2[:, 2, 2]))


_VERTEX = [
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"),
    ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    ("sigma_h", "<f4"), ("sigma_v", "<f4"), ("classification", "u1"),
]  # fmt: skip
_NAMES = {"<f8": "double", "<f4": "float", "u1": "uchar"}
_COUNT_DIGITS = 20
COLOURS = ("red", "green", "blue")
_POINT_VERTEX = [
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    ("sigma", "<f4"), ("inlier", "u1"),
]  # fmt: skip


def set_columns(vertex: np.ndarray, names: Sequence[str], values: np.ndarray) -> None:
    """Write the columns of an array (N, K) into the K named fields of N vertices."""
    for column, name in enumerate(names):
        vertex[name] = values[:, column]


class CloudPlyWriter(AbstractContextManager["CloudPlyWriter"]):
    """Writer of a binary PLY file in chunks; a context manager. Comments are for people; ASCII alone is kept."""

    def __init__(self, path: Path, comments: list[str]) -> None:
        self._comments = [" ".join(line.split()).encode("ascii", "ignore").decode() for line in comments]
        self._count = 0
        self._file = path.open("wb")
        self._file.write(self._header())

    def __exit__(self, *_: object) -> None:
        """Put the number of points into the header, and close the file."""
        try:
            self._file.seek(0)
            self._file.write(self._header())
        finally:
            self._file.close()

    def write(self, points: CloudPoints) -> None:
        vertex = np.empty(len(points), dtype=_VERTEX)
        set_columns(vertex, ("x", "y", "z"), points.position)
        set_columns(vertex, ("nx", "ny", "nz"), points.normal)
        set_columns(vertex, COLOURS, points.rgb)
        vertex["sigma_h"], vertex["sigma_v"] = points.sigma_h_m, points.sigma_v_m
        vertex["classification"] = points.classification
        self._file.write(vertex.tobytes())
        self._count += len(points)

    def _header(self) -> bytes:
        """Return the header, of a length that does not depend on the number of points."""
        padding = "-" * (_COUNT_DIGITS - len(str(self._count)))
        lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in self._comments)]
        lines += [f"comment {padding}", f"element vertex {self._count}"]
        lines += [f"property {_NAMES[kind]} {name}" for name, kind in _VERTEX]
        return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def write_point_ply(
    path: Path,
    position: FloatArray,
    rgb: ByteArray,
    sigma_m: FloatArray | None = None,
    inlier: BoolArray | None = None,
) -> None:
    """Write points (N, 3) with their colour (N, 3), σ (N,) along the worst axis and inlier flag (N,), for viewers.

    What is None is left out. Points without a position (NaN) are left out, because viewers fail on them.
    """
    finite = np.isfinite(position).all(axis=1)
    further = {name: values for name, values in (("sigma", sigma_m), ("inlier", inlier)) if values is not None}
    names = ("x", "y", "z", *COLOURS, *further)
    vertex = np.empty(int(finite.sum()), dtype=[column for column in _POINT_VERTEX if column[0] in names])
    set_columns(vertex, ("x", "y", "z"), position[finite])
    set_columns(vertex, COLOURS, rgb[finite])
    for name, values in further.items():
        vertex[name] = values[finite]
    path.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))
