"""LAS and LAZ files, read in chunks (LAS 1.0 to 1.4, point formats 0 to 10).

The header is compared with the file's size before any point is read: neither the number of points nor the table of
compressed chunks can ask for more memory than the file justifies.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.types import BoolArray
from pipelines.formats.cloud_chunk import CloudChunk

_HEADER_BYTES = 227  # of LAS 1.0; later versions have more
_VLR_BYTES = 54
_POINT_BITS_LEAST = 0.05  # LAZ spends more on each point, even on equal ones
_OVERLAP_CLASS = 12  # of the point formats 0 to 5, which have no flag for it
_USER_DEFINED = 32767
_GEOGRAPHIC, _PROJECTED, _VERTICAL = 2048, 3072, 4096  # keys of GeoTIFF


@dataclass(frozen=True)
class LasFile:
    """LAS or LAZ file; see `CloudFile`."""

    path: Path
    count: int
    crs: str | None

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield all points in chunks of at most `size`.

        Raises:
            InputError: the file is damaged.
        """
        import laspy

        done = 0
        backend = laspy.LazBackend.Lazrs  # decodes one chunk at a time, where the parallel one holds many
        with _damage(self.path), laspy.open(self.path, read_evlrs=False, laz_backend=backend) as file:
            for record in file.chunk_iterator(size):
                done += len(record)
                yield _chunk(record)
        if done != self.count:
            raise InputError(f"the header promises {self.count} points, the file holds {done}", path=self.path)


def open_las(path: Path) -> LasFile:
    """Return a LAS or LAZ file whose header agrees with its size.

    Raises:
        InputError: no such file, or not a readable LAS file.
    """
    import laspy

    size = file_size(path)
    with _damage(path):
        _check_head(path, size)
        with laspy.open(path, read_evlrs=False) as file:
            header = file.header
            count, record = int(header.point_count), int(header.point_format.size)
            body = size - int(header.offset_to_point_data)
            least = _POINT_BITS_LEAST / 8 if header.are_points_compressed else record
            if count < 1 or body < count * least:
                raise InputError(
                    f"the header promises {count} points, the file has {max(body, 0)} bytes for them: it is empty, "
                    "cut off or damaged",
                    path=path,
                )
            return LasFile(path, count, _crs(header))


def _check_head(path: Path, size: int) -> None:
    """Refuse a file whose records or table of chunks would reach beyond its end.

    Raises:
        InputError: the file is damaged, or no LAS file.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES or head[:4] != b"LASF":
            raise InputError("not a LAS or LAZ file", path=path)
        offset, records = struct.unpack_from("<II", head, 96)
        point_format, record_bytes = struct.unpack_from("<BH", head, 104)
        if offset > size or records * _VLR_BYTES > offset or record_bytes == 0:
            raise InputError("the header is damaged: its records reach beyond the file's end", path=path)
        if not point_format & 0x80:
            return
        stream.seek(offset)
        table = struct.unpack("<q", stream.read(8))[0]
        if table == -1:  # written to a stream: the place of the table is the file's last number
            stream.seek(size - 8)
            table = struct.unpack("<q", stream.read(8))[0]
        if not offset < table <= size - 8:
            raise InputError("the table of compressed chunks is missing: the file is cut off", path=path)
        stream.seek(table)
        _, chunks = struct.unpack("<II", stream.read(8))
        if chunks > size - offset:
            raise InputError(f"{chunks} compressed chunks do not fit into the file: it is damaged", path=path)


def _chunk(record: Any) -> CloudChunk:
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


def _crs(header: Any) -> str | None:
    """Return the CRS as WKT or as EPSG codes; None where the file states none that stands alone."""
    for record in header.vlrs:
        if record.user_id == "LASF_Projection" and record.record_id == 2112:
            text = getattr(record, "string", "").strip("\0 ")
            if text:
                return str(text)
    for record in header.vlrs:
        if record.user_id == "LASF_Projection" and record.record_id == 34735:
            codes = {key.id: key.value_offset for key in record.geo_keys if key.tiff_tag_location == 0}
            horizontal = codes.get(_PROJECTED, codes.get(_GEOGRAPHIC, _USER_DEFINED))
            vertical = codes.get(_VERTICAL, 0)
            if horizontal in (0, _USER_DEFINED) or vertical == _USER_DEFINED:
                return None
            return f"EPSG:{horizontal}+{vertical}" if vertical else f"EPSG:{horizontal}"
    return None


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn errors of the decoder into an `InputError` of the file."""
    try:
        yield
    except (InputError, GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # the decompressor's panics are no `Exception`
        raise InputError(f"damaged LAS file: {' '.join(str(error).split())[:200]}", path=path) from error
