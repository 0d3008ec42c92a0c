"""Coordinates on a round Earth: zone borders, high latitudes, the date line, 10 km, feet, grads, geoids.

Truth is a closed formula from the literature (tests/map_projections.py), a geodesic, or the definition of a unit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyproj.datadir
import pytest
from pyproj import Geod

from pipelines.core.errors import InputError
from pipelines.geodesy import enu
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import parse_vertical
from tests.earth import enu_from_lla
from tests.map_projections import (
    FOOT_M,
    GRS80_FLATTENING,
    US_FOOT_M,
    TransverseMercator,
    long_island,
    polar_stereographic_north,
    utm,
)
from tests.refusals import refused

Projection = Callable[[np.ndarray], np.ndarray]


def around(lat: float, lon: float, reach_m: float = 1500.0, height_m: float = 100.0) -> np.ndarray:
    """(12, 3) latitude, longitude, height of places around one, as far off as geodesics say."""
    azimuth, distance = np.linspace(0.0, 330.0, 12), np.linspace(0.2, 1.0, 12) * reach_m
    east, north, _ = Geod(ellps="WGS84").fwd(np.full(12, lon), np.full(12, lat), azimuth, distance)
    return np.stack([north, east, height_m + 10 * np.sin(azimuth)], axis=-1)


def apart_m(first: np.ndarray, second: np.ndarray) -> float:
    """The largest distance between points that should be the same."""
    return float(np.linalg.norm(enu.ecef_from_lla(first) - enu.ecef_from_lla(second), axis=1).max())


@pytest.mark.parametrize(
    ("crs", "place", "projection"),
    [
        ("EPSG:32631", (50.0, 6.0), utm(31).xy_m),
        ("EPSG:32632", (50.0, 6.0), utm(32).xy_m),
        ("EPSG:32632", (70.0, 12.0), utm(32).xy_m),
        ("EPSG:32633", (70.0, 12.0), utm(33).xy_m),
        ("EPSG:32660", (52.0, 180.0), utm(60).xy_m),
        ("EPSG:32601", (52.0, 180.0), utm(1).xy_m),
        ("EPSG:5041", (89.0, 30.0), polar_stereographic_north),
        ("EPSG:5041", (89.999, -120.0), polar_stereographic_north),
    ],
)
def test_projections_agree_with_the_literature_both_ways(
    crs: str, place: tuple[float, float], projection: Projection
) -> None:
    lla = around(*place)
    if place[1] == 180.0:
        # The formulas know no date line: longitudes that run through it.
        continued = lla[:, 1] % 360.0 - (360.0 if crs == "EPSG:32601" else 0.0)
        mapped = projection(np.column_stack([lla[:, 0], continued]))
    else:
        mapped = projection(lla)
    point_crs = parse_crs(crs)
    assert apart_m(point_crs.lla_from_xyz(np.column_stack([mapped, lla[:, 2]])), lla) < 1e-6
    np.testing.assert_allclose(point_crs.xyz_from_lla(lla), np.column_stack([mapped, lla[:, 2]]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("lat", [0.0, 50.0, 70.0, 89.0])
def test_ten_kilometres_are_ten_kilometres(lat: float) -> None:
    """UTM's 0.9996 and the curvature of parallels stay out: distances in geo are those through the Earth."""
    origin = Origin(lat_deg=lat, lon_deg=6.0, alt_m=0.0)
    lla = around(lat, 6.0, reach_m=10_000.0)
    geo, ecef = enu_from_lla(lla, origin), enu.ecef_from_lla(lla)
    pairs = np.triu_indices(len(lla), 1)
    in_geo, through_earth = (np.linalg.norm(x[pairs[0]] - x[pairs[1]], axis=1) for x in (geo, ecef))
    np.testing.assert_allclose(in_geo, through_earth, rtol=1e-9)
    # A chord is shorter than its geodesic by d³ / 24 R²: 1 mm in 10 km.
    _, _, along = Geod(ellps="WGS84").inv(*(lla[pairs[k], j] for k in (0, 1) for j in (1, 0)))
    level = around(lat, 6.0, reach_m=10_000.0, height_m=0.0)
    level[:, 2] = 0.0
    chord = np.linalg.norm(enu_from_lla(level, origin)[pairs[0]] - enu_from_lla(level, origin)[pairs[1]], axis=1)
    np.testing.assert_allclose(chord, along - along**3 / (24 * 6.38e6**2), rtol=0, atol=2e-4)


def test_the_ground_falls_away_from_the_tangent_plane() -> None:
    # Along the equator the ellipsoid is a circle of its semi-major axis: 10 km out, 7.84 m down.
    angle = 10_000.0 / enu.SEMI_MAJOR_M
    origin = Origin(lat_deg=0.0, lon_deg=-75.0, alt_m=0.0)
    computed = enu_from_lla([0.0, -75.0 + np.degrees(angle), 0.0], origin)
    truth = enu.SEMI_MAJOR_M * np.array([np.sin(angle), 0.0, np.cos(angle) - 1.0])
    np.testing.assert_allclose(computed, truth, rtol=0, atol=1e-8)
    assert computed[2] == pytest.approx(-7.84, abs=0.005)
    # A plan at one height is a bow in geo, and comes back level.
    plan = np.array([[0.0, -75.0 + np.degrees(angle) * part, 120.0] for part in np.linspace(0, 1, 11)])
    in_geo = enu_from_lla(plan, origin)
    assert in_geo[-1, 2] - in_geo[0, 2] < -7.8
    np.testing.assert_allclose(enu.lla_from_enu(in_geo, origin)[:, 2], 120.0, rtol=0, atol=1e-8)


ARIZONA_EAST = TransverseMercator(
    -(110 + 10 / 60), 31.0, scale=0.9999, false_easting_m=700_000 * FOOT_M, flattening=GRS80_FLATTENING
)


@pytest.mark.parametrize(
    ("crs", "place", "projection", "foot_m", "unit"),
    [
        ("EPSG:2263", (40.75, -73.6), long_island, US_FOOT_M, "US survey foot"),
        ("EPSG:6539", (40.75, -73.6), long_island, US_FOOT_M, "US survey foot"),
        ("EPSG:2222", (33.5, -110.2), ARIZONA_EAST.xy_m, FOOT_M, "foot"),
    ],
)
def test_state_plane_in_either_foot(
    crs: str, place: tuple[float, float], projection: Projection, foot_m: float, unit: str
) -> None:
    """All three coordinates are in feet; mixing up the two feet would be 2 ppm, 0.6 m on these eastings."""
    lla = around(*place)
    xyz = np.column_stack([projection(lla), lla[:, 2]]) / foot_m
    point_crs = parse_crs(crs)
    assert point_crs.units == (unit, unit, unit)
    # NAD83 is taken for WGS84 by a published shift of zero; GRS80 and WGS84 differ by 0.1 mm in half-axis.
    assert apart_m(point_crs.lla_from_xyz(xyz), lla) < 1e-3
    np.testing.assert_allclose(point_crs.xyz_from_lla(lla), xyz, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("crs", "place", "projection"),
    [
        # Northing first in the register, but for the last; eastings come first here in all of them.
        ("EPSG:3006", (60.0, 16.0), TransverseMercator(15.0, flattening=GRS80_FLATTENING).xy_m),
        (
            "EPSG:2180",
            (52.0, 19.5),
            TransverseMercator(19.0, scale=0.9993, false_northing_m=-5_300_000.0, flattening=GRS80_FLATTENING).xy_m,
        ),
        ("EPSG:3067", (62.0, 26.0), TransverseMercator(27.0, flattening=GRS80_FLATTENING).xy_m),
    ],
)
def test_eastings_come_first_whatever_the_register_says(
    crs: str, place: tuple[float, float], projection: Projection
) -> None:
    lla = around(*place)
    xyz = np.column_stack([projection(lla), lla[:, 2]])
    assert apart_m(parse_crs(crs).lla_from_xyz(xyz), lla) < 1e-3
    np.testing.assert_allclose(parse_crs(crs).xyz_from_lla(lla), xyz, rtol=0, atol=1e-3)


def test_gauss_krueger_has_its_zone_in_the_easting() -> None:
    # Bessel's ellipsoid on the Potsdam datum, whose shift to WGS84 is below 200 m.
    zone_3 = TransverseMercator(
        9.0, scale=1.0, false_easting_m=3_500_000.0, axis_m=6377397.155, flattening=1 / 299.1528128
    )
    lla = around(50.0, 9.3)
    np.testing.assert_allclose(parse_crs("EPSG:31467").xyz_from_lla(lla)[:, :2], zone_3.xy_m(lla), rtol=0, atol=200)


@pytest.mark.parametrize(
    ("crs", "lat", "lon"),
    [
        ("EPSG:31467", 50.0, 9.3),  # DHDN
        ("EPSG:27700", 51.5, -0.1),  # OSGB36
        ("EPSG:2100", 38.0, 24.0),  # GGRS87
        ("EPSG:27572", 49.5, 2.5),  # NTF, grads from Paris
        ("EPSG:27391", 60.0, 6.0),  # NGO 1948, degrees from Oslo
    ],
)
def test_there_and_back_over_a_datum_shift(crs: str, lat: float, lon: float) -> None:
    # PROJ alone comes back 0.4 … 4 mm off: it takes heights for ones above either ellipsoid, some 50 m apart.
    lla = around(lat, lon, height_m=400.0)
    assert apart_m(parse_crs(crs).lla_from_xyz(parse_crs(crs).xyz_from_lla(lla)), lla) < 1e-6


def test_grads_from_paris() -> None:
    # Lambert zone II puts 52 grads north on the meridian of Paris at (600 km, 2200 km).
    lla = parse_crs("EPSG:27572").lla_from_xyz([[600_000.0, 2_200_000.0, 0.0]])
    np.testing.assert_allclose(lla[0, :2], [46.8, 2.33722917], rtol=0, atol=1e-3)  # NTF is 100 m off WGS84


def test_a_sites_own_grid_may_have_points_at_its_zero() -> None:
    text = "+proj=tmerc +lat_0=46.02 +lon_0=7.75 +datum=WGS84"
    lla = parse_crs(text).lla_from_xyz([[0.0, 0.0, 5.0], [40.0, 30.0, 5.0]])
    geo = enu_from_lla(lla, Origin(lat_deg=46.02, lon_deg=7.75, alt_m=5.0))
    np.testing.assert_allclose(geo, [[0, 0, 0], [40, 30, 0]], rtol=0, atol=1e-3)
    with refused("degrees-in-projection", InputError):
        parse_crs("+proj=utm +zone=32 +datum=WGS84").lla_from_xyz([[7.75, 46.02, 5.0]])


def test_the_pole_itself() -> None:
    for crs in ("EPSG:3413", "EPSG:5041"):
        pole = parse_crs(crs).xyz_from_lla([[90.0, 0.0, 20.0]])
        assert apart_m(parse_crs(crs).lla_from_xyz(pole), np.array([[90.0, 0.0, 20.0]])) < 1e-6


def test_one_operation_across_the_date_line() -> None:
    # Taveuni in Fiji has the 180th meridian through it; the islands' own grid is good to 2 m there.
    crs, lla = parse_crs("EPSG:3460"), around(-16.8, 180.0)
    assert lla[:, 1].min() < -179.9 and lla[:, 1].max() > 179.9
    assert crs.operation(lla).accuracy_m == 2.0
    assert apart_m(crs.lla_from_xyz(crs.xyz_from_lla(lla)), lla) < 1e-6


def test_points_outside_are_not_given_coordinates() -> None:
    with refused("point-outside-area", InputError):
        parse_crs("EPSG:32632").xyz_from_lla([[40.0, -100.0, 10.0]])
    with refused("point-not-finite", InputError):
        parse_crs("EPSG:32632").xyz_from_lla([[np.nan, 9.0, 10.0]])


@pytest.fixture
def geoid_of_new_york(tmp_path: Path) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """A made-up GEOID18 around New York, bilinear in between its nodes: undulation in metres of points (N, 3)."""
    lat, lon = np.meshgrid(np.arange(39.0, 43.0), np.arange(-76.0, -71.0), indexing="ij")
    header = struct.pack(">ddddii", 39.0, -76.0, 1.0, 1.0, *lat.shape)
    (tmp_path / "g2018u0.gtx").write_bytes(
        header + (-32.0 + 0.5 * (lat - 40) + 0.25 * (lon + 74)).astype(">f4").tobytes()
    )
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    yield lambda lla: -32.0 + 0.5 * (lla[:, 0] - 40) + 0.25 * (lla[:, 1] + 74)
    pyproj.datadir.set_data_dir(before)


@pytest.mark.parametrize(
    ("text", "vertical", "foot_m", "height_unit_m"),
    [
        ("EPSG:6539+6360", None, US_FOOT_M, US_FOOT_M),
        ("EPSG:6539+5703", None, US_FOOT_M, 1.0),
        ("EPSG:6538+5703", None, 1.0, 1.0),
        ("EPSG:6539", "EPSG:6360", US_FOOT_M, US_FOOT_M),
        ("EPSG:6539", "EPSG:5703", US_FOOT_M, 1.0),
    ],
)
def test_orthometric_heights_in_feet_or_metres(
    geoid_of_new_york: Callable[[np.ndarray], np.ndarray],
    text: str,
    vertical: str | None,
    foot_m: float,
    height_unit_m: float,
) -> None:
    lla = around(40.75, -73.6)
    orthometric_m = lla[:, 2] - geoid_of_new_york(lla)
    xyz = np.column_stack([long_island(lla) / foot_m, orthometric_m / height_unit_m])
    crs = parse_crs(text, vertical=parse_vertical(vertical) if vertical else None)
    assert crs.vertical.stated
    assert apart_m(crs.lla_from_xyz(xyz), lla) < 1e-3  # GRS80 for WGS84
    np.testing.assert_allclose(crs.xyz_from_lla(lla), xyz, rtol=0, atol=4e-3)


@pytest.mark.parametrize(
    ("text", "place", "grid"),
    [
        ("EPSG:6539+6360", (40.75, -73.6), "us_noaa_g2018u0.tif"),
        ("EPSG:4326+3855", (50.0, 6.0), "us_nga_egm08_25.tif"),
        ("EPSG:32631+5773", (50.0, 6.0), "us_nga_egm96_15.tif"),
        ("+proj=utm +zone=31 +datum=WGS84 +geoidgrids=egm.gtx +vunits=m", (50.0, 6.0), "egm.gtx"),
        # Optional grids: PROJ would shift by zero.
        ("+proj=utm +zone=31 +datum=WGS84 +geoidgrids=@egm.gtx +vunits=m", (50.0, 6.0), "egm.gtx"),
        ("+proj=utm +zone=10 +ellps=clrk66 +nadgrids=@conus +units=m", (40.0, -123.0), "conus"),
        ("EPSG:2029", (45.0, -81.0), "ca_nrc_MAY76V20.tif"),
    ],
)
def test_without_its_grid_no_height_and_no_shift(text: str, place: tuple[float, float], grid: str) -> None:
    with refused("grid-not-installed", InputError) as error:
        parse_crs(text).xyz_from_lla(around(*place))
    message = str(error.value)
    assert f"PROJ grid {grid} " in message and f"pyproj sync --file {grid}" in message
    is_of_heights = "+nadgrids" not in text and text != "EPSG:2029"
    assert ("--vertical ellipsoidal" in message) == is_of_heights


def test_a_shift_of_zero_that_the_user_states_is_one() -> None:
    lla = around(40.0, -123.0)
    crs = parse_crs("+proj=utm +zone=10 +ellps=WGS84 +nadgrids=@null +units=m")
    np.testing.assert_allclose(crs.xyz_from_lla(lla)[:, :2], utm(10).xy_m(lla), rtol=0, atol=1e-6)


def test_a_vertical_datum_without_any_geoid_says_so() -> None:
    with refused("geoid-unknown", InputError) as error:
        parse_crs("EPSG:25832+5783").xyz_from_lla(around(50.0, 9.0))
    assert "DHHN92 height" in error.value.message


@pytest.mark.parametrize(("crs", "place"), [("EPSG:4547", (30.0, 114.2)), ("EPSG:22217", (43.7, -80.0))])
def test_a_modern_datum_without_a_published_way_gets_one_to_copy(crs: str, place: tuple[float, float]) -> None:
    with refused("no-transformation", InputError) as error:
        parse_crs(crs).xyz_from_lla(around(*place))
    offered = str(error.value).rpartition("give: ")[2]
    lla = around(*place)
    central, scale = (114.0, 1.0) if crs == "EPSG:4547" else (-81.0, 0.9996)
    grid = TransverseMercator(central, scale=scale, flattening=GRS80_FLATTENING)
    np.testing.assert_allclose(parse_crs(offered).xyz_from_lla(lla)[:, :2], grid.xy_m(lla), rtol=0, atol=1e-3)


def test_an_old_datum_gets_no_such_offer() -> None:
    with refused("no-transformation", InputError) as error:
        parse_crs("EPSG:2327").xyz_from_lla(around(35.0, 75.0))  # Xian 1980
    assert "towgs84=0,0,0" not in str(error.value)
