"""Tags of a photograph: EXIF's and XMP's position, time and lens, attitude, RTK state and altitudes of a drone.

Thousands of programs write EXIF. A tag that cannot be trusted (a zero denominator, a latitude without its
hemisphere, 0° 0°) counts as absent, and the reason is kept for the log. A tag whose form is wrong and whose meaning
is not (a reference as text, a sign in the value, a negative number written as a positive one) is read, and the
correction kept as well. All sources of one quantity are returned: who uses them compares them.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

from PIL import ExifTags

from pipelines.core.types import Vector3
from pipelines.formats.exif_time import NO_TIMES, TimeSource, TimeTags, times_of
from pipelines.formats.photo_blocks import find_blocks
from pipelines.formats.tables import with_decimal_point
from pipelines.formats.tiff_tags import Tag, read_directory
from pipelines.formats.xmp import Xmp, number_of, read_packets

RTK_FIXED = 50
RTK_FLOAT = 34
_MAX_TAG_BYTES = 4096  # makers' notes and previews are not kept
_EXIF_DIRECTORY, _GPS_DIRECTORY = 0x8769, 0x8825
# Names that differ from Pillow's: the standard's spelling, and short ones.
_OWN_NAMES = {
    0x001D: "GPSDate", 0x9290: "SubSecTime", 0x9291: "SubSecTimeOriginal", 0x9292: "SubSecTimeDigitized",
    0xA003: "ExifImageLength",
}  # fmt: skip
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # by EXIF's FocalPlaneResolutionUnit
_ABOVE_ZERO, _BELOW_ZERO = frozenset({0, 2}), frozenset({1, 3})  # EXIF 3.0 added 2 and 3
_WGS84_NAMES = frozenset({"", "WGS84"})
_WRAP = 2.0**32  # a negative number of 32 bits that is written without its sign
_HIGHEST_M = 20_000.0  # no photograph of a survey is taken higher
_FOOT_M = 0.3048
_NO_35_MM = frozenset({1.0, 65535.0})  # how cameras write that they do not know
_TEXT_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
# Degrees with a decimal comma: no minutes have three digits. Degrees and minutes (`46,1.2N`) have a decimal point.
_DECIMAL_COMMA = re.compile(r"\s*([+-]?\d+),(\d{3,})\s*°?\s*([NSEW]?)\s*", re.IGNORECASE)
# Names of latitude and longitude: DJI's (an early one misspelt) and Adobe's, Skydio's and Autel's.
_XMP_AXES = (("GpsLatitude", ("GpsLongitude", "GpsLongtitude")), ("Latitude", ("Longitude",)))
_VOID = frozenset({"invalid", "v", "void", "none"})
_PLACES_OF_CAMERAS = frozenset({"", "position", "gps", "gpsposition", "location", "cameraposition"})
GpsSource = Literal["EXIF", "XMP"]


@dataclass(frozen=True)
class DjiTags:
    """Tags of a drone, by DJI's names or by those of other makers that mean the same; None if absent."""

    gimbal_yaw_pitch_roll_deg: Vector3 | None = None  # Z-Y-X from North-East-Down
    mount_yaw_pitch_roll_deg: Vector3 | None = None  # of what a camera is mounted on that looks down, as PIX4D's
    rtk_flag: int | None = None  # 50 fixed, 34 float, 16 single point, 0 none
    rtk_sigma_enu_m: Vector3 | None = None
    absolute_altitude_m: float | None = None  # above the same reference as `GPSAltitude`
    relative_altitude_m: float | None = None  # above the place of take-off
    flight_yaw_deg: float | None = None  # of the aircraft's nose
    sigma_h_m: float | None = None  # of the position, as PIX4D's tags state it
    sigma_v_m: float | None = None


@dataclass(frozen=True)
class GpsTag:
    """Position of a photograph; without a name, the map datum is WGS84."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None
    sigma_h_m: float | None
    datum: str
    source: GpsSource = "EXIF"
    void: bool = False  # the receiver says that it had no fix


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
    # σ of `timestamp_s` by its last digit, and of an error that the times of all photographs share
    time_sigma_s: float = 0.0
    time_common_s: float = 0.0
    times: TimeTags = NO_TIMES  # all that the tags state
    gps: GpsTag | None = None  # EXIF's, of its first block that has one
    more_gps: tuple[GpsTag, ...] = ()  # of EXIF's further blocks, and of XMP
    direction_deg: float | None = None  # EXIF's GPSImgDirection from true north
    dji: DjiTags | None = None
    xmp: Xmp = field(default_factory=Xmp)  # every property of every packet
    # every tag, by directory and name: "Image Make", "EXIF LensModel"
    exif: Mapping[str, Tag] = field(default_factory=dict)
    problems: tuple[str, ...] = ()  # why tags were not used, one phrase each
    corrections: tuple[str, ...] = ()  # how tags of a wrong form were read, one sentence each

    @property
    def make_model(self) -> str:
        """Make and model, without a repetition of the make."""
        return self.model if self.model.startswith(self.make) else f"{self.make} {self.model}"

    @property
    def positions(self) -> tuple[GpsTag, ...]:
        """All positions that the tags state, EXIF's first."""
        return self.more_gps if self.gps is None else (self.gps, *self.more_gps)

    @property
    def says_sea_level(self) -> bool:
        """Whether GPSAltitudeRef says in the words of EXIF 3.0 that the altitude counts from sea level."""
        tag = self.exif.get("GPS GPSAltitudeRef")
        return tag is not None and not tag.is_text and tag.data[:1] in (b"\x02", b"\x03")


def read_tags(data: bytes) -> PhotoTags:
    r"""Return EXIF and XMP of a photograph; tags that cannot be read become `problems`, never an error.

    Examples:
        >>> from pipelines.formats.exif_writer import DroneTags, with_tags
        >>> drone = DroneTags(
        ...     width=400, height=300, focal_px=350.0, stamp_ns=0, lat_deg=46.8, lon_deg=7.1, alt_m=512.0,
        ...     relative_alt_m=50.0, yaw_pitch_roll_deg=(0.0, -90.0, 0.0), body_yaw_pitch_roll_deg=(0.0, 0.0, 0.0),
        ...     sigma_enu_m=(0.01, 0.01, 0.02),
        ... )
        >>> tags = read_tags(with_tags(b"\xff\xd8\xff\xd9", drone))
        >>> tags.gps.lat_deg, tags.gps.lon_deg, tags.gps.alt_m, tags.dji.rtk_sigma_enu_m
        (46.8, 7.1, 512.0, (0.01, 0.01, 0.02))
    """
    blocks = find_blocks(data)
    notes = _Notes(list(blocks.problems), [])
    directories = [_tags_of(block) for block in blocks.exif]
    tags: dict[str, Tag] = {}
    for directory in directories:
        tags = directory | tags  # the first of a name counts
    xmp = read_packets(blocks.xmp, notes.problems)
    of_directory = [_gps(directory, notes) for directory in directories]
    in_exif = list(dict.fromkeys(each for each in of_directory if each is not None))
    in_xmp = _xmp_positions(xmp, notes)
    times = times_of(tags, notes.problems)
    timestamp_s, time_source = times.timestamp
    return PhotoTags(
        make=_text(tags, "Image Make"),
        model=_text(tags, "Image Model"),
        orientation=int(_number(tags, "Image Orientation") or 1),
        lens=_lens(tags, notes),
        timestamp_s=timestamp_s,
        time_source=time_source,
        times=times,
        gps=in_exif[0] if in_exif else None,
        more_gps=(*in_exif[1:], *in_xmp),
        direction_deg=_direction(tags),
        dji=_drone(xmp) if xmp else None,
        xmp=xmp,
        exif=tags,
        problems=tuple(dict.fromkeys(notes.problems)),
        corrections=tuple(dict.fromkeys(notes.corrections)),
    )


@dataclass(frozen=True)
class _Notes:
    """Remarks on the tags: why some are not used, and how some of a wrong form were read."""

    problems: list[str]
    corrections: list[str]


def _tags_of(block: bytes) -> dict[str, Tag]:
    """Return the tags of an EXIF block by directory and name."""
    image = read_directory(block, limit_bytes=_MAX_TAG_BYTES)
    tags = {f"Image {_name(number, ExifTags.TAGS)}": tag for number, tag in image.items()}
    for directory, prefix, names in (
        (_EXIF_DIRECTORY, "EXIF", ExifTags.TAGS),
        (_GPS_DIRECTORY, "GPS", ExifTags.GPSTAGS),
    ):
        pointer = image.get(directory)
        if pointer is not None and pointer.fractions:
            entries = read_directory(block, int(pointer.fractions[0][0]), limit_bytes=_MAX_TAG_BYTES)
            tags |= {f"{prefix} {_name(number, names)}": tag for number, tag in entries.items()}
    return tags


def _name(number: int, names: Mapping[int, str]) -> str:
    return _OWN_NAMES.get(number) or names.get(number) or f"0x{number:04X}"


def _gps(tags: Mapping[str, Tag], notes: _Notes) -> GpsTag | None:
    lat, lon = (_signed(tags, f"GPS GPS{axis}", notes) for axis in ("Latitude", "Longitude"))
    if lat is None or lon is None:
        if "GPS GPSLatitude" in tags or "GPS GPSLongitude" in tags:
            notes.problems.append("the GPS latitude or longitude is no angle in degrees, minutes and seconds")
        return None
    if not (math.isfinite(lat) and math.isfinite(lon)):
        notes.problems.append("the GPS position does not say its hemisphere")
        return None
    if not _is_a_place(lat, lon, "GPS position", notes):
        return None
    datum = _text(tags, "GPS GPSMapDatum")
    plain = datum.upper().replace("-", "").replace(" ", "")
    return GpsTag(
        lat_deg=lat,
        lon_deg=lon,
        alt_m=_altitude(tags, notes),
        sigma_h_m=_positive(_number(tags, "GPS GPSHPositioningError")),
        datum="" if plain in _WGS84_NAMES else datum,
        void=_text(tags, "GPS GPSStatus")[:1].upper() == "V",
    )


def _is_a_place(lat: float, lon: float, name: str, notes: _Notes) -> bool:
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        notes.problems.append(f"the {name} {lat:.6g}, {lon:.6g} is out of range")
        return False
    if lat == 0.0 and lon == 0.0:
        notes.problems.append(f"the {name} is 0, 0, which means none")
        return False
    return True


def _signed(tags: Mapping[str, Tag], key: str, notes: _Notes) -> float | None:
    """Return degrees, negative in the south and west; None if they are no number, infinite without a hemisphere.

    A sign in the value says south or west, whatever the reference says.
    """
    tag, axis = tags.get(key), key.removeprefix("GPS GPS").lower()
    if tag is None:
        return None
    negative_side = "S" if axis == "latitude" else "W"
    sides = ("N", "S") if axis == "latitude" else ("E", "W")
    side = _text(tags, f"{key}Ref")[:1].upper()
    if tag.is_text:
        degrees, letter = _degrees_of_text(tag.text)
        if degrees is not None:
            notes.corrections.append(f"The GPS {axis} is a text where EXIF has numbers; it is read as a number.")
            side = letter if letter in sides else side
    else:
        degrees = _degrees(tag.fractions)
        most = 90.0 if axis == "latitude" else 180.0
        if degrees is not None and degrees > most:
            wrapped = _degrees([(a - _WRAP if a >= _WRAP / 2 else a, b) for a, b in tag.fractions])
            if wrapped is not None and -most <= wrapped < 0.0:
                notes.corrections.append(
                    f"The GPS {axis} is a negative number that was written without its sign; it is read as "
                    "negative."
                )
                degrees = wrapped
    if degrees is None:
        return None
    if degrees < 0.0:
        if side in sides and side != negative_side:
            notes.corrections.append(f"The GPS {axis} has a minus and the reference {side}; the minus counts.")
        return degrees
    if side not in sides:
        return math.inf
    return -degrees if side == negative_side else degrees


def _degrees(fractions: Sequence[tuple[float, float]]) -> float | None:
    """Return degrees from degrees, minutes and seconds; some writers omit seconds, or minutes too, or write 0/0.

    None: no numbers, minutes or seconds above 60, or 0/0 behind whole degrees or minutes, whose rest is unknown.
    """
    parts = list(fractions)
    while len(parts) > 1 and parts[-1] == (0, 0):
        parts.pop()
    if not 1 <= len(parts) <= 3 or any(below == 0 for _, below in parts):
        return None
    values = [above / below for above, below in parts]
    if not all(math.isfinite(value) for value in values):
        return None
    if len(parts) < len(fractions) and values[-1].is_integer():
        return None
    if any(abs(below) > 60.0 and above != 0.0 for above, below in pairwise(values)):
        return None
    total = sum(abs(value) / 60.0**power for power, value in enumerate(values))
    return -total if min(values) < 0.0 else total


def _degrees_of_text(text: str) -> tuple[float | None, str]:
    """Return degrees of a text such as `33,24.7407S`, `33 24 44.4` or `-33.41`, and its letter of a hemisphere."""
    if (decimal := _DECIMAL_COMMA.fullmatch(text)) is not None:
        text = f"{decimal[1]}.{decimal[2]}{decimal[3]}"
    numbers = [float(number) for number in _TEXT_NUMBER.findall(text)]
    if not 1 <= len(numbers) <= 3:
        return None, ""
    letter = next((letter for letter in reversed(text.upper()) if letter in "NSEW"), "")
    return _degrees([(number, 1.0) for number in numbers]), letter


def _altitude(tags: Mapping[str, Tag], notes: _Notes) -> float | None:
    tag = tags.get("GPS GPSAltitude")
    if tag is None:
        return None
    if tag.is_text:
        value = _length_m(tag.text)
        if value is not None:
            notes.corrections.append("The GPS altitude is a text where EXIF has a number; it is read as a number.")
    else:
        value = _number(tags, "GPS GPSAltitude")
    if value is None:
        return None
    if value > _HIGHEST_M:
        above, below = tag.fractions[0] if tag.fractions else (value, 1.0)
        wrapped = next((low for bits in (16, 32) if -1000.0 <= (low := (above - 2.0**bits) / below) < 0.0), None)
        if wrapped is None:
            notes.problems.append("the GPS altitude is higher than any flight (20 km)")
            return None
        notes.corrections.append(
            "The GPS altitude is a negative number that was written without its sign; it is read as negative."
        )
        return wrapped
    reference = _altitude_reference(tags, notes)
    if value < 0.0:
        if reference in _BELOW_ZERO:
            notes.corrections.append(
                "The GPS altitude has a minus, and GPSAltitudeRef says below sea level too; it is taken as below "
                "sea level."
            )
        return value
    return -value if reference in _BELOW_ZERO else value


def _altitude_reference(tags: Mapping[str, Tag], notes: _Notes) -> int:
    """Return EXIF's reference of the altitude, 0 if there is none; texts that mean one are read."""
    tag = tags.get("GPS GPSAltitudeRef")
    if tag is None:
        return 0
    if tag.is_text and (text := tag.text.strip("\x01\x02\x03")):
        reference = 1 if text.lstrip("+0").startswith(("1", "3")) or "below" in text.casefold() else 0
        notes.corrections.append(
            f"GPSAltitudeRef is the text {text[:20]!r} where EXIF has a number; it is read as "
            f"{'below' if reference else 'above'} sea level."
        )
        return reference
    numbers = _numbers(tags, "GPS GPSAltitudeRef") or [float(byte) for byte in tag.data[:1]]
    reference = int(numbers[0]) if numbers else 0
    if reference not in _ABOVE_ZERO | _BELOW_ZERO:
        notes.corrections.append(f"GPSAltitudeRef is {reference}, which means nothing; above sea level is assumed.")
        return 0
    return reference


def _length_m(text: str) -> float | None:
    """Return metres of a text such as `396 m`, `396` or `1299 ft`."""
    match = re.fullmatch(r"\s*([+-]?\d+(?:[.,]\d*)?)\s*(m|metres|meters|ft|feet)?\.?\s*", text, re.IGNORECASE)
    if match is None:
        return None
    return float(with_decimal_point(match[1])) * (_FOOT_M if (match[2] or "").casefold().startswith("f") else 1.0)


def _direction(tags: Mapping[str, Tag]) -> float | None:
    """Return the direction of view from true north; None of one from magnetic north."""
    value = _number(tags, "GPS GPSImgDirection")
    true = _text(tags, "GPS GPSImgDirectionRef")[:1].upper() != "M"
    return value if value is not None and true and 0.0 <= value <= 360.0 else None


def _lens(tags: Mapping[str, Tag], notes: _Notes) -> LensTags:
    resolution = _number(tags, "EXIF FocalPlaneXResolution")
    unit = _MM_PER_UNIT.get(int(_number(tags, "EXIF FocalPlaneResolutionUnit") or 2))
    sides = [_number(tags, f"EXIF ExifImage{side}") for side in ("Width", "Length")]
    zoom = _number(tags, "EXIF DigitalZoomRatio")
    equivalent = _positive(_number(tags, "EXIF FocalLengthIn35mmFilm"))
    if equivalent in _NO_35_MM:
        notes.problems.append(f"a focal length of {equivalent:g} mm on 35 mm film means none")
        equivalent = None
    return LensTags(
        focal_mm=_positive(_number(tags, "EXIF FocalLength")),
        focal_35mm_mm=equivalent,
        px_per_mm=resolution / unit if resolution and resolution > 0 and unit else None,
        taken_width_px=_positive(max((side for side in sides if side is not None), default=None)),
        zoom=zoom if zoom is not None and zoom > 1.0 else 1.0,
    )


def _text(tags: Mapping[str, Tag], key: str) -> str:
    tag = tags.get(key)
    return "" if tag is None else tag.text


def _numbers(tags: Mapping[str, Tag], key: str) -> list[float]:
    """Return all values of a tag, or none if one of them is not a number."""
    tag = tags.get(key)
    if tag is None or any(below == 0 for _, below in tag.fractions):
        return []
    numbers = [above / below for above, below in tag.fractions]
    return numbers if all(math.isfinite(value) for value in numbers) else []


def _number(tags: Mapping[str, Tag], key: str) -> float | None:
    values = _numbers(tags, key)
    return values[0] if values else None


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _xmp_positions(xmp: Xmp, notes: _Notes) -> list[GpsTag]:
    """Return the different positions of the camera that XMP states, in the order of the file."""
    tags: list[GpsTag] = []
    for lat_name, lon_names in _XMP_AXES:
        for each in xmp.named(lat_name):
            if each.within.casefold() not in _PLACES_OF_CAMERAS:
                continue
            same = {"within": each.within, "namespace": each.namespace}
            lat, lon = _xmp_degrees(each.text), _xmp_degrees(xmp.text(*lon_names, **same) or "")
            if lat is None or lon is None:
                notes.problems.append("the latitude or longitude in XMP is not a number")
            elif _is_a_place(lat, lon, "position in XMP", notes):
                void = (xmp.text("GpsStatus", namespace=each.namespace) or "").casefold() in _VOID
                tags.append(GpsTag(lat, lon, _xmp_altitude(xmp, each.namespace), None, "", "XMP", void))
    return list(dict.fromkeys(tags))


def _xmp_degrees(text: str) -> float | None:
    """Return degrees of a decimal number, or of Adobe's `33,24.7407S`."""
    if (value := number_of(text)) is not None:
        return value
    degrees, letter = _degrees_of_text(text)
    return degrees if degrees is None or letter not in ("S", "W") else -abs(degrees)


def _xmp_altitude(xmp: Xmp, namespace: str) -> float | None:
    """Return the absolute altitude beside a position, in the words of drones or in Adobe's."""
    absolute = _xmp_height(xmp, namespace)
    if absolute is None:
        absolute = xmp.number("GPSAltitude", namespace=namespace)
        if absolute is not None and xmp.text("GPSAltitudeRef", namespace=namespace) in ("1", "3"):
            absolute = -abs(absolute)
    return absolute


def _xmp_height(xmp: Xmp, namespace: str | None = None) -> float | None:
    """Return a drone's absolute altitude; one that lost its sign in 32 bits is read as negative."""
    value = xmp.number("AbsoluteAltitude", namespace=namespace)
    if value is None or value <= _HIGHEST_M:
        return value
    return next((low for digits in range(7) if -1000.0 <= (low := value - _WRAP / 10.0**digits) < 0.0), None)


def _drone(xmp: Xmp) -> DjiTags:
    sigma = _triple(xmp, ("RtkStdLon", "RtkStdLat", "RtkStdHgt"))  # DJI writes zero for an unknown σ
    turned = ("Yaw", "Pitch", "Roll")
    gimbal = (
        _triple(xmp, [f"Gimbal{angle}Degree" for angle in turned])
        or _triple(xmp, [f"Camera{angle}Degree" for angle in turned])  # Parrot
        or _triple(xmp, turned, within="CameraOrientationNED")  # Skydio
    )
    mount = _triple(xmp, turned, within="", namespace="pix4d.com/camera")
    flight_yaw = xmp.number("FlightYawDegree", "DroneYawDegree")
    if flight_yaw is None:
        flight_yaw = xmp.number("Yaw", within="VehicleOrientationNED")
    flag = xmp.number("RtkFlag")
    return DjiTags(
        gimbal_yaw_pitch_roll_deg=gimbal,
        # Cameras without an attitude write zeros.
        mount_yaw_pitch_roll_deg=mount if mount != (0.0, 0.0, 0.0) else None,
        rtk_flag=None if flag is None else int(flag),
        rtk_sigma_enu_m=sigma if sigma is not None and min(sigma) > 0.0 else None,
        absolute_altitude_m=_xmp_height(xmp),
        relative_altitude_m=xmp.number("RelativeAltitude"),
        flight_yaw_deg=flight_yaw,
        sigma_h_m=_positive(xmp.number("GPSXYAccuracy")),
        sigma_v_m=_positive(xmp.number("GPSZAccuracy")),
    )


def _triple(
    xmp: Xmp, names: Sequence[str], within: str | None = None, namespace: str | None = None
) -> Vector3 | None:
    first, second, third = (xmp.number(name, within=within, namespace=namespace) for name in names)
    if first is None or second is None or third is None:
        return None
    return (first, second, third)
