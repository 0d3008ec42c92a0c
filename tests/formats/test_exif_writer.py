"""Pillow and an XML parser read back the tags that are written into a photograph."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from pipelines.core.errors import InputError
from pipelines.formats.exif_writer import DroneTags, with_tags
from tests.refusals import refused

TAGS = DroneTags(
    width=64, height=48, focal_px=54.4, stamp_ns=1_700_000_002_250_000_000,
    lat_deg=-33.856784321, lon_deg=151.215296789, alt_m=-12.3456, relative_alt_m=61.5,
    yaw_pitch_roll_deg=(-91.25, -35.5, 1.75), body_yaw_pitch_roll_deg=(-91.0, 0.5, 1.5),
    sigma_enu_m=(0.02, 0.021, 0.03),
)  # fmt: skip
JPEG = cv2.imencode(".jpg", np.full((48, 64, 3), 90, dtype=np.uint8))[1].tobytes()
DJI = "{http://www.dji.com/drone-dji/1.0/}"


def exif(jpeg: bytes) -> dict[str, Any]:
    """Return the tags of the EXIF and the GPS directory by Pillow's names."""
    found = Image.open(io.BytesIO(jpeg)).getexif()
    names = {ExifTags.IFD.Exif: ExifTags.TAGS, ExifTags.IFD.GPSInfo: ExifTags.GPSTAGS}
    return {of[tag]: value for each, of in names.items() for tag, value in found.get_ifd(each).items()}


def xmp(jpeg: bytes) -> dict[str, str]:
    packet = jpeg[jpeg.index(b"<x:xmpmeta") : jpeg.index(b"</x:xmpmeta>") + 12]
    description = next(ET.fromstring(packet).iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"))
    return {key.removeprefix(DJI): value for key, value in description.attrib.items() if key.startswith(DJI)}


def degrees(parts: Any, ref: object) -> float:
    whole, minutes, seconds = (float(part) for part in parts)
    return (whole + minutes / 60 + seconds / 3600) * (-1 if str(ref) in "SW" else 1)


@settings(max_examples=40, deadline=None)
@given(
    lat=st.floats(-90, 90),
    lon=st.floats(-180, 180),
    alt=st.floats(-500, 9000),
    second=st.integers(0, 4_000_000_000),
)
def test_position_and_time_are_read_back(lat: float, lon: float, alt: float, second: int) -> None:
    stamp_ns = second * 1_000_000_000 + 250_000_000
    tags = exif(with_tags(JPEG, replace(TAGS, lat_deg=lat, lon_deg=lon, alt_m=alt, stamp_ns=stamp_ns)))
    # Seconds of arc are written to 1e-6: half of it is 1.4e-10 degrees.
    assert degrees(tags["GPSLatitude"], tags["GPSLatitudeRef"]) == pytest.approx(lat, abs=2e-10)
    assert degrees(tags["GPSLongitude"], tags["GPSLongitudeRef"]) == pytest.approx(lon, abs=2e-10)
    below = tags["GPSAltitudeRef"] == b"\x01"
    height = float(tags["GPSAltitude"])
    assert (-height if below else height) == pytest.approx(alt, abs=1e-4)
    time = np.datetime64(second, "s").item().strftime("%Y:%m:%d %H:%M:%S")
    assert str(tags["DateTimeOriginal"]) == time
    assert tags["SubsecTimeOriginal"] == "250000000"


def test_focal_length_gives_back_the_pixels() -> None:
    tags = exif(with_tags(JPEG, TAGS))
    focal_mm = float(tags["FocalLength"])
    per_cm = float(tags["FocalPlaneXResolution"])
    assert focal_mm * per_cm / 10 == pytest.approx(54.4, rel=1e-6)
    assert tags["FocalPlaneResolutionUnit"] == 3  # centimetres


def test_xmp_is_what_dji_writes() -> None:
    tags = xmp(with_tags(JPEG, TAGS))
    assert [float(tags[f"Gimbal{axis}Degree"]) for axis in ("Yaw", "Pitch", "Roll")] == [-91.25, -35.5, 1.75]
    assert float(tags["GpsLatitude"]) == pytest.approx(TAGS.lat_deg, abs=1e-9)
    assert float(tags["GpsLongitude"]) == pytest.approx(TAGS.lon_deg, abs=1e-9)
    assert float(tags["AbsoluteAltitude"]) == pytest.approx(TAGS.alt_m, abs=1e-4)
    assert (tags["RtkFlag"], tags["RtkStdLon"], tags["RtkStdLat"], tags["RtkStdHgt"]) == (
        "50", "0.02000", "0.02100", "0.03000",
    )  # fmt: skip


def test_plain_receiver_states_no_sigma() -> None:
    assert not [key for key in xmp(with_tags(JPEG, replace(TAGS, sigma_enu_m=None))) if key.startswith("Rtk")]


def test_picture_is_untouched() -> None:
    before, after = (cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in (JPEG, with_tags(JPEG, TAGS)))
    np.testing.assert_array_equal(before, after)


def test_other_files_are_refused() -> None:
    with refused("not-a-jpeg", InputError):
        with_tags(b"\x89PNG\r\n", TAGS)
