"""DJI's XMP: both forms, and what a hostile packet gets."""

from __future__ import annotations

import pytest

from pipelines.formats.exif import XmpError, read_dji
from tests.photos import dji_xmp, jpeg

RTK = {"RtkFlag": "50", "RtkStdLat": "0.011", "RtkStdLon": "0.012", "RtkStdHgt": "0.025"}


def test_attribute_form() -> None:
    packet = dji_xmp(
        GimbalYawDegree="+45.00",
        GimbalPitchDegree="-89.90",
        GimbalRollDegree="+0.00",
        RelativeAltitude="+39.80",
        AbsoluteAltitude="+198.31",
        **RTK,
    )
    tags = read_dji(jpeg(xmp=packet))
    assert tags is not None
    assert tags.gimbal_yaw_pitch_roll_deg == (45.0, -89.9, 0.0)
    assert tags.rtk_flag == 50
    assert tags.rtk_sigma_enu_m == (0.012, 0.011, 0.025)  # longitude's σ is the one to the east
    assert tags.absolute_altitude_m == 198.31


def test_element_form() -> None:
    packet = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<rdf:Description xmlns:d="http://www.dji.com/drone-dji/1.0/"><d:GimbalYawDegree>-12.5</d:GimbalYawDegree>'
        b"<d:GimbalPitchDegree>-45</d:GimbalPitchDegree><d:GimbalRollDegree>1</d:GimbalRollDegree>"
        b"</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    tags = read_dji(jpeg(xmp=packet))
    assert tags is not None and tags.gimbal_yaw_pitch_roll_deg == (-12.5, -45.0, 1.0)


def test_incomplete_or_senseless_values_are_absent() -> None:
    tags = read_dji(dji_xmp(GimbalYawDegree="nan", GimbalPitchDegree="x", **{**RTK, "RtkStdHgt": "0.0"}))
    assert tags is not None
    assert tags.gimbal_yaw_pitch_roll_deg is None
    assert tags.rtk_sigma_enu_m is None


def test_no_packet() -> None:
    assert read_dji(jpeg()) is None


def test_a_packet_at_the_end_of_a_large_file_is_found() -> None:
    tags = read_dji(b"II*\x00" + bytes(3_000_000) + dji_xmp(RtkFlag="16"))
    assert tags is not None and tags.rtk_flag == 16


@pytest.mark.parametrize(
    ("packet", "message"),
    [
        (b"<x:xmpmeta" + b" " * 400_000 + b"</x:xmpmeta>", "no end within 256 KiB"),
        (b'<x:xmpmeta xmlns:x="a"><d:GimbalYawDegree>1</x:xmpmeta>', "not well formed"),
        (b"<x:xmpmeta><a b='&xxe;'/></x:xmpmeta>", "not well formed"),
    ],
)
def test_hostile_packets_are_refused(packet: bytes, message: str) -> None:
    with pytest.raises(XmpError, match=message):
        read_dji(packet)
