"""Names of reference systems as people write them, against codes of the EPSG register."""

from __future__ import annotations

import pytest

from pipelines.core.errors import InputError
from pipelines.geodesy.crs import parse_crs
from tests.refusals import refused


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("WGS84 UTM33N", 32633),
        ("WGS 84 / UTM zone 33 North", 32633),
        ("WGS84_UTM_30U", 32630),
        ("wgs84 utm 23k", 32723),
        ("ETRS89 UTM 32N", 25832),
        ("NAD83 UTM 10N", 26910),
        ("GDA94 MGA55", 28355),
        ("HD72 EOV", 23700),
    ],
)
def test_near_misses_of_one_system_are_read(name: str, code: int) -> None:
    assert f"EPSG:{code})" in str(parse_crs(name).read_as)


@pytest.mark.parametrize(
    ("name", "codes"),
    [
        ("PUWG1992", (2180,)),
        ("UTM 30U", (32630, 25830)),
        ("UTM 33S", (32633, 32733)),  # the band S lies in the north
        ("WGS84 UTM 33", (32633, 32733)),
        ("Lambert 93", (2154,)),
        ("Irish Transverse Mercator", (2157,)),
    ],
)
def test_what_several_may_mean_is_proposed(name: str, codes: tuple[int, ...]) -> None:
    with refused("crs-unknown", InputError) as error:
        parse_crs(name)
    assert all(f"EPSG:{code} " in error.value.message for code in codes)


@pytest.mark.parametrize(
    ("name", "xyz", "right", "wrong"),
    [
        ("RGF93", (652000.0, 6862000.0, 30.0), 2154, 3943),  # Paris, in Lambert-93 and in no zone of 43° north
        ("GDA94", (321000.0, 5813000.0, 30.0), 28355, 3112),  # Melbourne, in a zone and not in the Lambert grid
    ],
)
def test_a_datum_for_eastings_is_answered_with_grids_that_hold_the_points(
    name: str, xyz: tuple[float, float, float], right: int, wrong: int
) -> None:
    with refused("latitude-range", InputError) as error:
        parse_crs(name).lla_from_xyz([xyz])
    assert f"EPSG:{right} " in error.value.message and f"EPSG:{wrong} " not in error.value.message


def test_nonsense_has_no_proposals() -> None:
    with refused("crs-unknown", InputError) as error:
        parse_crs("qqqq")
    assert "Did you mean" not in error.value.message


@pytest.mark.parametrize(
    ("bare", "named"), [("32632", "EPSG:32632"), ("25832+5783", "EPSG:25832+5783"), ("2056", "EPSG:2056")]
)
def test_bare_numbers_are_codes_of_epsg(bare: str, named: str) -> None:
    assert parse_crs(bare).wkt == parse_crs(named).wkt
