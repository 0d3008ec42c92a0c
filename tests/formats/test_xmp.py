"""XMP of drones: every form and packet, and what a hostile packet gets."""

from __future__ import annotations

import pytest

from pipelines.formats.exif import read_tags
from pipelines.formats.xmp import XmpError, read_packet, read_packets
from tests.photos import dji_xmp, jpeg

RTK = {"RtkFlag": "50", "RtkStdLat": "0.011", "RtkStdLon": "0.012", "RtkStdHgt": "0.025"}
RDF = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'


def packet(inside: str) -> bytes:
    return f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {RDF}>{inside}</rdf:RDF></x:xmpmeta>'.encode()


def test_attribute_form() -> None:
    drone = dji_xmp(
        GimbalYawDegree="+45.00",
        GimbalPitchDegree="-89.90",
        GimbalRollDegree="+0.00",
        RelativeAltitude="+39.80",
        AbsoluteAltitude="+198.31",
        FlightYawDegree="-31.20",
        **RTK,
    )
    tags = read_tags(jpeg(xmp=drone)).dji
    assert tags is not None
    assert tags.gimbal_yaw_pitch_roll_deg == (45.0, -89.9, 0.0)
    assert tags.rtk_flag == 50
    assert tags.rtk_sigma_enu_m == (0.012, 0.011, 0.025)  # longitude's σ is the one to the east
    assert (tags.absolute_altitude_m, tags.relative_altitude_m, tags.flight_yaw_deg) == (198.31, 39.8, -31.2)


def test_element_form() -> None:
    drone = packet(
        '<rdf:Description xmlns:d="http://www.dji.com/drone-dji/1.0/"><d:GimbalYawDegree>-12.5</d:GimbalYawDegree>'
        "<d:GimbalPitchDegree>-45</d:GimbalPitchDegree><d:GimbalRollDegree>1</d:GimbalRollDegree>"
        "</rdf:Description>"
    )
    tags = read_tags(jpeg(xmp=drone)).dji
    assert tags is not None and tags.gimbal_yaw_pitch_roll_deg == (-12.5, -45.0, 1.0)


@pytest.mark.parametrize(
    "structure",
    [
        '<s:CameraOrientationNED rdf:parseType="Resource"><s:Roll>1</s:Roll><s:Pitch>-80</s:Pitch><s:Yaw>12</s:Yaw>'
        "</s:CameraOrientationNED>",
        '<s:CameraOrientationNED s:Roll="1" s:Pitch="-80" s:Yaw="12"/>',
        '<s:CameraOrientationNED><rdf:Description s:Roll="1" s:Pitch="-80" s:Yaw="12"/></s:CameraOrientationNED>',
    ],
)
def test_structures(structure: str) -> None:
    inside = (
        f'<rdf:Description xmlns:s="https://www.skydio.com/x/" s:Latitude="-33.5" s:Longitude="-70.25">{structure}'
    )
    tags = read_tags(jpeg(xmp=packet(f"{inside}</rdf:Description>")))
    assert tags.dji is not None and tags.dji.gimbal_yaw_pitch_roll_deg == (12.0, -80.0, 1.0)
    assert [(each.lat_deg, each.lon_deg) for each in tags.positions] == [(-33.5, -70.25)]


def test_lists_and_names_in_any_namespace() -> None:
    inside = (
        '<rdf:Description xmlns:C="http://pix4d.com/camera/1.0" C:BandName="Red" C:ModelType="fisheye">'
        "<C:CentralWavelength><rdf:Seq><rdf:li>668</rdf:li><rdf:li>717</rdf:li></rdf:Seq></C:CentralWavelength>"
        "</rdf:Description>"
    )
    xmp = read_tags(jpeg(xmp=packet(inside))).xmp
    assert xmp.texts("centralwavelength", namespace="pix4d") == ("668", "717")
    assert (xmp.text("BandName"), xmp.text("ModelType"), xmp.number("BandName")) == ("Red", "fisheye", None)
    assert xmp.text("BandName", namespace="dji") is None


def test_incomplete_or_senseless_values_are_absent() -> None:
    tags = read_tags(dji_xmp(GimbalYawDegree="nan", GimbalPitchDegree="x", **{**RTK, "RtkStdHgt": "0.0"})).dji
    assert tags is not None
    assert tags.gimbal_yaw_pitch_roll_deg is None
    assert tags.rtk_sigma_enu_m is None


def test_no_packet() -> None:
    assert read_tags(jpeg()).dji is None


def test_a_packet_at_the_end_of_a_large_file_is_found() -> None:
    tags = read_tags(b"II*\x00" + bytes(3_000_000) + dji_xmp(RtkFlag="16")).dji
    assert tags is not None and tags.rtk_flag == 16


@pytest.mark.parametrize(
    ("hostile", "message"),
    [
        (b"<x:xmpmeta" + b" " * 400_000 + b"</x:xmpmeta>", "no end within 256 KiB"),
        (b'<x:xmpmeta xmlns:x="a"><d:GimbalYawDegree>1</x:xmpmeta>', "not well formed"),
        (b"<x:xmpmeta><a b='&xxe;'/></x:xmpmeta>", "not well formed"),
    ],
)
def test_hostile_packets_are_refused(hostile: bytes, message: str) -> None:
    (problem,) = read_tags(hostile).problems
    assert message in problem


def test_a_packet_is_bounded() -> None:
    with pytest.raises(XmpError, match="longer than"):
        read_packet(b"<a>" + b" " * 5_000_000 + b"</a>")
    deep = b'<a xmlns:b="b">' + b"<b:c>" * 50_000 + b"</b:c>" * 50_000 + b"</a>"
    assert not read_packets([deep], [])
