"""The georeference within SPZ: read back as written, in the proposal's bytes, and refused where it is no place."""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.spz import SpzVersion, decode_spz, encode_spz, spz_georeference, write_spz
from pipelines.formats.spz_extensions import SpzGeoreference, encode_georeference
from tests.delivered_scenes import splat_arrays
from tests.refusals import refused

ORIGIN, QUAT = (4037313.9441, -9658.3008, 4921195.1190), (0.5, -0.5, 0.5, 0.5)
PLACE = SpzGeoreference("EPSG:4978", ORIGIN, QUAT, 1.25, 2026.7)
MOON = '{"type":"GeodeticCRS","name":"Moon (2015) – Cartesian"}'


def record(payload: bytes, kind: int = 0x4E530001) -> bytes:
    return struct.pack("<II", kind, len(payload)) + payload


def with_extensions(extensions: bytes, version: SpzVersion = 4) -> bytes:
    """Return a file with these bytes where its version has the extensions."""
    data = encode_spz(splat_arrays(5), version)
    if version == 3:
        plain = bytearray(zlib.decompress(data, 31))
        plain[14] |= 2
        return gzip.compress(plain + extensions)
    plain = bytearray(data)
    plain[14] |= 2
    plain[16:20] = struct.pack("<I", 32 + len(extensions))
    return bytes(plain[:32]) + extensions + bytes(plain[32:])


@pytest.mark.parametrize(
    "place",
    [
        PLACE,
        replace(PLACE, epoch=None, scale=1.0),
        replace(PLACE, crs="IAU_2015:30100"),
        replace(PLACE, crs=MOON),
    ],
)
def test_what_is_written_is_read(tmp_path: Path, place: SpzGeoreference, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsply.spz, "_decode_spz_kernel", gsply.spz._decode_spz_kernel.py_func)  # compiled in 12 s
    splat = splat_arrays()
    write_spz(tmp_path / "a.spz", splat, 4, place)
    data = (tmp_path / "a.spz").read_bytes()
    assert spz_georeference(data) == place
    assert spz_georeference(encode_spz(splat, 4)) is None
    np.testing.assert_array_equal(decode_spz(data).means, decode_spz(encode_spz(splat, 4)).means)
    np.testing.assert_allclose(gsply.spz.read_spz(tmp_path / "a.spz").means, splat.means, atol=1e-3)


def test_bytes_are_those_of_the_proposal() -> None:
    """At the offsets of its table: version, flags, length, origin, rotation x y z w, scale, epoch, CRS."""
    data = encode_georeference(PLACE)
    assert struct.unpack_from("<IIBBH", data) == (0x4E530001, 76 + 9, 1, 1, 9)
    assert struct.unpack_from("<9d", data, 8 + 4) == (*ORIGIN, *QUAT, 1.25, 2026.7)
    assert data[8 + 76 :] == b"EPSG:4978"
    without = encode_georeference(replace(PLACE, epoch=None, crs=MOON))
    assert without[9] == 1 << 1 and math.isnan(struct.unpack_from("<d", without, 8 + 68)[0])


@pytest.mark.parametrize("version", [3, 4])
def test_earlier_layouts_of_the_proposal_are_told_apart(version: SpzVersion) -> None:
    """They have the same version number: with a second CRS for provenance, and with an EPSG code and a WKT."""
    numbers = struct.pack("<9d", *ORIGIN, *QUAT, 1.25, 2026.7)
    wkt = b'COMPOUNDCRS["a"]'
    provenance = struct.pack("<BBHI", 1, 3, 9, len(wkt)) + numbers + b"EPSG:4978" + wkt
    epsg = struct.pack("<BBHI", 1, 1, 0, 4978) + numbers + struct.pack("<I", len(wkt)) + wkt
    for payload in (provenance, epsg, encode_georeference(PLACE)[8:]):
        assert spz_georeference(with_extensions(record(payload), version)) == PLACE


def test_other_records_are_skipped_and_other_axes_refused() -> None:
    other, right_up_back = record(b"abc", 0x12340001), record(struct.pack("<I", 4), 0xADBE0003)
    data = with_extensions(other + right_up_back + encode_georeference(PLACE))
    assert spz_georeference(data) == PLACE and len(decode_spz(data)) == 5
    with refused("spz-axes", InputError):
        decode_spz(with_extensions(record(struct.pack("<I", 6), 0xADBE0003)))
    for damaged in (other[:-1], other + b"abc", record(b"", 7)[:4]):
        with refused("file-damaged", InputError):
            decode_spz(with_extensions(damaged))


@pytest.mark.parametrize(
    "change",
    [
        {"crs": "4978"}, {"crs": "EPSG:"}, {"crs": "EPSG:4978@2020"}, {"crs": "A:B:C"}, {"crs": "EPSG: 4978"},
        {"origin": (math.nan, 0.0, 0.0)}, {"quat_xyzw": (0.0, 0.0, 0.0, 0.9)}, {"scale": 0.0}, {"scale": math.inf},
        {"epoch": math.inf},
    ],
)  # fmt: skip
def test_no_place_is_refused_both_ways(change: dict[str, object]) -> None:
    place = replace(PLACE, **change)
    with refused("spz-georeference", InputError):
        encode_georeference(place)
    crs, flags = place.crs.encode(), 1
    payload = struct.pack("<BBH9d", 1, flags, len(crs), *place.origin, *place.quat_xyzw, place.scale, place.epoch)
    with refused("spz-georeference", InputError):
        spz_georeference(with_extensions(record(payload + crs)))
