"""Head of a LAS or LAZ file, read from its bytes: what it promises, and the records that state its CRS.

Nothing here trusts the file: records, extended records and the table of compressed chunks must lie inside it, and
scales and offsets must be numbers that can place points.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pipelines.core.errors import InputError
from pipelines.geodesy.geotiff_keys import FileCrs, KeyValue

_HEADER_BYTES = 227  # of LAS 1.0; later versions have more
_HEADER_BYTES_14 = 255  # up to the extended records
_VLR, _EVLR = struct.Struct("<2x16sHH32x"), struct.Struct("<2x16sHQ32x")  # user, record, bytes that follow
_MOST_RECORDS = 100_000
_MOST_CRS_BYTES = 1 << 20
_WKT_BIT = 16  # of the global encoding
_LEAST_SCALE, _MOST_SCALE = 1e-12, 1e3
# WKT lies in 2112 by the specification; PDAL puts WKT2 into 4224, and libLAS its WKT under its own name.
_WKT_RECORDS = (2112, 4224)
_LOCAL = re.compile(r"LOCAL_CS|ENGCRS|ENGINEERINGCRS", re.IGNORECASE)
_KEYS, _DOUBLES, _TEXTS = 34735, 34736, 34737  # of GeoTIFF
_USERS = ("lasf_projection", "liblas", "pdal")
_POINTWISE, _VARIABLE_CHUNKS = 1, 0xFFFFFFFF


@dataclass(frozen=True)
class LasHead:
    """Checked statements of the head of a file.

    `table_at` is the place of the pointer to the table of compressed chunks, if that table was never written.
    """

    crs: FileCrs
    table_at: int | None = None


def read_las_head(path: Path, size: int) -> LasHead:
    """Return the head of a file of `size` bytes.

    Raises:
        InputError: no LAS file; a scale or an offset that is nonsense; records or chunks beyond the file's end.

    Examples:
        >>> import laspy
        >>> cloud = laspy.create(point_format=6, file_version="1.4")
        >>> cloud.header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr('LOCAL_CS["site"]'))
        >>> cloud.write("cloud.las")
        >>> read_las_head(Path("cloud.las"), Path("cloud.las").stat().st_size).crs
        FileCrs(wkt='LOCAL_CS["site"]', keys={}, wkt_counts=False, middle=(0.0, 0.0, 0.0))
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES_14)
        if len(head) < _HEADER_BYTES or head[:4] != b"LASF":
            raise InputError("not-a-las", "The file is not a LAS or LAZ file.", path=path)
        offset, records = struct.unpack_from("<II", head, 96)
        point_format, record_bytes = struct.unpack_from("<BH", head, 104)
        if offset > size or records * _VLR.size > offset or record_bytes == 0:
            message = "The header is damaged: its records reach beyond the file's end."
            raise InputError("file-damaged", message, path=path)
        _check_steps(path, head)
        by_record: _Found = {}
        for key, data in _records(stream, head, size):
            by_record.setdefault(key, []).append(data)
        is_compressed = bool(point_format & 0x80)
        table_at = _missing_table(path, stream, offset, size, by_record) if is_compressed else None
    return LasHead(_crs(head, by_record), table_at)


def _check_steps(path: Path, head: bytes) -> None:
    """Refuse scales and offsets that place no point."""
    numbers = struct.unpack_from("<6d", head, 131)
    for at, value in enumerate(numbers):
        kind, axis = ("scale", "offset")[at // 3], "xyz"[at % 3]
        if kind == "scale" and not _LEAST_SCALE <= abs(value) <= _MOST_SCALE:
            message = f"The header's scale of {axis} is {value:g}, which places no point: the header is damaged."
            raise InputError("las-scale", message, path=path, field=f"{axis} scale")
        if not math.isfinite(value):
            message = f"The header's offset of {axis} is {value:g}, no number: the header is damaged."
            raise InputError("las-offset", message, path=path, field=f"{axis} offset")


_Found = dict[tuple[str, int], list[bytes]]  # by user and number, in the order of the file


def _records(stream: BinaryIO, head: bytes, size: int) -> Iterator[tuple[tuple[str, int], bytes]]:
    """Yield user and number of the records of CRS and compression with their bytes, extended records last."""
    at, _, count = struct.unpack_from("<HII", head, 94)
    places = [(_VLR, at, min(count, _MOST_RECORDS))]
    if len(head) >= _HEADER_BYTES_14 and head[24:26] >= b"\1\4" and struct.unpack_from("<H", head, 94)[0] >= 247:
        at, count = struct.unpack_from("<QI", head, 235)
        places.append((_EVLR, at, min(count, _MOST_RECORDS)))
    for form, first, records in places:
        offset = first
        for _ in range(records):
            if not 0 < offset <= size - form.size:
                break
            stream.seek(offset)
            name, number, length = form.unpack(stream.read(form.size))
            user = name.split(b"\0")[0].decode("latin-1").strip().lower()
            offset += form.size + length
            wanted = user in (*_USERS, "laszip encoded") and length <= _MOST_CRS_BYTES and offset <= size
            if wanted and (data := stream.read(length)).strip(b"\0 \r\n\t"):
                yield (user, number), data


def _crs(head: bytes, records: _Found) -> FileCrs:
    every = [_text(one) for number in _WKT_RECORDS for user in _USERS for one in records.get((user, number), [])]
    texts = [text for text in every if text]
    # A placeholder in one record must not hide a CRS in another.
    wkt = next((text for text in texts if not _LOCAL.match(text)), texts[0] if texts else "")
    middle = tuple((low + high) / 2 for high, low in struct.iter_unpack("<2d", head[179:227]))
    return FileCrs(
        wkt=wkt,
        keys=_geo_keys(records),
        wkt_counts=bool(struct.unpack_from("<H", head, 6)[0] & _WKT_BIT),
        middle=(middle[0], middle[1], middle[2]) if all(map(math.isfinite, middle)) else None,
    )


def _text(data: bytes) -> str:
    data = data.split(b"\0")[0]
    try:
        return data.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        return data.decode("latin-1").strip()


def _geo_keys(records: _Found) -> dict[int, KeyValue]:
    """Return the keys of GeoTIFF with their values; damaged ones are left out."""
    user = next((user for user in _USERS if (user, _KEYS) in records), "")
    directory, doubles, texts = (records.get((user, key), [b""])[0] for key in (_KEYS, _DOUBLES, _TEXTS))
    words = [word for (word,) in struct.iter_unpack("<H", directory[: len(directory) // 2 * 2])]
    keys: dict[int, KeyValue] = {}
    for at in range(4, min(len(words), 4 + 4 * (words[3] if len(words) > 3 else 0)) - 3, 4):
        key, location, count, value = words[at : at + 4]
        if location == 0:
            keys[key] = value
        elif location == _DOUBLES and 8 * (value + 1) <= len(doubles):
            keys[key] = float(struct.unpack_from("<d", doubles, 8 * value)[0])
        elif location == _TEXTS:
            keys[key] = texts[value : value + count].decode("latin-1").strip("\0| \r\n")
    return keys


def _missing_table(path: Path, stream: BinaryIO, offset: int, size: int, records: _Found) -> int | None:
    """Return the place of the pointer to a table of chunks that was never written; None: there is a table.

    Raises:
        InputError: the file is cut off, has more chunks than bytes, or points that only a table could find.
    """
    compression = records.get(("laszip encoded", 22204), [b""])[0].ljust(16, b"\0")
    if struct.unpack_from("<H", compression)[0] == _POINTWISE:
        message = "The points are compressed as by LASzip before version 2, without chunks."
        remedy = "Write it again as LAZ."
        raise InputError("laz-without-chunks", message, path=path, remedy=remedy)
    stream.seek(offset)
    table = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))[0]
    is_streamed = table in (-1, 0)
    if table == -1:  # written to a stream: the place of the table is the file's last number
        stream.seek(size - 8)
        table = struct.unpack("<q", stream.read(8))[0]
    chunks = None
    if offset < table <= size - 8:
        stream.seek(table)
        _, chunks = struct.unpack("<II", stream.read(8))
    if chunks is not None and chunks <= size - offset:
        return None
    if not is_streamed and chunks is None:
        message = "The table of compressed chunks is missing: the file is cut off."
        raise InputError("file-cut-off", message, path=path)
    if not is_streamed:
        message = f"{chunks} compressed chunks do not fit into the file: it is damaged."
        raise InputError("chunk-count", message, path=path)
    if struct.unpack_from("<I", compression, 12)[0] == _VARIABLE_CHUNKS:
        message = "The table of its chunks, which have different lengths, was never written: no reader finds them."
        raise InputError("file-cut-off", message, path=path)
    return offset
