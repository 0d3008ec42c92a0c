"""MP4 files with a GoPro's telemetry track, written box by box."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

TICKS = 1000  # of the track, a second


@dataclass(frozen=True)
class Sample:
    """Position with its latitude and longitude in degrees and its height in metres."""

    lat: float
    lon: float
    height: float
    fix: int = 3
    dop: float = 1.5
    utc: tuple[int, float] = (9617, 43_200.0)  # days since 2000, seconds of the day


@dataclass(frozen=True)
class Payload:
    samples: Sequence[Sample]
    duration_s: float = 1.0
    extra: dict[str, bytes] = field(default_factory=dict)  # triples put before the positions


def triple(key: str, kind: bytes, width: int, data: bytes) -> bytes:
    assert len(data) % width == 0
    head = struct.pack(">4scBH", key.encode(), kind, width, len(data) // width)
    return head + data + b"\0" * (-len(data) % 4)


def nested(key: str, data: bytes) -> bytes:
    return struct.pack(">4scBH", key.encode(), b"\0", 4, len(data) // 4) + data


def gps5(payload: Payload, *, clock: str = "260501120000.000", heights: bytes = b"") -> bytes:
    """Return a payload with the positions as GPS5; fix and DOP are those of the first."""
    first = payload.samples[0]
    scale = (10_000_000, 10_000_000, 1000, 1000, 100)
    rows = [(s.lat * 1e7, s.lon * 1e7, s.height * 1e3, 0, 0) for s in payload.samples]
    items = [
        triple("STNM", b"c", 3, b"GPS"),
        triple("GPSF", b"L", 4, struct.pack(">I", first.fix)),
        triple("GPSU", b"U", 16, clock.encode()),
        triple("GPSP", b"S", 2, struct.pack(">H", round(100 * first.dop))),
        triple("GPSA", b"F", 4, heights) if heights else b"",
        triple("SCAL", b"l", 4, struct.pack(">5i", *scale)),
        *payload.extra.values(),
        triple("GPS5", b"l", 20, b"".join(struct.pack(">5i", *map(round, row)) for row in rows)),
    ]
    motion = nested("STRM", triple("ACCL", b"s", 6, bytes(18)))
    return nested("DEVC", triple("DVID", b"L", 4, bytes(4)) + motion + nested("STRM", b"".join(items)))


def gps9(payload: Payload, *, heights: bytes = b"MSLV") -> bytes:
    """Return a payload with the positions as GPS9."""
    scale = (10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1)
    rows = [
        (s.lat * 1e7, s.lon * 1e7, s.height * 1e3, 0, 0, s.utc[0], s.utc[1] * 1e3, s.dop * 100, s.fix)
        for s in payload.samples
    ]
    items = [
        triple("GPSA", b"F", 4, heights) if heights else b"",
        triple("TYPE", b"c", 1, b"lllllllSS"),
        triple("SCAL", b"l", 4, struct.pack(">9i", *scale)),
        triple("GPS9", b"?", 32, b"".join(struct.pack(">7i2H", *map(round, row)) for row in rows)),
    ]
    return nested("DEVC", nested("STRM", b"".join(items)))


def box(kind: str, *contents: bytes) -> bytes:
    data = b"".join(contents)
    return struct.pack(">I4s", 8 + len(data), kind.encode()) + data


def track(payloads: Sequence[bytes], durations_s: Sequence[float], offset: int) -> bytes:
    """Return the track of payloads that lie one behind the other from a byte of the file on, two in a chunk."""
    count, chunks = len(payloads), [payloads[k : k + 2] for k in range(0, len(payloads), 2)]
    places, at = [], offset
    for chunk in chunks:
        places.append(at)
        at += sum(map(len, chunk))
    runs = [(1, 2, 1)] + ([(len(chunks), 1, 1)] if count % 2 and len(chunks) > 1 else [])
    if len(chunks) == 1:
        runs = [(1, count, 1)]
    steps = b"".join(struct.pack(">II", 1, round(TICKS * step)) for step in durations_s)
    table = box(
        "stbl",
        box("stsd", struct.pack(">II", 0, 1), box("gpmd", bytes(6), b"\0\1", bytes(4))),
        box("stts", struct.pack(">II", 0, count), steps),
        box("stsc", struct.pack(">II", 0, len(runs)), *(struct.pack(">III", *run) for run in runs)),
        box("stsz", struct.pack(">III", 0, 0, count), *(struct.pack(">I", len(one)) for one in payloads)),
        box("stco", struct.pack(">II", 0, len(places)), *(struct.pack(">I", place) for place in places)),
    )
    total = round(TICKS * sum(durations_s))
    header = box("mdhd", struct.pack(">IIIIIHH", 0, 0, 0, TICKS, total, 0, 0))
    handler = box("hdlr", bytes(4), b"mhlrmeta", bytes(12), b"GoPro MET\0")
    matrix = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    head = box("tkhd", struct.pack(">5I", 0xF, 0, 0, 9, 0), struct.pack(">I", total), bytes(16), matrix, bytes(8))
    info = box("minf", box("gmhd", box("gmin", bytes(16))), table)
    return box("trak", head, box("mdia", header, handler, info))


def with_telemetry(video: bytes, payloads: Sequence[bytes], durations_s: Sequence[float]) -> bytes:
    """Return an MP4 file whose index comes last, with a further track of payloads."""
    at = video.rindex(b"moov") - 4
    index = video[at + 8 :]
    assert struct.unpack_from(">I", video, at)[0] == len(index) + 8
    empty = box("moov", index, track(payloads, durations_s, 0))
    begin = at + len(empty) + 8
    return video[:at] + box("moov", index, track(payloads, durations_s, begin)) + box("mdat", *payloads)


def telemetry_alone(payloads: Sequence[bytes], durations_s: Sequence[float]) -> bytes:
    """Return an MP4 file of the telemetry track alone."""
    return with_telemetry(box("ftyp", b"mp41", bytes(4)) + box("moov"), payloads, durations_s)
