"""DJI's XMP: gimbal angles, RTK state and σ, altitudes. Attribute and element form.

The packet is looked for in the first and last mebibyte of a file only and must be short; entities and document
types are refused by defusedxml.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element, ParseError

from pipelines.core.types import Vector3

_SEARCHED = 1024 * 1024
_MAX_PACKET = 256 * 1024
_OPEN, _CLOSE = b"<x:xmpmeta", b"</x:xmpmeta>"

RTK_FIXED = 50
RTK_FLOAT = 34


@dataclass(frozen=True)
class DjiTags:
    """What DJI wrote; None where it is absent.

    Attributes:
        gimbal_yaw_pitch_roll_deg: Z-Y-X from North-East-Down.
        rtk_flag: 50 fixed, 34 float, 16 single point, 0 none.
        rtk_sigma_enu_m: σ east, north, up.
        absolute_altitude_m: above whatever `GPSAltitude` is above.
        relative_altitude_m: above take-off.
    """

    gimbal_yaw_pitch_roll_deg: Vector3 | None = None
    rtk_flag: int | None = None
    rtk_sigma_enu_m: Vector3 | None = None
    absolute_altitude_m: float | None = None
    relative_altitude_m: float | None = None


class XmpError(ValueError):
    """There is a packet, but it cannot be read."""


def read_dji(data: bytes) -> DjiTags | None:
    """DJI's tags of a photograph, or None if it has no XMP packet.

    Args:
        data: the file.

    Raises:
        XmpError: a packet that is too long or not well formed.
    """
    packet = find_packet(data)
    if packet is None:
        return None
    values = _values(packet)
    return DjiTags(
        gimbal_yaw_pitch_roll_deg=_triple(values, "GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
        rtk_flag=None if (flag := _number(values, "RtkFlag")) is None else int(flag),
        rtk_sigma_enu_m=_positive(_triple(values, "RtkStdLon", "RtkStdLat", "RtkStdHgt")),
        absolute_altitude_m=_number(values, "AbsoluteAltitude"),
        relative_altitude_m=_number(values, "RelativeAltitude"),
    )


def find_packet(data: bytes) -> bytes | None:
    """The XMP packet in the first or last mebibyte of a file, or None.

    Raises:
        XmpError: it is longer than 256 KiB or has no end.
    """
    for part in (data[:_SEARCHED], data[max(_SEARCHED, len(data) - _SEARCHED) :]):
        begin = part.find(_OPEN)
        if begin < 0:
            continue
        end = part.find(_CLOSE, begin, begin + _MAX_PACKET)
        if end < 0:
            raise XmpError("the XMP packet has no end within 256 KiB")
        return part[begin : end + len(_CLOSE)]
    return None


def _values(packet: bytes) -> dict[str, str]:
    """Simple properties by local name, whichever form they have; the first of a name counts."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        root: Element = fromstring(packet, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise XmpError(f"the XMP packet is not well formed: {error}") from error
    found: dict[str, str] = {}
    for element in root.iter():
        for key, text in element.attrib.items():
            found.setdefault(_local(key), text)
        if element.text and not len(element):
            found.setdefault(_local(element.tag), element.text)
    return found


def _local(name: str) -> str:
    return name.rsplit("}", maxsplit=1)[-1]


def _number(values: dict[str, str], key: str) -> float | None:
    try:
        value = float(values[key])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _triple(values: dict[str, str], *keys: str) -> Vector3 | None:
    first, second, third = (_number(values, key) for key in keys)
    if first is None or second is None or third is None:
        return None
    return (first, second, third)


def _positive(values: Vector3 | None) -> Vector3 | None:
    """σ of zero is what DJI writes when it has none."""
    return values if values is not None and min(values) > 0.0 else None
