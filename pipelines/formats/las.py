"""LAS and LAZ files: clouds read in chunks (LAS 1.0 to 1.4), surfaces and laser scans written (LAS 1.4).

The header is compared with the file's size before any point is read: neither the number of points nor the table of
compressed chunks can ask for more memory than the file justifies.

The CRS is written as WKT1 in GDAL's dialect: LAS 1.4 predates WKT2, which readers refuse there.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.formats.cloud_ply import CloudChunk, CloudPoints
from pipelines.formats.las_head import LasHead, read_las_head
from pipelines.geodesy.geotiff_keys import FileCrs

if TYPE_CHECKING:
    import laspy

_TEXT_AREA = ("LASF_Spec", 3)  # record for plain text
_RGB16 = 257  # 255 becomes 65535
DEGREE_STEP, METRE_STEP = 1e-9, 1e-3  # 0.1 mm on the ground, and 1 mm
_EXTRA = {
    "nx": "normal, first coordinate",
    "ny": "normal, second coordinate",
    "nz": "normal, third coordinate",
    "sigma_h": "horizontal sigma in metres",
    "sigma_v": "vertical sigma in metres",
}
_AXES = "enu"
_COVARIANCE = {  # name of each element of the upper triangle, with its row and column
    f"cov_{first}{second}": (row, column)
    for row, first in enumerate(_AXES)
    for column, second in enumerate(_AXES)
    if row <= column
}
_ANGLE_STEP_DEG = 0.006
_POINT_BITS_LEAST = 0.05  # LAZ spends more on each point, even on equal ones
_GAP = 1 << 20  # bytes between a file's end and the table of chunks that stands for its missing one
_OVERLAP_CLASS = 12  # of the point formats 0 to 5, which have no flag for it


@dataclass(frozen=True)
class LasFile:
    """LAS or LAZ file; see `CloudFile`."""

    path: Path
    count: int
    head: LasHead

    @property
    def crs(self) -> FileCrs:
        return self.head.crs

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`; an InputError: the file is damaged."""
        done = 0
        with _damage(self.path), _opened(self.path, self.head) as file:
            for record in file.chunk_iterator(size):
                done += len(record)
                yield _chunk(record)
        if done != self.count:
            message = f"The header promises {self.count} points, the file holds {done}."
            raise InputError("size-differs", message, path=self.path)


def open_las(path: Path) -> LasFile:
    """Return a LAS or LAZ file whose header agrees with its size.

    Raises:
        InputError: no such file, or not a readable LAS file.

    Examples:
        >>> import laspy
        >>> cloud = laspy.create()
        >>> cloud.xyz = np.array([[10.0, 20.0, 498.5], [10.5, 20.0, 498.6]])
        >>> cloud.write("cloud.las")
        >>> file = open_las(Path("cloud.las"))
        >>> file.count, next(file.chunks(1000)).position.tolist()
        (2, [[10.0, 20.0, 498.5], [10.5, 20.0, 498.6]])
    """
    size = file_size(path)
    with _damage(path):
        head = read_las_head(path, size)
        with _opened(path, head) as file:
            header = file.header
            count, record = int(header.point_count), int(header.point_format.size)
            body = size - int(header.offset_to_point_data)
            least = _POINT_BITS_LEAST / 8 if header.are_points_compressed else record
            if count < 1 or body < count * least:
                message = f"The header promises {count} points, the file has {max(body, 0)} bytes for them."
                raise InputError("size-differs", f"{message} It is empty, cut off or damaged.", path=path)
            return LasFile(path, count, head)


class _InOrder(io.RawIOBase):
    """LAZ file whose table of chunks was never written, with an empty table far behind its end.

    The decoder then reads chunk after chunk. Between the file's end and the table lies nothing, so that points
    which are cut off are an error, not zeros.
    """

    def __init__(self, path: Path, size: int, table_at: int) -> None:
        self._file, self._size = path.open("rb"), size
        table = size + _GAP
        self._parts = ((table_at, struct.pack("<q", table)), (table, bytes(8)))
        self._place = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._place

    def seek(self, place: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._parts[1][0] + 8}[whence]
        self._place = max(base + place, 0)
        return self._place

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        start = self._place
        self._file.seek(start)
        data = bytearray(self._file.read(min(len(buffer), max(self._size - start, 0))))
        for at, part in self._parts:
            first, last = max(at, start), min(at + len(part), start + len(buffer))
            if first < last and first - start <= len(data):
                data[first - start : last - start] = part[first - at : last - at]
        buffer[: len(data)] = data
        self._place += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def _opened(path: Path, head: LasHead) -> laspy.LasReader:
    import laspy

    source = path if head.table_at is None else _InOrder(path, file_size(path), head.table_at)
    # This decoder holds one chunk at a time, where the parallel one holds many.
    return laspy.open(source, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs)


def _chunk(record: laspy.ScaleAwarePointRecord) -> CloudChunk:
    names = set(record.point_format.dimension_names)
    classification = np.asarray(record.classification, dtype=np.uint8)

    def flag(name: str) -> BoolArray:
        if name not in names:
            return np.zeros(len(classification), dtype=bool)
        return np.asarray(record[name], dtype=bool)

    overlap = flag("overlap") if "overlap" in names else classification == _OVERLAP_CLASS
    return CloudChunk(
        np.column_stack([record.x, record.y, record.z]).astype(np.float64),
        classification,
        overlap,
        flag("withheld"),
        np.asarray(record.gps_time, dtype=np.float64) if "gps_time" in names else None,
    )


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn errors of the decoder into an `InputError` of the file."""
    try:
        yield
    except (InputError, GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # the decompressor's panics are no `Exception`
        message = f"The LAS file is damaged: {' '.join(str(error).split())[:200]}"
        raise InputError("file-damaged", message, path=path) from error


class LazFile:
    """LAZ file of single returns that is written in chunks; a context manager.

    Args:
        angular: whether the first two coordinates are angles.
        near: (3,) coordinates near the points; the file counts from these, rounded to integers.
        written: date in the header; None: today.
        text: description for people, in English: vertical datum, meaning of σ.
    """

    point_format: ClassVar[int]
    system: ClassVar[str]  # origin of the points
    extra: ClassVar[Mapping[str, str]] = {}  # name and meaning of further float32 columns

    def __init__(
        self,
        path: Path,
        *,
        wkt1: str,
        angular: bool,
        near: ArrayLike,
        software: str,
        written: date | None = None,
        text: str = "",
    ) -> None:
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=self.point_format)
        header.scales = np.array([DEGREE_STEP, DEGREE_STEP, METRE_STEP] if angular else [METRE_STEP] * 3)
        header.offsets = np.round(np.asarray(near, dtype=np.float64))
        header.generating_software, header.system_identifier = software, self.system
        header.creation_date = written or date.today()
        if wkt1:  # else a local frame
            header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt1))
        header.global_encoding.wkt = True
        if text:
            header.vlrs.append(laspy.VLR(*_TEXT_AREA, "Text Area Description", text.encode("utf-8") + b"\0"))
        if self.extra:
            columns = [laspy.ExtraBytesParams(name, "f4", description=what) for name, what in self.extra.items()]
            header.add_extra_dims(columns)
        self._header = header
        self._writer: laspy.LasWriter = laspy.open(path, mode="w", header=header, do_compress=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def _record(self, position: FloatArray) -> laspy.ScaleAwarePointRecord:
        """Return a record of points (P, 3), each of them the only return of its beam."""
        import laspy

        record = laspy.ScaleAwarePointRecord.zeros(len(position), header=self._header)
        record[["x", "y", "z"]] = position
        record["return_number"][:] = record["number_of_returns"][:] = 1
        return record


class LazWriter(LazFile):
    """Writer of a LAZ file of a surface, with colour, normal and σ; see `LazFile`."""

    point_format, system = 7, "photogrammetry"  # RGB and time of LAS 1.4
    extra = _EXTRA | dict.fromkeys(_COVARIANCE, "covariance in square metres")

    def write(self, points: CloudPoints) -> None:
        """Append points.

        Raises:
            OverflowError: a coordinate is further from `near` than the file's integers reach (2147 km or 2.1°).
        """
        record = self._record(points.position)
        record[["red", "green", "blue"]] = points.rgb.astype(np.uint16) * _RGB16
        record[["nx", "ny", "nz"]] = points.normal
        record["sigma_h"], record["sigma_v"] = points.sigma_h_m, points.sigma_v_m
        record["classification"] = points.classification
        for name, (row, column) in _COVARIANCE.items():
            record[name] = points.cov_m2[:, row, column]
        self._writer.write_points(record)


def read_surface(path: Path, size: int) -> Iterator[CloudPoints]:
    """Yield the points of a surface as `LazWriter` writes them, in chunks of at most `size`.

    Raises:
        InputError: no such file, a damaged one, or one without normals and covariances.

    Examples:
        >>> point = CloudPoints(
        ...     position=np.array([[500010.0, 5180020.0, 498.5]]), normal=np.array([[0, 0, 1]], np.float32),
        ...     rgb=np.full((1, 3), 128, np.uint8), cov_m2=0.0625 * np.eye(3, dtype=np.float32)[None],
        ...     classification=np.array([2], np.uint8),
        ... )
        >>> with LazWriter(
        ...     Path("cloud.laz"), wkt1="", angular=False, near=point.position[0], software="example"
        ... ) as writer:
        ...     writer.write(point)
        >>> read = next(read_surface(Path("cloud.laz"), size=1000))
        >>> read.position.tolist(), read.sigma_v_m.tolist()
        ([[500010.0, 5180020.0, 498.5]], [0.25])
    """
    with _damage(path), _opened(path, open_las(path).head) as file:
        lacking = (_EXTRA.keys() | _COVARIANCE.keys()) - set(file.header.point_format.dimension_names)
        if lacking:
            message = f"The cloud has no {', '.join(sorted(lacking))}."
            remedy = "Make it with `georef export-cloud`."
            raise InputError("cloud-without-sigma", message, path=path, remedy=remedy)
        for record in file.chunk_iterator(size):
            cov = np.empty((len(record), 3, 3), dtype=np.float32)
            for name, (row, column) in _COVARIANCE.items():
                cov[:, row, column] = cov[:, column, row] = record[name]
            yield CloudPoints(
                np.column_stack([record.x, record.y, record.z]).astype(np.float64),
                np.column_stack([record[name] for name in ("nx", "ny", "nz")]).astype(np.float32),
                (np.column_stack([record.red, record.green, record.blue]) // _RGB16).astype(np.uint8),
                cov,
                np.asarray(record.classification, dtype=np.uint8),
            )


@dataclass(frozen=True)
class MovedPoints:
    """P points of a surface, and how far another surface lies from them along their normals."""

    position: FloatArray  # (P, 3) in the CRS, easting or longitude first
    normal: FloatArray  # (P, 3)
    distance_m: FloatArray  # (P,) NaN: not measured
    sigma_m: FloatArray  # (P,)
    lod_m: FloatArray  # (P,) level of detection at 95 %


class MovedWriter(LazFile):
    """Writer of a LAZ file of change along normals; see `LazFile`."""

    point_format, system = 6, "photogrammetry"
    extra: ClassVar[Mapping[str, str]] = {
        **{name: _EXTRA[name] for name in ("nx", "ny", "nz")},
        "distance": "later minus earlier in metres",
        "sigma": "sigma of distance in metres",
        "lod": "level of detection 95 % in m",
        "significant": "1 if beyond it",
    }

    def write(self, points: MovedPoints) -> None:
        """Append points; errors as of `LazWriter.write`."""
        record = self._record(points.position)
        record[["nx", "ny", "nz"]] = points.normal
        record["distance"], record["sigma"], record["lod"] = points.distance_m, points.sigma_m, points.lod_m
        record["significant"] = np.abs(points.distance_m) > points.lod_m
        self._writer.write_points(record)


@dataclass(frozen=True)
class LidarReturns:
    """P returns of one strip, numbered from 1."""

    position: FloatArray  # (P, 3) in the CRS, easting or longitude first
    classification: ByteArray  # (P,) class of LAS
    gps_time_s: FloatArray  # (P,)
    scan_angle_deg: FloatArray  # (P,) of the beam across the strip
    strip: int


class LidarWriter(LazFile):
    """Writer of a LAZ file of a scanner: class, time, strip and angle of each beam; see `LazFile`."""

    point_format, system = 6, "simulated"

    def write(self, returns: LidarReturns) -> None:
        record = self._record(returns.position)
        record["classification"] = returns.classification
        record["gps_time"] = returns.gps_time_s
        record["scan_angle"] = np.round(returns.scan_angle_deg / _ANGLE_STEP_DEG).astype(np.int16)
        record["point_source_id"] = np.full(len(returns.position), returns.strip, dtype=np.uint16)
        self._writer.write_points(record)
