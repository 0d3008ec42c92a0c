"""EXIF and XMP wherever a JPEG, PNG, TIFF or HEIC keeps them, against containers built by hand."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

from pipelines.formats.exif import PhotoTags, read_tags
from pipelines.formats.heif import jpeg_of_heif
from pipelines.formats.photo_blocks import find_blocks, jpeg_with_blocks
from tests.photos import ASCII, Entry, Exif, dji_xmp, gps_entries, jpeg

LAT, LON, ALT = -33.41234, -70.54123, 742.5
EXIF = Exif(image=[(0x0110, ASCII, "Camera")], gps=gps_entries(LAT, LON, ALT)).tiff()
XMP = dji_xmp(GpsLatitude=LAT, GpsLongitude=LON, AbsoluteAltitude=ALT, GimbalYawDegree="+1.0")
EDITOR = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:e="http://editor/" e:Rating="3"/></rdf:RDF></x:xmpmeta>'
)
XAP = b"http://ns.adobe.com/xap/1.0/\x00"


def app(payload: bytes, marker: int = 0xE1) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(payload) + 2) + payload


def with_segments(*segments: bytes) -> bytes:
    plain = jpeg()
    return plain[:2] + b"".join(segments) + plain[2:]


def extended(packet: bytes, part: int = 60) -> list[bytes]:
    head = b"http://ns.adobe.com/xmp/extension/\x00" + b"A" * 32
    chunks = [(at, packet[at : at + part]) for at in range(0, len(packet), part)]
    return [app(head + struct.pack(">II", len(packet), at) + chunk) for at, chunk in reversed(chunks)]


def assert_placed(tags: PhotoTags, source: str) -> None:
    found = [each for each in tags.positions if each.source == source]
    assert len(found) == 1
    assert (found[0].lat_deg, found[0].lon_deg) == pytest.approx((LAT, LON), abs=1e-9)
    assert found[0].alt_m == pytest.approx(ALT, abs=1e-3)


@pytest.mark.parametrize(
    "segments",
    [
        pytest.param([app(b"Exif\x00\x00" + EXIF)], id="first"),
        pytest.param([app(bytes(65_000), 0xE2), app(bytes(6000)), app(b"Exif\x00\x00" + EXIF)], id="behind others"),
        pytest.param([*extended(XMP.ljust(70_000)), app(b"Exif\x00\x00" + EXIF)], id="behind an extension"),
        pytest.param(
            [app(b"Exif\x00\x00" + Exif(image=[(0x010F, ASCII, "Maker")]).tiff()), app(b"Exif\x00\x00" + EXIF)],
            id="in the second",
        ),
        pytest.param(
            [app(b"Exif\x00\x00" + EXIF[:150]), app(b"Exif\x00\x00" + EXIF[150:])], id="goes on in the next"
        ),
    ],
)
def test_exif_in_any_segment(segments: list[bytes]) -> None:
    tags = read_tags(with_segments(*segments))
    assert_placed(tags, "EXIF")
    assert tags.model == "Camera"


@pytest.mark.parametrize(
    "segments",
    [
        pytest.param([app(XAP + EDITOR), app(XAP + XMP)], id="second packet"),
        pytest.param([app(XAP + EDITOR), *extended(XMP)], id="extension in reverse order"),
        pytest.param([app(XAP + b'<?xpacket begin=""?>' + XMP + b'<?xpacket end="w"?>' + bytes(9))], id="padded"),
    ],
)
def test_xmp_in_any_packet(segments: list[bytes]) -> None:
    tags = read_tags(with_segments(*segments))
    assert_placed(tags, "XMP")
    assert tags.problems == ()


def png(*chunks: tuple[bytes, bytes], after: bool = False) -> bytes:
    plain = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    made = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    at = plain.rindex(b"IEND") - 4 if after else 33
    return plain[:at] + made + plain[at:]


def profile(name: bytes, block: bytes) -> bytes:
    return b"\n" + name + b"\n%8d\n" % len(block) + block.hex().encode() + b"\n"


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize(
    "chunk",
    [
        pytest.param((b"eXIf", EXIF), id="eXIf"),
        pytest.param((b"eXIf", b"Exif\x00\x00" + EXIF), id="eXIf with a name"),
        pytest.param((b"tEXt", b"Raw profile type exif\x00" + profile(b"exif", EXIF)), id="raw profile"),
        pytest.param(
            (
                b"zTXt",
                b"Raw profile type APP1\x00\x00" + zlib.compress(profile(b"generic", b"Exif\x00\x00" + EXIF)),
            ),
            id="packed raw profile of a segment",
        ),
    ],
)
def test_exif_in_a_png(chunk: tuple[bytes, bytes], after: bool) -> None:
    assert_placed(read_tags(png(chunk, after=after)), "EXIF")


@pytest.mark.parametrize(
    "chunk",
    [
        pytest.param((b"iTXt", b"XML:com.adobe.xmp\x00\x00\x00\x00\x00" + XMP), id="iTXt"),
        pytest.param((b"iTXt", b"XML:com.adobe.xmp\x00\x01\x00\x00\x00" + zlib.compress(XMP)), id="packed iTXt"),
        pytest.param((b"tEXt", b"Raw profile type xmp\x00" + profile(b"xmp", XMP)), id="raw profile"),
    ],
)
def test_xmp_in_a_png(chunk: tuple[bytes, bytes]) -> None:
    assert_placed(read_tags(png(chunk)), "XMP")


def test_xmp_and_exif_in_a_tiff() -> None:
    structure = Exif(image=[(700, ASCII, XMP.decode())], gps=gps_entries(LAT, LON, ALT)).tiff()
    tags = read_tags(structure)
    assert_placed(tags, "XMP")
    assert_placed(tags, "EXIF")


@pytest.mark.parametrize("note", [100, 70_000, 200_000])
def test_exif_of_any_length_in_a_heic(tmp_path: Path, note: int) -> None:
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769)[0x927C] = bytes(note)
    place = {1: "S", 2: (33.0, 24.0, 44.424), 3: "W", 4: (70.0, 32.0, 28.428), 5: b"\x00", 6: ALT}
    exif.get_ifd(0x8825).update(place)
    heic = tmp_path / "a.heic"
    pillow_heif.from_pillow(Image.new("RGB", (64, 64))).save(heic, exif=exif.tobytes(), xmp=XMP)
    converted = jpeg_of_heif(heic)
    tags = read_tags(converted)
    assert_placed(tags, "EXIF")
    assert_placed(tags, "XMP")
    assert Image.open(io.BytesIO(converted)).size == (64, 64)


def test_xmp_longer_than_a_segment_is_written_as_an_extension() -> None:
    long = XMP.replace(b"<rdf:RDF", b"<!--" + b"x" * 150_000 + b"--><rdf:RDF")
    assert find_blocks(jpeg_with_blocks(jpeg(), None, long)).xmp == (long,)


def test_a_text_that_grows_when_unpacked_is_cut() -> None:
    bomb = zlib.compress(bytes(200_000_000), 9)
    assert read_tags(png((b"zTXt", b"Raw profile type exif\x00\x00" + bomb))).positions == ()


def test_tags_beyond_the_end_are_left_out_alone() -> None:
    """A maker's note that was cut off takes no other tag with it."""
    entries: list[Entry] = [(0x010F, ASCII, "Maker of cameras"), (0x0110, ASCII, "Camera of the maker")]
    block = bytearray(Exif(image=entries, gps=gps_entries(LAT, LON, ALT)).tiff())
    struct.pack_into("<I", block, 10 + 8, 1_000_000)  # where the maker's name lies
    tags = read_tags(with_segments(app(b"Exif\x00\x00" + bytes(block))))
    assert (tags.make, tags.model) == ("", "Camera of the maker")
    assert_placed(tags, "EXIF")
