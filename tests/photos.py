"""Small photographs with hand-built EXIF and XMP, so that the readers are tested against the standard's bytes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

Value = str | int | Sequence[tuple[int, int]]
Entry = tuple[int, int, Value]  # tag, TIFF type, value

ASCII, BYTE, SHORT, LONG, RATIONAL = 2, 1, 3, 4, 5
_SIZE = {ASCII: 1, BYTE: 1, SHORT: 2, LONG: 4, RATIONAL: 8}


@dataclass
class Exif:
    """Entries of the three directories of an EXIF block."""

    image: list[Entry] = field(default_factory=list)
    photo: list[Entry] = field(default_factory=list)
    gps: list[Entry] = field(default_factory=list)

    def tiff(self) -> bytes:
        """Return the block as a little-endian TIFF structure."""
        image = [*self.image, (0x8769, LONG, 0), (0x8825, LONG, 0)]
        photo_at = 8 + len(_directory(image, 8))
        gps_at = photo_at + len(_directory(self.photo, photo_at))
        image[-2:] = [(0x8769, LONG, photo_at), (0x8825, LONG, gps_at)]
        body = _directory(image, 8) + _directory(self.photo, photo_at) + _directory(self.gps, gps_at)
        return b"II*\x00" + struct.pack("<I", 8) + body


def rational(value: float, denominator: int = 1_000_000) -> tuple[int, int]:
    """Return a number as EXIF's fraction."""
    return round(Fraction(value) * denominator), denominator


def gps_entries(lat: float, lon: float, alt: float | None = 100.0) -> list[Entry]:
    """Return GPS tags of a position: degrees, minutes, seconds to 1e-7 arc seconds."""
    entries: list[Entry] = [
        (1, ASCII, "N" if lat >= 0 else "S"),
        (2, RATIONAL, _dms(abs(lat))),
        (3, ASCII, "E" if lon >= 0 else "W"),
        (4, RATIONAL, _dms(abs(lon))),
    ]
    if alt is not None:
        entries += [(5, BYTE, int(alt < 0)), (6, RATIONAL, [rational(abs(alt), 1000)])]
    return entries


def dji_xmp(**values: object) -> bytes:
    """Return DJI's packet in attribute form."""
    attributes = " ".join(f'drone-dji:{key}="{value}"' for key, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def jpeg(
    seed: int = 0, size: tuple[int, int] = (64, 48), exif: Exif | None = None, xmp: bytes | None = None
) -> bytes:
    """Return a JPEG of random pixels, `size` = (width, height)."""
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    plain = cv2.imencode(".jpg", pixels)[1].tobytes()
    segments = b""
    if exif is not None:
        segments += _app1(b"Exif\x00\x00" + exif.tiff())
    if xmp is not None:
        segments += _app1(b"http://ns.adobe.com/xap/1.0/\x00" + xmp)
    return plain[:2] + segments + plain[2:]


def write_flight(
    folder: Path, count: int, *, lat: float = 46.02, lon: float = 7.75, alt: float = 120.0, positions: bool = True
) -> list[str]:
    """Write `count` different JPEGs, 1e-4 degrees of longitude and one second apart; return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for index in range(count):
        exif = Exif(photo=[(0x9003, ASCII, f"2024:05:01 12:00:{index:02d}"), (0x9011, ASCII, "+00:00")])
        if positions:
            exif.gps = gps_entries(lat, lon + 1e-4 * index, alt)
        names.append(f"IMG_{index:04d}.JPG")
        (folder / names[-1]).write_bytes(jpeg(index, exif=exif))
    return names


FLIGHT_START_S = 1714564800.0  # 2024-05-01 12:00:00 UTC


def _dms(degrees: float) -> list[tuple[int, int]]:
    whole = int(degrees)
    minutes = int((degrees - whole) * 60)
    seconds = (degrees - whole - minutes / 60) * 3600
    return [(whole, 1), (minutes, 1), rational(max(seconds, 0.0), 10_000_000)]


def _app1(payload: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def _directory(entries: list[Entry], at: int) -> bytes:
    """Return an image file directory for offset `at`, followed by its long values."""
    after = at + 2 + 12 * len(entries) + 4
    table, heap = b"", b""
    for tag, kind, value in sorted(entries, key=lambda entry: entry[0]):
        data = _encoded(kind, value)
        count = len(data) // _SIZE[kind]
        if len(data) <= 4:
            table += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\x00")
        else:
            table += struct.pack("<HHII", tag, kind, count, after + len(heap))
            heap += data + b"\x00" * (len(data) % 2)
    return struct.pack("<H", len(entries)) + table + b"\x00" * 4 + heap


def _encoded(kind: int, value: Value) -> bytes:
    if isinstance(value, str):
        return value.encode() + b"\x00"
    if isinstance(value, int):
        return struct.pack({BYTE: "<B", SHORT: "<H", LONG: "<I"}[kind], value)
    return b"".join(struct.pack("<II", *pair) for pair in value)
