"""Times of a photograph as its EXIF writes them: the camera's clock with its zone, and the receiver's time.

Programs write fractions of a second into `SubSecTimeOriginal`, into `DateTimeOriginal` itself, or nowhere; zones
into `OffsetTimeOriginal`, `TimeZoneOffset` or nowhere. A value that is no time counts as absent. The last digit of
each time is kept, because it limits what the time is good for.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal

from pipelines.formats.tiff_tags import Tag

TimeSource = Literal["offset", "gps", "assumed UTC"]
_DATE_TIME = re.compile(
    r"(\d{4})[:\-/.](\d{1,2})[:\-/.](\d{1,2})[ T]+(\d{1,2}):(\d{1,2}):(\d{1,2})(?:[.,](\d+))?\s*(Z|[+\-−]\d.*)?"
)
_DATE = re.compile(r"(\d{4})[:\-/.](\d{1,2})[:\-/.](\d{1,2})\b")
_ZONE = re.compile(r"(?:UTC|GMT)?\s*([+\-−])(\d{1,2})(?::?([0-5]\d))?(?::?00)?", re.IGNORECASE)
_CLOCK = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})(?:[.,](\d+))?")
_SUBSEC = re.compile(r"([+\-−]?)(?:0?[.,])?(\d+)")
_MOST_ZONE_S = 14 * 3600
_FIRST_YEAR = 1990  # receivers without a time write 1970 or 1980
_MOST_DIGITS = 9


@dataclass(frozen=True)
class TimeTags:
    """Times as written, None if absent; a step is what the last digit of a time stands for."""

    clock_s: float | None = None  # the camera's clock with its fraction, seconds since 1970 as if it were UTC
    clock_step_s: float = 1.0
    zone_s: float | None = None  # of the camera's clock, seconds east of UTC
    gps_s: float | None = None  # the receiver's, seconds since 1970 UTC
    gps_step_s: float = 1.0

    @property
    def timestamp(self) -> tuple[float | None, TimeSource | None]:
        """Seconds since 1970 UTC, from this photograph alone, and the source of the time zone."""
        if self.clock_s is not None and self.zone_s is not None:
            return self.clock_s - self.zone_s, "offset"
        if self.gps_s is not None:
            return self.gps_s, "gps"
        return self.clock_s, None if self.clock_s is None else "assumed UTC"


NO_TIMES = TimeTags()


def times_of(tags: Mapping[str, Tag], problems: list[str]) -> TimeTags:
    """Return the times of EXIF tags, by directory and name; a stamp that is no time of day is noted.

    Fraction and zone without "Original" in their names are those of `DateTime`, which programs set to the time of
    an edit: they count where the two times are one.
    """
    written = _text(tags, "Image DateTime")
    moment = _text(tags, "EXIF DateTimeOriginal") or written
    fraction, zone = _text(tags, "EXIF SubSecTimeOriginal"), _text(tags, "EXIF OffsetTimeOriginal")
    if written[:19] in ("", moment[:19]):
        fraction, zone = fraction or _text(tags, "EXIF SubSecTime"), zone or _text(tags, "EXIF OffsetTime")
    clock = clock_of(moment, fraction)
    clock_s, clock_step_s, own_zone_s = (None, 1.0, None) if clock is None else clock
    hours = tags.get("EXIF TimeZoneOffset")
    zones = (
        own_zone_s,
        zone_of(zone),
        None if hours is None else zone_of_hours([a / b for a, b in hours.fractions if b]),
    )
    zone_s = next((known for known in zones if known is not None), None)
    stamp = tags.get("GPS GPSTimeStamp")
    if stamp is None or not (stamp.text or any(den for _, den in stamp.fractions)):  # 0/0 is how cameras write none
        return TimeTags(clock_s, clock_step_s, zone_s)
    of_day = time_of_day(stamp.text if stamp.is_text else stamp.fractions)
    if of_day is None:
        numbers = ":".join(f"{num / den if den else num:g}" for num, den in stamp.fractions[:3])
        problems.append(f"the GPSTimeStamp {stamp.text[:20] if stamp.is_text else numbers} is no time of day")
        return TimeTags(clock_s, clock_step_s, zone_s)
    date = _text(tags, "GPS GPSDate")
    day_s = day_of(date)
    if date and day_s is None:
        problems.append(f"the GPSDateStamp {date[:20]} is the date of a receiver without a time")
        return TimeTags(clock_s, clock_step_s, zone_s)
    gps_s = gps_near(of_day[0], day_s, clock_s, zone_s)
    return TimeTags(clock_s, clock_step_s, zone_s, gps_s, of_day[1])


def _text(tags: Mapping[str, Tag], key: str) -> str:
    """Return a tag as text, which some programs write as a number."""
    tag = tags.get(key)
    if tag is None:
        return ""
    if tag.is_text or not tag.fractions or tag.fractions[0][1] != 1:
        return tag.text
    return f"{tag.fractions[0][0]:.0f}"


def clock_of(text: str, fraction: str) -> tuple[float, float, float | None] | None:
    """Return seconds since 1970 as if a date and time were UTC, their step, and the zone that the text names.

    The fraction is a text of digits. One with a minus sign, as MicaSense's cameras write it, is subtracted. A
    fraction in the text itself outranks it. None: the text is no date and time.
    """
    match = _DATE_TIME.fullmatch(text.strip("\x00 "))
    if match is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    if hour > 24 or minute > 59 or second > 60:
        return None
    try:
        whole = datetime(year, month, day, tzinfo=UTC) + timedelta(hours=hour, minutes=minute, seconds=second)
    except (ValueError, OverflowError):
        return None
    part_s, step_s = 0.0, 1.0
    if match[7]:
        part_s, step_s = _fraction("", match[7])
    elif (subsecond := _SUBSEC.fullmatch(fraction.strip("\x00 "))) is not None:
        part_s, step_s = _fraction(subsecond[1], subsecond[2])
    zone_s = 0.0 if match[8] == "Z" else zone_of(match[8] or "")
    return whole.timestamp() + part_s, step_s, zone_s


def _fraction(sign: str, digits: str) -> tuple[float, float]:
    digits = digits[:_MOST_DIGITS]
    return (-1.0 if sign in ("-", "−") else 1.0) * float(f"0.{digits}"), 10.0 ** -len(digits)


def zone_of(text: str) -> float | None:
    """Return a zone such as +02:00, +0530, -7, UTC+1 or Z in seconds east of UTC; None: it is none."""
    text = text.strip("\x00 ")
    if text.upper() in ("Z", "UTC", "GMT"):
        return 0.0
    match = _ZONE.fullmatch(text)
    if match is None:
        return None
    zone_s = 3600.0 * int(match[2]) + 60.0 * int(match[3] or 0)
    return None if zone_s > _MOST_ZONE_S else (zone_s if match[1] == "+" else -zone_s)


def zone_of_hours(hours: Sequence[float]) -> float | None:
    """Return the zone of EXIF's TimeZoneOffset, whose first number is the camera's clock's hours east of UTC."""
    if not hours or not float(hours[0]).is_integer():
        return None
    signed = hours[0] - 65536.0 if hours[0] > 32767 else hours[0]  # readers take the signed tag for unsigned
    return 3600.0 * signed if abs(3600.0 * signed) <= _MOST_ZONE_S else None


def day_of(text: str) -> float | None:
    """Return midnight of a date, seconds since 1970 UTC; None: it is no date, or a receiver without a time."""
    match = _DATE.match(text.strip("\x00 "))
    if match is None:
        return None
    year, month, day = (int(part) for part in match.groups())
    try:
        return datetime(year, month, day, tzinfo=UTC).timestamp() if year >= _FIRST_YEAR else None
    except ValueError:
        return None


def time_of_day(stamp: Sequence[tuple[float, float]] | str) -> tuple[float, float] | None:
    """Return the seconds of a GPSTimeStamp since midnight, and its step; None: it is no time of day.

    The stamp is hours, minutes and seconds, each with its denominator, or a text such as 12:34:56.7.
    """
    if isinstance(stamp, str):
        match = _CLOCK.fullmatch(stamp.strip("\x00 Z"))
        if match is None:
            return None
        part_s, step_s = _fraction("", match[4]) if match[4] else (0.0, 1.0)
        parts, last = [float(match[1]), float(match[2]), float(match[3]) + part_s], 1.0 / step_s
    else:
        if len(stamp) != 3 or not all(den and math.isfinite(num / den) for num, den in stamp):
            return None
        parts, last = [num / den for num, den in stamp], abs(stamp[2][1])
    hours, minutes, seconds = parts
    if not (0.0 <= hours < 24.0 and 0.0 <= minutes < 60.0 and 0.0 <= seconds < 61.0):
        return None
    return 3600.0 * hours + 60.0 * minutes + seconds, 1.0 / max(last, 1.0)


def gps_near(of_day_s: float, day_s: float | None, clock_s: float | None, zone_s: float | None) -> float | None:
    """Return the receiver's time, seconds since 1970 UTC; without its day, that nearest to the camera's clock."""
    if day_s is not None:
        return day_s + of_day_s
    if clock_s is None:
        return None
    near_s = clock_s - (zone_s or 0.0)
    return near_s + (of_day_s - near_s + 43_200.0) % 86_400.0 - 43_200.0
