"""DJI's XMP in attribute and element form: gimbal angles, RTK state and σ, altitudes.

The packet must be short and lie in the first or last mebibyte of a file. defusedxml refuses entities and document
types.
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
    """DJI's tags; None if absent.

    Attributes:
        gimbal_yaw_pitch_roll_deg: Z-Y-X from North-East-Down.
        rtk_flag: 50 fixed, 34 float, 16 single point, 0 none.
        rtk_sigma_enu_m: σ east, north, up.
        absolute_altitude_m: above the same reference as `GPSAltitude`.
        relative_altitude_m: above take-off.
    """

    gimbal_yaw_pitch_roll_deg: Vector3 | None = None
    rtk_flag: int | None = None
    rtk_sigma_enu_m: Vector3 | None = None
    absolute_altitude_m: float | None = None
    relative_altitude_m: float | None = None


class XmpError(ValueError):
    """A packet exists, but cannot be read."""


def read_dji(data: bytes) -> DjiTags | None:
    """Return DJI's tags of a photograph, or None without an XMP packet.

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
    """Return the XMP packet in the first or last mebibyte of a file, or None.

    Raises:
        XmpError: the packet is longer than 256 KiB or has no end.
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
    """Return simple properties of either form by local name; the first of a name counts."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        root: Element = fromstring(packet, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise XmpError(f"the XMP packet is not well formed: {error}") from error
    properties: dict[str, str] = {}
    for element in root.iter():
        for key, text in element.attrib.items():
            properties.setdefault(_local(key), text)
        if element.text and not len(element):
            properties.setdefault(_local(element.tag), element.text)
    return properties


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
    """Return σ, or None for zeros: DJI writes zero for an unknown σ."""
    return values if values is not None and min(values) > 0.0 else None
