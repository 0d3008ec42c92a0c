"""Every form of CRS against numbers that come from elsewhere: integrals, definitions, published examples."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj.datadir
import pytest
from scipy.integrate import quad

from pipelines.core.errors import InputError
from pipelines.geodesy import enu
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import parse_vertical
from tests.earth import enu_from_lla
from tests.refusals import refused

US_FOOT_M = 1200.0 / 3937.0
UTM16_WKT = parse_crs("EPSG:32616").wkt


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32616",
        "epsg:32616",
        "WGS84 UTM 16N",
        "WGS 84 / UTM zone 16N",
        "+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs",
        UTM16_WKT,
    ],
)
def test_every_form_of_utm_16_north_is_the_same_place(text: str) -> None:
    # On the central meridian the northing is 0.9996 of the meridian's arc, integrated here.
    e2 = enu.FLATTENING * (2 - enu.FLATTENING)
    arc, _ = quad(
        lambda lat: enu.SEMI_MAJOR_M * (1 - e2) / (1 - e2 * np.sin(lat) ** 2) ** 1.5,
        0.0,
        np.radians(46.0),
        epsabs=1e-7,
    )
    lla = parse_crs(text).lla_from_xyz([[500000.0, 0.9996 * arc, 300.0]])
    np.testing.assert_allclose(lla, [[46.0, -87.0, 300.0]], rtol=0, atol=1e-10)


def test_wgs84_utm_south() -> None:
    lla = parse_crs("WGS84 UTM 60S").lla_from_xyz([[500000.0, 10000000.0, 1.0]])
    np.testing.assert_allclose(lla, [[0.0, 177.0, 1.0]], rtol=0, atol=1e-9)


def test_geographic_x_is_longitude_whatever_the_axes_of_the_crs() -> None:
    for text in ("EPSG:4326", "EPSG:4979", "+proj=longlat +datum=WGS84 +no_defs", "WGS84"):
        np.testing.assert_allclose(parse_crs(text).lla_from_xyz([[7.75, 46.02, 1620.0]]), [[46.02, 7.75, 1620.0]])


def test_geocentric_is_the_closed_form() -> None:
    lla = np.array([[46.02, 7.75, 1620.0], [-33.9, 151.2, 12.0]])
    np.testing.assert_allclose(parse_crs("EPSG:4978").lla_from_xyz(enu.ecef_from_lla(lla)), lla, rtol=0, atol=1e-7)


def test_state_plane_in_us_survey_feet_scales_all_three_axes() -> None:
    metres = np.array([[441964.0, 164592.0, 300.0]])
    from_metres = parse_crs("EPSG:32119").lla_from_xyz(metres)
    from_feet = parse_crs("EPSG:2264").lla_from_xyz(metres / US_FOOT_M)
    assert parse_crs("EPSG:2264").height_unit == "US survey foot"
    # The two definitions round the false easting 0.8 mm apart; an international foot would be 2 ppm, 0.9 m, off.
    np.testing.assert_allclose(enu.ecef_from_lla(from_feet), enu.ecef_from_lla(from_metres), rtol=0, atol=1e-3)


def test_british_grid_is_where_the_published_example_puts_it() -> None:
    # EPSG Guidance Note 7-2, Transverse Mercator: 50°30′ N 0°30′ E on OSGB36 is 577274.99 E, 69740.50 N; the
    # published OSGB36 → WGS 84 (6) moves that by some 100 m and is itself good to 2 m.
    lla = parse_crs("EPSG:27700").lla_from_xyz([[577274.99, 69740.50, 0.0]])
    north_m = (lla[0, 0] - 50.5) * 111_200
    east_m = (lla[0, 1] - 0.5) * 70_900
    assert 50 < north_m < 90 and -130 < east_m < -80


def test_both_utm_zones_at_their_border_at_70_north_over_10_km() -> None:
    origin = Origin(lat_deg=70.0, lon_deg=12.0, alt_m=100.0)
    east = np.linspace(-5000.0, 5000.0, 11)
    truth = np.stack([east, 300.0 * np.sin(east), np.zeros_like(east)], axis=-1)
    lla = enu.lla_from_enu(truth, origin)
    for text in ("EPSG:32632", "EPSG:32633"):
        crs = parse_crs(text)
        returned = enu_from_lla(crs.lla_from_xyz(crs.xyz_from_lla(lla)), origin)
        # PROJ's transverse Mercator is a sixth-order series: 1e-8 m within a few degrees of its meridian.
        np.testing.assert_allclose(returned, truth, rtol=0, atol=1e-6)
    # What the projection would have done to a flat solution: 10 km measured on the map is metres too long or short.
    mapped = parse_crs("EPSG:32633").xyz_from_lla(lla)
    assert abs(np.linalg.norm(mapped[-1, :2] - mapped[0, :2]) - 10000.0) > 1.0


def test_heights_are_assumed_ellipsoidal_only_where_nothing_is_said() -> None:
    assert not parse_crs("EPSG:32632").vertical.stated
    assert parse_crs("EPSG:4979").vertical.stated
    stated = parse_crs("EPSG:32632", vertical=parse_vertical("ellipsoidal"))
    assert stated.vertical.stated and stated.vertical.name == "ellipsoidal"


@pytest.mark.parametrize(
    ("text", "vertical", "grid"),
    [
        ("EPSG:32632+5773", None, "us_nga_egm96_15.tif"),
        ("EPSG:4326+3855", None, "us_nga_egm08_25.tif"),
        ("EPSG:32632", "EGM96", "us_nga_egm96_15.tif"),
        ("WGS84 UTM 32N", "EGM2008", "us_nga_egm08_25.tif"),
        ("EPSG:4326", "EPSG:7837", "de_bkg_gcg2016.tif"),
    ],
)
def test_a_missing_geoid_grid_is_an_error_that_names_it(text: str, vertical: str | None, grid: str) -> None:
    crs = parse_crs(text, vertical=parse_vertical(vertical) if vertical else None)
    point = [[9.0, 50.0, 100.0]] if crs.is_geographic else [[500000.0, 5540000.0, 100.0]]
    with refused("grid-not-installed", InputError) as error:
        crs.lla_from_xyz(point, path="gcp.txt")
    message = str(error.value)
    assert grid in message and "pyproj sync" in message and "--vertical ellipsoidal" in message
    assert message.startswith("gcp.txt")
    with refused("grid-not-installed", InputError):
        crs.xyz_from_lla([[50.0, 9.0, 100.0]])


@pytest.fixture
def egm96_of_30_metres(tmp_path: Path) -> Iterator[None]:
    """A made-up EGM96 grid: 30 m + 0.1 m a degree of latitude, in a folder that PROJ searches."""
    latitudes = np.linspace(-90, 90, 181)[:, None] + np.zeros((1, 361))
    header = struct.pack(">ddddii", -90.0, -180.0, 1.0, 1.0, 181, 361)
    (tmp_path / "egm96_15.gtx").write_bytes(header + (30.0 + 0.1 * latitudes).astype(">f4").tobytes())
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    yield
    pyproj.datadir.set_data_dir(before)


@pytest.mark.usefixtures("egm96_of_30_metres")
@pytest.mark.parametrize(("text", "vertical"), [("EPSG:32632+5773", None), ("EPSG:32632", "EGM96")])
def test_with_its_grid_the_geoid_is_added(text: str, vertical: str | None) -> None:
    crs = parse_crs(text, vertical=parse_vertical(vertical) if vertical else None)
    xyz = parse_crs("EPSG:32632").xyz_from_lla([[46.0, 9.0, 0.0]]) + np.array([0.0, 0.0, 500.0])
    lla = crs.lla_from_xyz(xyz)
    np.testing.assert_allclose(lla, [[46.0, 9.0, 534.6]], rtol=0, atol=1e-4)  # the grid is float32
    np.testing.assert_allclose(crs.xyz_from_lla(lla), xyz, rtol=0, atol=1e-6)


def test_a_better_transformation_that_lacks_its_grid_is_told() -> None:
    crs = parse_crs("EPSG:27700")
    operation = crs.operation(crs.lla_from_xyz([[577274.99, 69740.50, 0.0]]))
    assert operation.accuracy_m == 2.0
    assert any("OSTN15" in grid for grid in operation.missing_grids)


@pytest.mark.parametrize(
    ("text", "point", "code"),
    [
        ("EPSG:4326", [46.02, 97.75, 0.0], "latitude-range"),
        ("EPSG:4326", [460.2, 7.75, 0.0], "longitude-range"),
        ("EPSG:4326", [7.75, float("nan"), 0.0], "point-not-finite"),
        ("EPSG:32632", [7.75, 46.02, 0.0], "degrees-in-projection"),
        ("EPSG:32632", [5100000.0, 400000.0, 0.0], "point-outside-area"),
        ("EPSG:32632", [1e15, 400000.0, 0.0], "point-outside-domain"),
        ("EPSG:4978", [7.75, 46.02, 0.0], "point-not-on-earth"),
        ("+proj=utm +zone=16 +ellps=GRS80", [500000.0, 4000000.0, 0.0], "no-transformation"),
    ],
)
def test_impossible_points_name_file_and_line(text: str, point: list[float], code: str) -> None:
    crs = parse_crs(text)
    good = crs.xyz_from_lla([[46.0, 9.0, 0.0]]) if "GRS80" not in text else np.array([point])
    with refused(code, InputError) as error:
        crs.lla_from_xyz(np.concatenate([good, [point]]), path="geo.txt", lines=[2, 3])
    assert str(error.value).startswith("geo.txt" if "GRS80" in text else "geo.txt:3")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("EPSG:99999", "crs-unknown"),
        ("nonsense", "crs-unknown"),
        ("", "crs-unknown"),
        ("WGS84 UTM 61N", "utm-zone"),
        ("EPSG:5773", "crs-not-of-points"),
        ("+proj=" + "x" * 30000, "crs-too-long"),
    ],
)
def test_what_is_no_crs_is_refused(text: str, code: str) -> None:
    with refused(code, InputError) as error:
        parse_crs(text, path="gcp_list.txt", line=1)
    assert str(error.value).startswith("gcp_list.txt:1")


@pytest.mark.parametrize("text", ["sealevel", "EPSG:", "EGM97"])
def test_what_is_no_vertical_datum_is_refused(text: str) -> None:
    with refused("vertical-datum-unknown", InputError) as error:
        parse_vertical(text)
    assert error.value.field == "--vertical" and "ellipsoidal, EGM84, EGM96, EGM2008, EPSG:n" in error.value.remedy


def test_a_horizontal_crs_is_no_vertical_datum() -> None:
    with refused("not-a-vertical-crs", InputError):
        parse_crs("EPSG:32632", vertical=parse_vertical("EPSG:4326"))
