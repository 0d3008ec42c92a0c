"""Tags of a photograph: EXIF's position, time and lens, and DJI's XMP with gimbal angles, RTK state and altitudes.

Thousands of programs write EXIF. A tag that cannot be trusted (a zero denominator, a latitude without its
hemisphere, 0° 0°) counts as absent, and the reason is kept for the log. DJI's XMP has attribute or element form;
its packet must be short and lie in the first or last mebibyte of a file. defusedxml refuses entities and document
types.
"""

import contextlib
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal
from xml.etree.ElementTree import Element, ParseError

from pipelines.core.types import Vector3

_SEARCHED_BYTES = 1024 * 1024
_MAX_PACKET_BYTES = 256 * 1024
_OPEN, _CLOSE = b"<x:xmpmeta", b"</x:xmpmeta>"

RTK_FIXED = 50
RTK_FLOAT = 34
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\x00", b"MM\x00*")
# A JPEG's EXIF lies in one of its first segments of 64 KiB. The parser gets no more than this head.
_JPEG_HEAD_BYTES = 1024 * 1024
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # by EXIF's FocalPlaneResolutionUnit
_BELOW_ZERO = frozenset({1, 3})  # EXIF 3.0 added 2 and 3: above and below sea level, stated explicitly
_WGS84_NAMES = frozenset({"", "WGS84"})
_GPS_H_ERROR = ("GPS GPSHPositioningError", "GPS Tag 0x001F")
TimeSource = Literal["offset", "gps", "assumed UTC"]


@dataclass(frozen=True)
class DjiTags:
    """DJI's tags; None if absent."""

    gimbal_yaw_pitch_roll_deg: Vector3 | None = None  # Z-Y-X from North-East-Down
    rtk_flag: int | None = None  # 50 fixed, 34 float, 16 single point, 0 none
    rtk_sigma_enu_m: Vector3 | None = None
    absolute_altitude_m: float | None = None  # above the same reference as `GPSAltitude`


@dataclass(frozen=True)
class GpsTag:
    """Position of a photograph; without a name, the map datum is WGS84."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None
    sigma_h_m: float | None
    datum: str


@dataclass(frozen=True)
class LensTags:
    """Tags of the lens; None if absent."""

    focal_mm: float | None = None
    focal_35mm_mm: float | None = None  # focal length of the same angle of view on 35 mm film
    px_per_mm: float | None = None  # resolution of the original image, which may have been scaled since
    taken_width_px: float | None = None  # longer side of the original image
    zoom: float = 1.0  # digital zoom, 1 without zoom


@dataclass(frozen=True)
class PhotoTags:
    """Metadata of a photograph."""

    make: str = ""
    model: str = ""
    orientation: int = 1  # 1 for upright
    lens: LensTags = LensTags()
    timestamp_s: float | None = None  # seconds since 1970 UTC; `time_source` is the source of the time zone
    time_source: TimeSource | None = None
    gps: GpsTag | None = None
    dji: DjiTags | None = None
    problems: tuple[str, ...] = ()  # why tags were not used, one phrase each

    @property
    def make_model(self) -> str:
        """Make and model, without a repetition of the make."""
        return self.model if self.model.startswith(self.make) else f"{self.make} {self.model}"


def read_tags(data: bytes) -> PhotoTags:
    """Return EXIF and DJI XMP of a photograph; tags that cannot be read become `problems`, never an error."""
    problems: list[str] = []
    tags = _exif(data, problems)
    try:
        dji = read_dji(data)
    except XmpError as error:
        dji = None
        problems.append(str(error))
    timestamp_s, time_source = _time(tags)
    return PhotoTags(
        make=_text(tags, "Image Make"),
        model=_text(tags, "Image Model"),
        orientation=int(_number(tags, "Image Orientation") or 1),
        lens=_lens(tags),
        timestamp_s=timestamp_s,
        time_source=time_source,
        gps=_gps(tags, problems),
        dji=dji,
        problems=tuple(problems),
    )


def _exif(data: bytes, problems: list[str]) -> Mapping[str, Any]:
    import exifread

    if data[:2] == _JPEG:
        data = data[:_JPEG_HEAD_BYTES]
    elif data[:4] not in _TIFF:
        return {}
    try:
        tags: Mapping[str, Any] = exifread.process_file(io.BytesIO(data), details=False)
    except Exception as error:  # the parser's arithmetic on broken bytes may raise any error
        problems.append(f"the EXIF data cannot be read ({type(error).__name__})")
        return {}
    return tags


def _gps(tags: Mapping[str, Any], problems: list[str]) -> GpsTag | None:
    lat = _degrees(tags, "GPS GPSLatitude")
    lon = _degrees(tags, "GPS GPSLongitude")
    if lat is None or lon is None:
        if "GPS GPSLatitude" in tags or "GPS GPSLongitude" in tags:
            problems.append("the GPS latitude or longitude is not a number")
        return None
    lat_side = _text(tags, "GPS GPSLatitudeRef")[:1].upper()
    lon_side = _text(tags, "GPS GPSLongitudeRef")[:1].upper()
    if lat_side not in ("N", "S") or lon_side not in ("E", "W"):
        problems.append("the GPS position does not say its hemisphere")
        return None
    lat, lon = (-lat if lat_side == "S" else lat), (-lon if lon_side == "W" else lon)
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        problems.append(f"the GPS position {lat:.6g}, {lon:.6g} is out of range")
        return None
    if lat == 0.0 and lon == 0.0:
        problems.append("the GPS position is 0, 0, which means none")
        return None
    datum = _text(tags, "GPS GPSMapDatum")
    plain = datum.upper().replace("-", "").replace(" ", "")
    altitude = _number(tags, "GPS GPSAltitude")
    if altitude is not None and _number(tags, "GPS GPSAltitudeRef") in _BELOW_ZERO:
        altitude = -altitude
    sigma_h_m = next(filter(None, (_positive(_number(tags, key)) for key in _GPS_H_ERROR)), None)
    return GpsTag(lat, lon, altitude, sigma_h_m, "" if plain in _WGS84_NAMES else datum)


def _lens(tags: Mapping[str, Any]) -> LensTags:
    resolution = _number(tags, "EXIF FocalPlaneXResolution")
    unit = _MM_PER_UNIT.get(int(_number(tags, "EXIF FocalPlaneResolutionUnit") or 2))
    sides = [_number(tags, f"EXIF ExifImage{side}") for side in ("Width", "Length")]
    zoom = _number(tags, "EXIF DigitalZoomRatio")
    return LensTags(
        focal_mm=_positive(_number(tags, "EXIF FocalLength")),
        focal_35mm_mm=_positive(_number(tags, "EXIF FocalLengthIn35mmFilm")),
        px_per_mm=resolution / unit if resolution and resolution > 0 and unit else None,
        taken_width_px=_positive(max((side for side in sides if side is not None), default=None)),
        zoom=zoom if zoom is not None and zoom > 1.0 else 1.0,
    )


def _time(tags: Mapping[str, Any]) -> tuple[float | None, TimeSource | None]:
    """Return seconds since 1970 UTC: by the clock's own zone, else from GPS, else with the clock taken for UTC."""
    local = _datetime(_text(tags, "EXIF DateTimeOriginal") or _text(tags, "Image DateTime"))
    fraction = _text(tags, "EXIF SubSecTimeOriginal") or _text(tags, "EXIF SubSecTime")
    seconds = float(f"0.{fraction}") if fraction.isascii() and fraction.isdigit() else 0.0
    zone = _text(tags, "EXIF OffsetTimeOriginal") or _text(tags, "EXIF OffsetTime")
    if local is not None:
        with contextlib.suppress(ValueError):  # no offset such as +02:00
            return datetime.strptime(f"{local} {zone}", "%Y-%m-%d %H:%M:%S %z").timestamp() + seconds, "offset"
    stamp = _numbers(tags, "GPS GPSTimeStamp")
    day = _datetime(_text(tags, "GPS GPSDate") + " 00:00:00")
    if len(stamp) == 3 and day is not None:
        return day.replace(tzinfo=UTC).timestamp() + 3600 * stamp[0] + 60 * stamp[1] + stamp[2], "gps"
    if local is not None:
        return local.replace(tzinfo=UTC).timestamp() + seconds, "assumed UTC"
    return None, None


def _datetime(text: str) -> datetime | None:
    try:
        return datetime.strptime(text.strip("\x00 ")[:19].replace("-", ":"), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None


def _text(tags: Mapping[str, Any], key: str) -> str:
    tag = tags.get(key)
    values = getattr(tag, "values", "")
    return values.strip("\x00 ") if isinstance(values, str) else ""


def _numbers(tags: Mapping[str, Any], key: str) -> list[float]:
    """Return all values of a tag, or none if one of them is not a number."""
    values = getattr(tags.get(key), "values", None)
    if values is None or isinstance(values, str):
        return []
    numbers = []
    for value in values if isinstance(values, (list, tuple)) else [values]:
        if hasattr(value, "den") and value.den == 0:
            return []
        try:
            numbers.append(float(value))
        except (TypeError, ValueError, OverflowError):
            return []
    return numbers if all(math.isfinite(value) for value in numbers) else []


def _number(tags: Mapping[str, Any], key: str) -> float | None:
    values = _numbers(tags, key)
    return values[0] if values else None


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _degrees(tags: Mapping[str, Any], key: str) -> float | None:
    """Return degrees from degrees, minutes and seconds; some writers omit seconds, or minutes too."""
    values = _numbers(tags, key)
    if not 1 <= len(values) <= 3 or min(values) < 0.0:
        return None
    return sum(value / 60.0**power for power, value in enumerate(values))


class XmpError(ValueError):
    """A packet exists, but cannot be read."""


def read_dji(data: bytes) -> DjiTags | None:
    """Return DJI's tags of a photograph, or None without an XMP packet.

    Raises:
        XmpError: a packet that is too long or not well formed.
    """
    packet = _find_packet(data)
    if packet is None:
        return None
    values = _values(packet)
    sigma = _triple(values, "RtkStdLon", "RtkStdLat", "RtkStdHgt")  # DJI writes zero for an unknown σ
    return DjiTags(
        gimbal_yaw_pitch_roll_deg=_triple(values, "GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
        rtk_flag=None if (flag := _xmp_number(values, "RtkFlag")) is None else int(flag),
        rtk_sigma_enu_m=sigma if sigma is not None and min(sigma) > 0.0 else None,
        absolute_altitude_m=_xmp_number(values, "AbsoluteAltitude"),
    )


def _find_packet(data: bytes) -> bytes | None:
    """Return the XMP packet in the first or last mebibyte of a file, or None."""
    for part in (data[:_SEARCHED_BYTES], data[max(_SEARCHED_BYTES, len(data) - _SEARCHED_BYTES) :]):
        begin = part.find(_OPEN)
        if begin < 0:
            continue
        end = part.find(_CLOSE, begin, begin + _MAX_PACKET_BYTES)
        if end < 0:
            raise XmpError("the XMP packet has no end within 256 KiB")
        return part[begin : end + len(_CLOSE)]
    return None


def _values(packet: bytes) -> dict[str, str]:
    """Return the properties that attributes or elements have as text, by local name; the first of a name counts."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        root: Element = fromstring(packet, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise XmpError(f"the XMP packet is not well formed: {error}") from error
    properties: dict[str, str] = {}
    for element in root.iter():
        listed = list(element.attrib.items())
        if element.text and not len(element):
            listed.append((element.tag, element.text))
        for name, text in listed:
            properties.setdefault(name.rsplit("}", maxsplit=1)[-1], text)
    return properties


def _xmp_number(values: dict[str, str], key: str) -> float | None:
    try:
        value = float(values[key])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _triple(values: dict[str, str], *keys: str) -> Vector3 | None:
    first, second, third = (_xmp_number(values, key) for key in keys)
    if first is None or second is None or third is None:
        return None
    return (first, second, third)
