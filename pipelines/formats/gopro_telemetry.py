"""Positions that a GoPro wrote into a video: the GPMF telemetry in a track of the MP4 file.

MP4: nested boxes of size, type and content (ISO/IEC 14496-12); the track's tables in `stbl` say where each payload
lies and how long it lasts. GPMF: 32-bit aligned triples of key, type with size and count, and big-endian values;
a device `DEVC` holds streams `STRM` (github.com/gopro/gpmf-parser, README).

A stream of positions has, in one of two forms:

- `GPS5`: latitude, longitude, height, two speeds; beside it fix `GPSF`, DOP × 100 `GPSP`, time `GPSU`
- `GPS9`: these, then days since 2000, seconds of the day, DOP and fix of each position

`SCAL` divides the values. `GPSA` says what heights count from: `MSLV` is mean sea level. Firmware without `GPSA`
records `GPS5` above the ellipsoid WGS84 (gpmf-parser, issues 4 and 81).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.gnss_logs import VideoPositions
from pipelines.formats.tables import require_range

_MOST_BOXES = 10_000  # one beside the other
_MOST_INDEX_BYTES = 1 << 28
_MOST_PAYLOADS = 1 << 20
_MOST_PAYLOAD_BYTES = 1 << 24
_MOST_SAMPLES = 1 << 22
_LEAST_FIX = 3  # of latitude, longitude and height
_LARGEST_DOP = 10.0
_MEAN_SEA_LEVEL, _ELLIPSOID = "MSLV", "WGS8"
_DAY_ZERO_S = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
_NUMBERS = {
    b"b": ">i1", b"B": ">u1", b"s": ">i2", b"S": ">u2", b"l": ">i4", b"L": ">u4", b"f": ">f4", b"d": ">f8",
    b"j": ">i8", b"J": ">u8",
}  # fmt: skip


def read_telemetry(path: Path) -> VideoPositions | None:
    """Return the positions in a video; None: it is no MP4 file, has no GPMF track, or this has no positions.

    Positions of a payload are spread evenly over its duration. Those without a fix in three dimensions, or with a
    DOP over 10, are NaN.

    Raises:
        InputError: a box, table or payload is cut off, too large or inconsistent, or a coordinate is out of range.
    """
    with path.open("rb") as file:
        index = _index(file, path)
        track = None if index is None else _gpmd_track(index, path)
        if track is None:
            return None
        if track.size.sum() > file.seek(0, os.SEEK_END):
            raise _damaged(path, "its payloads are larger than the file")
        streams = []
        samples = 0
        for stream in _streams(file, track, path):
            samples += len(stream.values)
            if samples > _MOST_SAMPLES:
                raise _damaged(path, f"it has more than {_MOST_SAMPLES} positions", stream.payload)
            streams.append(stream)
    kind = b"GPS9" if any(stream.key == b"GPS9" for stream in streams) else b"GPS5"
    streams = [stream for stream in streams if stream.key == kind and len(stream.values)]
    if not streams:
        return None
    payload = np.concatenate([np.full(len(stream.values), stream.payload) for stream in streams])
    time_s = np.concatenate([stream.times_s() for stream in streams])
    order = np.argsort(time_s, kind="stable")
    order = order[np.diff(time_s[order], prepend=-np.inf) > 0]
    table = np.concatenate([stream.values for stream in streams])[order]
    lines = payload[order] + 1
    usable = (table[:, 3] >= _LEAST_FIX) & (table[:, 4] <= _LARGEST_DOP) & np.isfinite(table[:, :3]).all(axis=1)
    lon_lat_height = np.where(usable[:, None], table[:, [1, 0, 2]], np.nan)
    for column, limit, field in ((0, 180.0, "longitude"), (1, 90.0, "latitude")):
        require_range(lon_lat_height[:, column], -limit, limit, path=path, lines=lines, field=field)
    utc = table[:, 5] - time_s[order]
    utc = utc[usable & np.isfinite(utc)]
    heights = {stream.height_system for stream in streams} - {""}
    return VideoPositions(
        path=path,
        source="video telemetry",
        lines=lines,
        time_s=time_s[order],
        lon_lat_height=lon_lat_height,
        heights_above_geoid=bool(heights - {_ELLIPSOID}) or (kind == b"GPS9" and not heights),
        utc_from_video_s=float(np.median(utc)) if len(utc) else None,
        receiver="single-frequency",
    )


@dataclass(frozen=True)
class _Track:
    """Places and times of N payloads."""

    offset: IntArray  # (N,) in the file
    size: IntArray  # (N,)
    begin_s: FloatArray  # (N,) since the beginning of the video
    duration_s: FloatArray  # (N,)


@dataclass(frozen=True)
class _Stream:
    """Positions of one payload."""

    key: bytes
    payload: int
    begin_s: float
    duration_s: float
    height_system: str  # of `GPSA`; empty: not stated
    values: FloatArray  # (N, 6) latitude, longitude, height, fix, DOP, seconds since 1970 UTC or NaN

    def times_s(self) -> FloatArray:
        return self.begin_s + self.duration_s * np.arange(len(self.values)) / max(len(self.values), 1)


def _damaged(path: Path, what: str, payload: int | None = None) -> InputError:
    return InputError(
        "telemetry-damaged",
        f"The video's telemetry cannot be read: {what}.",
        path=path,
        line=None if payload is None else payload + 1,
        remedy="Copy the file from the camera again, or give --trajectory: then the telemetry is not read.",
    )


def _index(file: BinaryIO, path: Path) -> bytes | None:
    """Return the content of the box `moov`; None: the file does not begin as an MP4 file or has no such box."""
    length = file.seek(0, os.SEEK_END)
    at = 0
    for number in range(_MOST_BOXES):
        if at >= length:
            return None
        file.seek(at)
        head = file.read(16)
        if len(head) < 8:
            return None
        size, kind = struct.unpack(">I4s", head[:8])
        if number == 0 and kind != b"ftyp":
            return None
        begin = at + 8
        if size == 1 and len(head) == 16:
            size, begin = int.from_bytes(head[8:], "big"), at + 16
        end = length if size == 0 else at + size
        if end < begin:
            raise _damaged(path, f"the box {kind!r} at byte {at} has a size of {size}")
        if kind == b"moov":
            if end > length or end - begin > _MOST_INDEX_BYTES:
                raise _damaged(path, "its index is cut off or too large")
            file.seek(begin)
            return file.read(end - begin)
        at = end
    raise _damaged(path, f"it has more than {_MOST_BOXES} boxes")


def _boxes(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield type and content of boxes that lie one behind the other."""
    at = 0
    for _ in range(_MOST_BOXES):
        if at + 8 > len(data):
            return
        size, kind = struct.unpack_from(">I4s", data, at)
        size = size or len(data) - at
        if size < 8 or at + size > len(data):
            raise _damaged(path, f"the box {kind!r} is cut off")
        yield kind, data[at + 8 : at + size]
        at += size
    raise _damaged(path, f"it has more than {_MOST_BOXES} boxes")


def _box(data: bytes, kinds: tuple[bytes, ...], path: Path) -> bytes | None:
    """Return the content of the first box at a path of nested types; None: there is none."""
    for kind in kinds:
        content_of_kind = next((content for name, content in _boxes(data, path) if name == kind), None)
        if content_of_kind is None:
            return None
        data = content_of_kind
    return data


def _gpmd_track(index: bytes, path: Path) -> _Track | None:
    for kind, track in _boxes(index, path):
        media = _box(track, (b"mdia",), path) if kind == b"trak" else None
        table = None if media is None else _box(media, (b"minf", b"stbl"), path)
        described = None if table is None else _box(table, (b"stsd",), path)
        if media is None or table is None or described is None or described[12:16] != b"gpmd":
            continue
        if (_box(media, (b"hdlr",), path) or b"")[8:12] != b"meta":
            continue
        header = _box(media, (b"mdhd",), path) or b""
        at = 20 if header[:1] == b"\x01" else 12
        ticks = int.from_bytes(header[at : at + 4], "big")
        if len(header) < at + 4 or not ticks:
            raise _damaged(path, "its track has no time scale")
        return _payloads(table, ticks, path)
    return None


def _table(stbl: bytes, kind: bytes, columns: int, path: Path, *, width: int = 4, skip: int = 4) -> IntArray:
    """Return the rows (N, columns) of a table of unsigned numbers, whose count stands at byte `skip`."""
    data = _box(stbl, (kind,), path)
    if data is None or len(data) < skip + 4:
        raise _damaged(path, f"its table {kind.decode()} is missing")
    count = int.from_bytes(data[skip : skip + 4], "big")
    needed = count * columns * width
    if count > _MOST_PAYLOADS or skip + 4 + needed > len(data):
        raise _damaged(path, f"its table {kind.decode()} is cut off or too large")
    numbers = np.frombuffer(data, f">u{width}", count * columns, skip + 4)
    return numbers.reshape(count, columns).astype(np.int64)


def _payloads(stbl: bytes, ticks: int, path: Path) -> _Track:
    """Return places and times of all payloads by the tables stsz, stsc, stco or co64, and stts."""
    head = _box(stbl, (b"stsz",), path) or b""
    uniform, count = (int.from_bytes(head[at : at + 4], "big") for at in (4, 8))
    if len(head) < 12 or count > _MOST_PAYLOADS:
        raise _damaged(path, "its table stsz is cut off or too large")
    size = np.full(count, uniform) if uniform else _table(stbl, b"stsz", 1, path, skip=8)[:, 0]
    wide = _box(stbl, (b"stco",), path) is None
    chunk_at = (_table(stbl, b"co64", 1, path, width=8) if wide else _table(stbl, b"stco", 1, path))[:, 0]
    runs = _table(stbl, b"stsc", 3, path)  # first chunk, from 1; payloads a chunk; description
    first = runs[:, 0] - 1
    if len(runs) == 0 or first[0] != 0 or (np.diff(first) <= 0).any():
        raise _damaged(path, "its table stsc is not in order")
    in_chunk = runs[np.searchsorted(first, np.arange(len(chunk_at)), side="right") - 1, 1]
    steps = _table(stbl, b"stts", 2, path)
    if in_chunk.sum() < count or in_chunk.sum() > _MOST_PAYLOADS or steps[:, 0].sum() > _MOST_PAYLOADS:
        raise _damaged(path, "its tables state different numbers of payloads")
    duration = np.repeat(steps[:, 1], steps[:, 0])[:count]
    if len(duration) < count or (size > _MOST_PAYLOAD_BYTES).any():
        raise _damaged(path, "its payloads have no times or are too large")
    chunk = np.repeat(np.arange(len(chunk_at)), in_chunk)[:count]
    before = np.cumsum(size) - size
    first_of_chunk = np.searchsorted(chunk, chunk)
    begin = np.cumsum(duration) - duration
    return _Track(
        offset=chunk_at[chunk] + before - before[first_of_chunk],
        size=size,
        begin_s=begin / ticks,
        duration_s=duration / ticks,
    )


def _streams(file: BinaryIO, track: _Track, path: Path) -> Iterator[_Stream]:
    """Yield the streams of positions of all payloads, in order."""
    length = file.seek(0, os.SEEK_END)
    for number, (offset, size) in enumerate(zip(track.offset.tolist(), track.size.tolist(), strict=True)):
        if not 0 <= offset <= length - size:
            raise _damaged(path, "a payload lies outside of the file", number)
        file.seek(offset)
        payload = file.read(size)
        for device, kind, _, content in _triples(payload, path, number):
            if device != b"DEVC" or kind != b"\0":
                continue
            for stream, kind_of_stream, _, items in _triples(content, path, number):
                if stream != b"STRM" or kind_of_stream != b"\0":
                    continue
                yield from _positions(
                    {key: (form, width, data) for key, form, width, data in _triples(items, path, number)},
                    number,
                    (float(track.begin_s[number]), float(track.duration_s[number])),
                    path,
                )


def _triples(data: bytes, path: Path, payload: int) -> Iterator[tuple[bytes, bytes, int, bytes]]:
    """Yield key, type, size of a value and all values, up to padding or the end."""
    at = 0
    while at + 8 <= len(data) and data[at : at + 4] != b"\0\0\0\0":
        key, kind, width, count = struct.unpack_from(">4scBH", data, at)
        end = at + 8 + width * count
        if end > len(data):
            raise _damaged(path, f"the value of {key!r} is cut off", payload)
        yield key, kind, width, data[at + 8 : end]
        at = end + (-end) % 4


def _positions(
    items: dict[bytes, tuple[bytes, int, bytes]], payload: int, span_s: tuple[float, float], path: Path
) -> Iterator[_Stream]:
    """Yield the stream of positions of a stream's triples, if it is one; `span_s`: its beginning and duration."""
    for key, form in ((b"GPS9", b"lllllllSS"), (b"GPS5", b"lllll")):
        if key not in items:
            continue
        kind, width, data = items[key]
        if key == b"GPS9":
            known = kind == b"?" and items.get(b"TYPE", (b"", 0, b""))[2].rstrip(b"\0") == form
        else:
            known = kind == b"l"
        record = np.dtype([(f"c{k}", _NUMBERS[form[k : k + 1]]) for k in range(len(form))])
        if not known or width != record.itemsize:
            raise _damaged(path, f"{key.decode()} has another layout than {form.decode()}", payload)
        rows = np.frombuffer(data, record)
        raw = np.column_stack([rows[name].astype(np.float64) for name in record.names or ()])
        scale = _numbers(items, b"SCAL")
        if len(scale) not in (1, raw.shape[1]) or not scale.all() or not np.isfinite(scale).all():
            raise _damaged(path, f"SCAL does not fit {key.decode()}", payload)
        scaled = raw / scale
        if key == b"GPS9":
            fix, dop = scaled[:, 8], scaled[:, 7]
            utc_s = _DAY_ZERO_S + 86_400.0 * scaled[:, 5] + scaled[:, 6]
        else:
            fix, dop = (
                np.full(len(rows), (list(_numbers(items, name)) or [missing])[0] / unit)
                for name, missing, unit in ((b"GPSF", 0.0, 1.0), (b"GPSP", 0.0, 100.0))
            )
            begin_utc = _utc_s(items.get(b"GPSU", (b"", 0, b""))[2])
            utc_s = begin_utc + span_s[1] * np.arange(len(rows)) / max(len(rows), 1)
        heights = items.get(b"GPSA", (b"", 0, b""))[2][:4].decode("ascii", "replace").rstrip("\0 ")
        yield _Stream(key, payload, *span_s, heights, np.column_stack([scaled[:, :3], fix, dop, utc_s]))
        return


def _numbers(items: dict[bytes, tuple[bytes, int, bytes]], key: bytes) -> FloatArray:
    """Return the numbers of a triple (N,); none where it is missing or no number."""
    kind, _, data = items.get(key, (b"", 0, b""))
    if kind not in _NUMBERS:
        return np.zeros(0)
    form = np.dtype(_NUMBERS[kind])
    return np.frombuffer(data, form, len(data) // form.itemsize).astype(np.float64)


def _utc_s(text: bytes) -> float:
    """Return the seconds since 1970 of yymmddhhmmss.sss; NaN: it is no such time."""
    try:
        moment = datetime.strptime(text.decode("ascii"), "%y%m%d%H%M%S.%f")
    except ValueError:
        return float("nan")
    return moment.replace(tzinfo=UTC).timestamp()
