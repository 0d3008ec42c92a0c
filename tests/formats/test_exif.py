"""EXIF tags against bytes built by hand from the standard."""

from __future__ import annotations

import pytest

from pipelines.formats.exif import read_tags
from tests.photos import ASCII, BYTE, LONG, RATIONAL, SHORT, Entry, Exif, dji_xmp, gps_entries, jpeg, rational


def _gps(entries: list[Entry]) -> Exif:
    return Exif(gps=entries)


@pytest.mark.parametrize(
    ("lat", "lon", "alt"), [(46.02, 7.75, 1620.5), (-33.87, 151.21, 12.0), (51.5, -0.12, -3.25)]
)
def test_position_in_every_hemisphere_and_below_zero(lat: float, lon: float, alt: float) -> None:
    gps = read_tags(jpeg(exif=_gps(gps_entries(lat, lon, alt)))).gps
    assert gps is not None
    assert gps.lat_deg == pytest.approx(lat, abs=1e-10)  # seconds are written to 1e-7
    assert gps.lon_deg == pytest.approx(lon, abs=1e-10)
    assert gps.alt_m == pytest.approx(alt, abs=1e-3)


def test_without_altitude_dji_may_know_it() -> None:
    exif = _gps(gps_entries(46.0, 7.0, None))
    without = read_tags(jpeg(exif=exif)).gps
    assert without is not None and without.alt_m is None
    with_xmp = read_tags(jpeg(exif=exif, xmp=dji_xmp(AbsoluteAltitude="+198.31")))
    assert with_xmp.gps == without
    assert with_xmp.dji is not None and with_xmp.dji.absolute_altitude_m == 198.31


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ([(1, ASCII, "N"), (2, RATIONAL, [(46, 1), (0, 1), (5, 0)]), *gps_entries(46.0, 7.0)[2:]], "no angle"),
        # Whole minutes whose seconds are 0/0: up to 1.8 km are unknown.
        ([(1, ASCII, "N"), (2, RATIONAL, [(46, 1), (1, 1), (0, 0)]), *gps_entries(46.0, 7.0)[2:]], "no angle"),
        ([(1, ASCII, "N"), (2, RATIONAL, [(46, 1), (75, 1), (0, 1)]), *gps_entries(46.0, 7.0)[2:]], "no angle"),
        ([(1, ASCII, "N"), (2, RATIONAL, [(46, 1), (1, 1), (90, 1)]), *gps_entries(46.0, 7.0)[2:]], "no angle"),
        ([*gps_entries(46.0, 7.0)[1:]], "does not say its hemisphere"),
        ([(1, ASCII, "N"), (2, RATIONAL, [(97, 1), (0, 1), (0, 1)]), *gps_entries(46.0, 7.0)[2:]], "out of range"),
        (gps_entries(0.0, 0.0), "means none"),
    ],
)
def test_positions_that_cannot_be_trusted(entries: list[Entry], problem: str) -> None:
    tags = read_tags(jpeg(exif=_gps(entries)))
    assert tags.gps is None
    assert problem in tags.problems[0]


@pytest.mark.parametrize(
    "parts",
    [
        [(46, 1), (12, 10), (0, 0)],  # minutes with a fraction need no seconds
        [(4602, 100), (0, 0), (0, 0)],
        [(46, 1), (1, 1), (12, 1)],
        [(0, 1), (0, 1), (165672, 1)],  # seconds alone
        [(46, 1), (120, 100)],
    ],
)
def test_degrees_in_every_division(parts: list[tuple[int, int]]) -> None:
    gps = read_tags(jpeg(exif=_gps([(1, ASCII, "N"), (2, RATIONAL, parts), *gps_entries(46.0, 7.0)[2:]]))).gps
    assert gps is not None and gps.lat_deg == pytest.approx(46.02, abs=1e-12)


@pytest.mark.parametrize(
    ("lat", "lon", "height"),
    [("46,0200000", "7,7500000", "+620,50"), ("46,02000", "-7,75000", "620,5"), ("46.02", "7.75", "620.5 m")],
)
def test_decimal_commas_of_xmp(lat: str, lon: str, height: str) -> None:
    tags = read_tags(jpeg(xmp=dji_xmp(GpsLatitude=lat, GpsLongitude=lon, AbsoluteAltitude=height)))
    (gps,) = tags.positions
    assert (gps.lat_deg, abs(gps.lon_deg), gps.alt_m) == pytest.approx((46.02, 7.75, 620.5), abs=1e-9)
    assert (gps.lon_deg < 0.0) == lon.startswith("-")


def test_a_decimal_comma_of_a_text_in_exif() -> None:
    entries: list[Entry] = [(1, ASCII, "S"), (2, ASCII, "46,02000"), (3, ASCII, "W"), (4, ASCII, "7,75000 W")]
    gps = read_tags(jpeg(exif=_gps([*entries, (6, ASCII, "620,5 m")]))).gps
    assert gps is not None
    assert (gps.lat_deg, gps.lon_deg, gps.alt_m) == pytest.approx((-46.02, -7.75, 620.5), abs=1e-9)


def test_horizontal_error_and_datum() -> None:
    entries: list[Entry] = [*gps_entries(46.0, 7.0), (0x12, ASCII, "TOKYO"), (0x1F, RATIONAL, [rational(1.5)])]
    gps = read_tags(jpeg(exif=_gps(entries))).gps
    assert gps is not None and gps.sigma_h_m == pytest.approx(1.5) and gps.datum == "TOKYO"
    wgs = read_tags(jpeg(exif=_gps([*gps_entries(46.0, 7.0), (0x12, ASCII, "WGS-84")]))).gps
    assert wgs is not None and wgs.datum == ""


def test_lens_and_names() -> None:
    exif = Exif(
        image=[(0x010F, ASCII, "DJI"), (0x0110, ASCII, "FC6310"), (0x0112, SHORT, 6)],
        photo=[
            (0x920A, RATIONAL, [(88, 10)]),
            (0xA405, SHORT, 24),
            (0xA20E, RATIONAL, [(414545, 100)]),
            (0xA210, SHORT, 3),
            (0xA002, LONG, 5472),
            (0xA003, LONG, 3648),
            (0xA404, RATIONAL, [(0, 0)]),
        ],
    )
    tags = read_tags(jpeg(exif=exif))
    assert (tags.make_model, tags.orientation) == ("DJI FC6310", 6)
    assert (tags.lens.focal_mm, tags.lens.focal_35mm_mm, tags.lens.taken_width_px) == (8.8, 24.0, 5472.0)
    assert tags.lens.px_per_mm == pytest.approx(414.545)
    assert tags.lens.zoom == 1.0  # 0/0 is how cameras write "none"


START_S = 1714564800.0  # 2024-05-01 12:00:00 UTC


@pytest.mark.parametrize(
    ("photo", "gps", "expected", "source"),
    [
        ([(0x9003, ASCII, "2024:05:01 14:00:00"), (0x9011, ASCII, "+02:00")], [], START_S, "offset"),
        ([(0x9003, ASCII, "2024:05:01 12:00:00"), (0x9291, ASCII, "25")], [], START_S + 0.25, "assumed UTC"),
        (
            [(0x9003, ASCII, "2024:05:01 14:00:00")],
            [(7, RATIONAL, [(12, 1), (0, 1), (15, 10)]), (0x1D, ASCII, "2024:05:01")],
            START_S + 1.5,
            "gps",
        ),
        ([(0x9003, ASCII, "0000:00:00 00:00:00")], [], None, None),
    ],
)
def test_time(photo: list[Entry], gps: list[Entry], expected: float | None, source: str | None) -> None:
    tags = read_tags(jpeg(exif=Exif(photo=photo, gps=gps)))
    assert tags.timestamp_s == (None if expected is None else pytest.approx(expected, abs=1e-6))
    assert tags.time_source == source


def test_altitude_reference_of_exif_3() -> None:
    entries = [entry for entry in gps_entries(46.0, 7.0, 5.0) if entry[0] != 5]
    gps = read_tags(jpeg(exif=_gps([*entries, (5, BYTE, 3)]))).gps
    assert gps is not None and gps.alt_m == -5.0


def test_no_exif_and_broken_exif_do_no_harm() -> None:
    assert read_tags(jpeg()).gps is None
    data = bytearray(jpeg(exif=_gps(gps_entries(46.0, 7.0))))
    start = data.find(b"II*\x00")
    for at in range(start + 4, start + 60):
        broken = data.copy()
        broken[at] = 0xFF
        assert read_tags(bytes(broken)).orientation >= 0
