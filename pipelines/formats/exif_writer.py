"""Writing of EXIF and DJI-like XMP into a JPEG: position, attitude, time, lens.

EXIF is a TIFF of a few directories in an APP1 segment, and XMP an XML packet in another. This file writes both,
because libraries for them are unmaintained or bring a whole image library.
Sources: CIPA DC-008 (EXIF 2.32); DJI tags of photographs of M300 and Phantom 4 RTK.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from xml.sax.saxutils import quoteattr

from pipelines.core.errors import InputError

_SHORT, _ASCII, _LONG, _RATIONAL, _BYTE = 3, 2, 4, 5, 1
_SENSOR_MM = 13.2  # width of a 1-inch sensor
_XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\x00"
_SEGMENT_LIMIT = 65533


@dataclass(frozen=True)
class DroneTags:
    """Tags that a drone writes into a photograph."""

    width: int
    height: int
    focal_px: float
    stamp_ns: int  # UTC, nanoseconds since 1970
    lat_deg: float
    lon_deg: float
    alt_m: float  # ellipsoidal, WGS84
    relative_alt_m: float  # above the place of take-off
    yaw_pitch_roll_deg: tuple[float, float, float]  # of the gimbal
    body_yaw_pitch_roll_deg: tuple[float, float, float]  # of the aircraft
    # σ that the receiver states; None: a plain receiver, which states no σ
    sigma_enu_m: tuple[float, float, float] | None


def with_tags(jpeg: bytes, tags: DroneTags) -> bytes:
    """Return the JPEG with an EXIF and an XMP segment at its start.

    Raises:
        InputError: not a JPEG.
    """
    if jpeg[:2] != b"\xff\xd8":
        raise InputError("not-a-jpeg", "EXIF can be written into a JPEG only; the image is not one.")
    exif = _segment(b"Exif\x00\x00" + _tiff(tags))
    xmp = _segment(_XMP_HEADER + _xmp(tags).encode("utf-8"))
    return jpeg[:2] + exif + xmp + jpeg[2:]


def _segment(payload: bytes) -> bytes:
    if len(payload) > _SEGMENT_LIMIT:
        raise InputError("metadata-too-large", "The metadata are too large for one segment of a JPEG.")
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


Entry = tuple[int, bytes, int]  # type, value, count


def _ascii(text: str) -> Entry:
    value = text.encode("ascii") + b"\x00"
    return _ASCII, value, len(value)


def _short(value: int) -> Entry:
    return _SHORT, struct.pack("<H", value), 1


def _long(value: int) -> Entry:
    return _LONG, struct.pack("<L", value), 1


def _rationals(*values: float, denominator: int) -> Entry:
    parts = [Fraction(round(value * denominator), denominator) for value in values]
    return _RATIONAL, b"".join(struct.pack("<LL", part.numerator, part.denominator) for part in parts), len(parts)


def _degrees(value: float) -> Entry:
    """Return degrees, minutes and seconds, the seconds to a microsecond of arc (0.03 mm)."""
    micro = round(abs(value) * 3600e6)
    degrees, arc = divmod(micro, 3600_000_000)
    minutes, seconds = divmod(arc, 60_000_000)
    return _RATIONAL, struct.pack("<6L", degrees, 1, minutes, 1, seconds, 1_000_000), 3


def _tiff(tags: DroneTags) -> bytes:
    """Return a little-endian TIFF: the main directory, then the EXIF and the GPS directory."""
    time = datetime.fromtimestamp(tags.stamp_ns // 1_000_000_000, UTC)
    fraction = f"{tags.stamp_ns % 1_000_000_000:09d}"
    day = time.strftime("%Y:%m:%d")
    focal_mm = tags.focal_px * _SENSOR_MM / tags.width
    pixels_per_cm = tags.width / _SENSOR_MM * 10
    exif = {
        0x9000: (7, b"0232", 4),
        0x9003: _ascii(time.strftime("%Y:%m:%d %H:%M:%S")),
        0x9011: _ascii("+00:00"),
        0x9291: _ascii(fraction),
        0x920A: _rationals(focal_mm, denominator=1_000_000),
        0xA002: _long(tags.width),
        0xA003: _long(tags.height),
        0xA20E: _rationals(pixels_per_cm, denominator=10_000),
        0xA20F: _rationals(pixels_per_cm, denominator=10_000),
        0xA210: _short(3),
        0xA405: _short(round(tags.focal_px / tags.width * 36)),
    }
    seconds = time.second + tags.stamp_ns % 1_000_000_000 / 1e9
    gps = {
        0x0000: (_BYTE, bytes([2, 3, 0, 0]), 4),
        0x0001: _ascii("N" if tags.lat_deg >= 0 else "S"),
        0x0002: _degrees(tags.lat_deg),
        0x0003: _ascii("E" if tags.lon_deg >= 0 else "W"),
        0x0004: _degrees(tags.lon_deg),
        0x0005: (_BYTE, bytes([0 if tags.alt_m >= 0 else 1]), 1),
        0x0006: _rationals(abs(tags.alt_m), denominator=10_000),
        0x0007: _rationals(time.hour, time.minute, seconds, denominator=1_000_000),
        0x0012: _ascii("WGS-84"),
        0x001D: _ascii(day),
    }
    main = {
        0x010F: _ascii("GeoRefGS"),
        0x0110: _ascii("Simulator"),
        0x0112: _short(1),
        0x0132: _ascii(time.strftime("%Y:%m:%d %H:%M:%S")),
        0x8769: _long(0),
        0x8825: _long(0),
    }
    start = 8
    exif_at = start + len(_directory(main, start))
    gps_at = exif_at + len(_directory(exif, exif_at))
    main[0x8769], main[0x8825] = _long(exif_at), _long(gps_at)
    directories = ((main, start), (exif, exif_at), (gps, gps_at))
    return b"II*\x00" + struct.pack("<L", start) + b"".join(_directory(*placed) for placed in directories)


def _directory(entries: Mapping[int, Entry], offset: int) -> bytes:
    """Return a directory for the place `offset`, followed by the values that do not fit into its entries."""
    rows, values = b"", b""
    values_at = offset + 2 + 12 * len(entries) + 4
    for tag, (kind, value, count) in sorted(entries.items()):
        if len(value) <= 4:
            held = value.ljust(4, b"\x00")
        else:
            held = struct.pack("<L", values_at + len(values))
            values += value + b"\x00" * (len(value) % 2)
        rows += struct.pack("<HHL", tag, kind, count) + held
    return struct.pack("<H", len(entries)) + rows + struct.pack("<L", 0) + values


def _xmp(tags: DroneTags) -> str:
    yaw, pitch, roll = tags.yaw_pitch_roll_deg
    body_yaw, body_pitch, body_roll = tags.body_yaw_pitch_roll_deg
    values = {
        "AltitudeType": "GpsFusionAlt" if tags.sigma_enu_m is None else "RtkAlt",
        "GpsLatitude": f"{tags.lat_deg:.9f}",
        "GpsLongitude": f"{tags.lon_deg:.9f}",
        "AbsoluteAltitude": f"{tags.alt_m:+.4f}",
        "RelativeAltitude": f"{tags.relative_alt_m:+.4f}",
        "GimbalYawDegree": f"{yaw:+.4f}",
        "GimbalPitchDegree": f"{pitch:+.4f}",
        "GimbalRollDegree": f"{roll:+.4f}",
        "FlightYawDegree": f"{body_yaw:+.4f}",
        "FlightPitchDegree": f"{body_pitch:+.4f}",
        "FlightRollDegree": f"{body_roll:+.4f}",
        "CalibratedFocalLength": f"{tags.focal_px:.6f}",
    }
    if tags.sigma_enu_m is not None:
        east, north, up = tags.sigma_enu_m
        values |= {
            "RtkFlag": "50",
            "RtkStdLon": f"{east:.5f}",
            "RtkStdLat": f"{north:.5f}",
            "RtkStdHgt": f"{up:.5f}",
        }
    lines = "\n".join(f"   drone-dji:{name}={quoteattr(value)}" for name, value in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"\n'
        f"{lines}/>\n </rdf:RDF>\n</x:xmpmeta>\n"
        '<?xpacket end="w"?>'
    )
