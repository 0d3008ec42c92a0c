"""CRS, datum and units of clouds: points return to their place by what file and user say, or a file is refused."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList
from pyproj import CRS

from pipelines.core.errors import InputError
from pipelines.formats.las import open_las
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geodesy.geotiff_keys import keyed_crs, vertical_of_code
from pipelines.geodesy.vertical import parse_vertical
from pipelines.surface.measured_cloud import CloudReader, Thinning, read_thinned
from pipelines.survey.options import CloudCrs
from tests.refusals import codes, refused, said

ORIGIN = Origin(lat_deg=52.1, lon_deg=5.2, alt_m=40.0)
ZONE, OTHER = "EPSG:32631", "EPSG:32632"
STEP = 1e-3
FOOT, US_FOOT = 0.3048, 1200 / 3937
POINTS = np.random.default_rng(0).uniform([-200, -200, -20], [200, 200, 40], (60, 3))
Keys = Sequence[tuple[int, int]]


def write(
    path: Path,
    *,
    crs: str = ZONE,
    keys: Keys = (),
    texts: dict[int, str] | None = None,
    wkt: str | None = None,
    record: tuple[str, int] = ("LASF_Projection", 2112),
    extended: bool = False,
    wkt_bit: bool = True,
    unit: tuple[float, float] = (1.0, 1.0),
) -> Path:
    """Write the points: their plan in `crs` over the first unit, ellipsoidal heights over the second."""
    xyz = parse_crs(crs).xyz_from_lla(lla_from_enu(POINTS, ORIGIN)) / [unit[0], unit[0], unit[1]]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, STEP), np.floor(xyz.mean(axis=0))
    header.global_encoding.wkt = wkt_bit and wkt is not None
    text, words = b"", []
    for key, value in keys:
        words.append(struct.pack("<4H", key, 0, 1, value))
    for key, value in (texts or {}).items():
        words.append(struct.pack("<4H", key, 34737, len(value) + 1, len(text)))
        text += value.encode() + b"|"
    records = []
    if words:
        directory = struct.pack("<4H", 1, 1, 0, len(words)) + b"".join(words)
        records.append(laspy.VLR("LASF_Projection", 34735, "keys", directory))
        records.append(laspy.VLR("LASF_Projection", 34737, "texts", text + b"\0"))
    if wkt is not None:
        records.append(laspy.VLR(*record, "WKT", wkt.encode() + b"\0"))
    if not extended:
        header.vlrs.extend(records)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    if extended:
        las.evlrs = VLRList(records)
    las.write(path)
    return path


def placed(path: Path, stated: CloudCrs = CloudCrs()) -> tuple[np.ndarray, CloudReader]:  # noqa: B008
    reader = CloudReader(path, stated)
    return np.concatenate([chunk.position_in_geo for chunk in reader.chunks(ORIGIN)]), reader


def require_place(found: np.ndarray, unit: float = 1.0) -> None:
    """Half a step of the file along each axis."""
    np.testing.assert_allclose(found, POINTS, rtol=0, atol=0.6 * STEP * max(unit, 1.0))


def keys_of(crs: str, *more: tuple[int, int]) -> Keys:
    code = int(crs.removeprefix("EPSG:"))
    is_geographic = CRS(crs).is_geographic
    return [(1024, 2 if is_geographic else 1), (2048 if is_geographic else 3072, code), *more]


def wkt1(crs: str) -> str:
    return str(CRS(crs).to_wkt("WKT1_GDAL"))


@pytest.mark.parametrize(
    "said_by",
    [
        {"keys": keys_of(ZONE)},
        {"wkt": wkt1(ZONE)},
        {"wkt": wkt1(ZONE), "extended": True},
        {"keys": keys_of(ZONE), "extended": True},
        {"wkt": CRS(ZONE).to_wkt(), "record": ("LASF_Projection", 4224)},
        {"wkt": wkt1(ZONE), "record": ("liblas", 2112)},
        {"wkt": wkt1(ZONE), "wkt_bit": False},  # the only source, whatever the bit says
        {"wkt": "\r\n", "keys": keys_of(ZONE)},
        {"wkt": 'LOCAL_CS["unknown",UNIT["metre",1]]', "keys": keys_of(ZONE)},
    ],
)
def test_the_crs_is_found_in_every_record(tmp_path: Path, said_by: dict[str, Any]) -> None:
    found, reader = placed(write(tmp_path / "c.laz", **said_by))
    require_place(found)
    assert codes(reader.assumptions) == ["lidar-heights"]


def test_a_placeholder_does_not_hide_the_crs_of_an_extended_record(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", wkt=wkt1(ZONE), extended=True)
    las = laspy.read(path)
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "WKT", b'LOCAL_CS["unknown",UNIT["metre",1]]'))
    las.write(path)
    require_place(placed(path)[0])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "\r\n",
        " \t ",
        "unknown",
        'LOCAL_CS["unknown",UNIT["metre",1]]',
        'ENGCRS["unknown",EDATUM[""],CS[Cartesian,2],AXIS["(E)",east],AXIS["(N)",north],LENGTHUNIT["metre",1]]',
        'LOCAL_CS["site grid of 1987",LOCAL_DATUM["site",32767],UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]',
    ],
)
def test_what_is_no_place_on_earth_is_no_crs(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "c.laz", wkt=text)
    require_place(placed(path, CloudCrs(crs=ZONE))[0])
    with refused("crs-unknown", InputError) as error:
        CloudReader(path, CloudCrs(flag="--reference"))
    assert "--reference-crs" in str(error.value)


@pytest.mark.parametrize(
    ("crs", "keys", "unit"),
    [
        (ZONE, keys_of(ZONE, (4099, 9002)), (1, FOOT)),
        (ZONE, keys_of(ZONE, (4099, 9003)), (1, US_FOOT)),
        (ZONE, keys_of(ZONE, (3076, 9001), (4099, 9001)), (1, 1)),
        (ZONE, keys_of(ZONE, (3076, 9002), (4099, 9002)), (FOOT, FOOT)),
        (ZONE, keys_of(ZONE, (3076, 9003), (4099, 9001)), (US_FOOT, 1)),
        (ZONE, keys_of(ZONE, (3076, 9036), (4099, 9001)), (1000, 1)),  # kilometres
        (ZONE, keys_of(ZONE, (4096, 5030), (4099, 9002)), (1, FOOT)),
        ("EPSG:4326", keys_of("EPSG:4326", (2054, 9102), (4099, 9002)), (1, FOOT)),
    ],
)
def test_units_of_keys_are_those_of_the_coordinates(
    tmp_path: Path, crs: str, keys: Keys, unit: tuple[float, float]
) -> None:
    # A step of the file in degrees is 111 m.
    points = write(tmp_path / "c.laz", crs=crs if crs == ZONE else ZONE, keys=keys, unit=unit)
    if crs != ZONE:
        rewrite_in_degrees(points, unit[1])
    found, reader = placed(points)
    require_place(found, max(unit))
    assert ("lidar-map-unit" in codes(reader.notes)) == (unit[0] != 1)
    assert ("lidar-height-unit" in codes(reader.notes)) == (unit[1] != 1)


def rewrite_in_degrees(path: Path, unit: float) -> None:
    lla = lla_from_enu(POINTS, ORIGIN)
    header = laspy.read(path).header
    header.scales, header.offsets = [1e-9, 1e-9, STEP], [5.2, 52.1, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = lla[:, 1], lla[:, 0], lla[:, 2] / unit
    las.write(path)


def test_a_height_unit_of_keys_is_used_beside_a_wkt_without_heights(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", wkt=wkt1(ZONE), keys=keys_of(ZONE, (4099, 9002)), unit=(1, FOOT))
    require_place(placed(path)[0])


def test_heights_without_a_unit_beside_a_map_in_feet_are_called_assumed(tmp_path: Path) -> None:
    found, reader = placed(write(tmp_path / "c.laz", keys=keys_of(ZONE, (3076, 9002)), unit=(FOOT, 1)))
    require_place(found)
    assert codes(reader.notes) == ["lidar-map-unit", "lidar-height-unit-assumed"]


@pytest.mark.parametrize(
    ("keys", "wkt"),
    [
        (keys_of(ZONE, (3076, 9002)), wkt1(ZONE)),
        (keys_of(ZONE, (4099, 9003)), wkt1(f"{ZONE}+5773")),
        (keys_of("EPSG:2227", (3076, 9002)), None),  # the two feet lie 4 m apart there
    ],
)
@pytest.mark.parametrize("wkt_bit", [True, False])
def test_units_that_disagree_are_refused_by_name(
    tmp_path: Path, keys: Keys, wkt: str | None, wkt_bit: bool
) -> None:
    path = write(tmp_path / "c.laz", keys=keys, wkt=wkt, wkt_bit=wkt_bit)
    with refused("cloud-units-disagree", InputError) as error:
        CloudReader(path, CloudCrs())
    assert "foot" in error.value.message and "--lidar-crs" in error.value.remedy


def test_the_bit_decides_between_keys_and_wkt(tmp_path: Path) -> None:
    for right_keys in (True, False):
        keys, wkt = (ZONE, OTHER) if right_keys else (OTHER, ZONE)
        path = write(tmp_path / "c.laz", keys=keys_of(keys), wkt=wkt1(wkt), wkt_bit=not right_keys)
        found, reader = placed(path)
        require_place(found)
        sentence = said(reader.notes, "lidar-crs-disagrees")
        assert "31" in sentence and "32" in sentence and "WKT" in sentence
    agreeing = write(tmp_path / "c.laz", keys=keys_of(ZONE), wkt=wkt1(ZONE))
    assert not CloudReader(agreeing, CloudCrs()).notes


@pytest.mark.parametrize(
    ("code", "epsg"), [(5101, 5701), (5102, 5702), (5103, 5703), (5104, 5736), (5105, 5705), (5106, 5611)]
)
def test_datums_of_geotiff_1995_are_those_of_epsg(code: int, epsg: int) -> None:
    assert vertical_of_code(code, "").vertical_epsg == epsg
    assert CRS.from_epsg(epsg).axis_info[0].direction == "up"


def test_ellipsoids_of_geotiff_1995() -> None:
    assert all(vertical_of_code(code, "").is_ellipsoidal for code in (5019, 5030, 4979, 7030))
    for code, name in ((5001, "Airy"), (5022, "International 1924"), (5033, "OSU91A"), (32631, "no vertical")):
        assert name in vertical_of_code(code, "").vertical_problem


@pytest.mark.parametrize(
    ("more", "texts", "epsg"),
    [
        ([(4096, 5773)], {}, 5773),
        ([(4098, 5171)], {}, 5773),  # the datum's key
        ([(4096, 32767)], {4097: "NAVD88 - Geoid09 (Feet)"}, 5703),
        ([(4096, 32767), (4098, 5103)], {}, 5703),
        ([], {4097: "EGM2008 geoid"}, 3855),
    ],
)
def test_a_datum_is_found_by_every_key(tmp_path: Path, more: Keys, texts: dict[int, str], epsg: int) -> None:
    keys = open_las(write(tmp_path / "c.laz", keys=keys_of(ZONE, *more), texts=texts)).crs.keys
    assert keyed_crs(keys).vertical_epsg == epsg


@pytest.mark.parametrize("code", [5103, 5703])
def test_heights_of_a_datum_need_its_geoid(tmp_path: Path, code: int) -> None:
    """Its grid is not part of PROJ: nothing may be taken in its place, and the datum is named."""
    reader = CloudReader(write(tmp_path / "c.laz", keys=keys_of("EPSG:26910", (4096, code))), CloudCrs())
    assert reader.crs_names == ("EPSG:26910+5703",) and not reader.assumptions
    with pytest.raises(InputError, match="NAVD88"):
        next(reader.chunks(ORIGIN))


def test_ellipsoidal_heights_are_stated_by_their_code(tmp_path: Path) -> None:
    found, reader = placed(write(tmp_path / "c.laz", keys=keys_of(ZONE, (4096, 5030))))
    require_place(found)
    assert not reader.assumptions


def test_a_datum_in_the_keys_alone_counts_beside_wkt(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", wkt=wkt1(ZONE), keys=keys_of(ZONE, (4096, 5103)))
    reader = CloudReader(path, CloudCrs())
    assert not reader.assumptions and "NAVD88" in reader.crs_names[0]
    with pytest.raises(InputError, match="NAVD88"):
        next(reader.chunks(ORIGIN))
    in_wkt = write(tmp_path / "w.laz", wkt=wkt1(f"{ZONE}+5728"), keys=keys_of(ZONE), wkt_bit=False)
    with pytest.raises(InputError, match="LN02"):
        next(CloudReader(in_wkt, CloudCrs()).chunks(ORIGIN))


def test_a_datum_that_is_not_known_is_refused_until_the_user_states_one(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", keys=keys_of(ZONE, (4096, 5001)))
    with refused("vertical-datum-unknown", InputError) as error:
        CloudReader(path, CloudCrs())
    assert "5001" in error.value.message and "Airy" in error.value.message
    require_place(placed(path, CloudCrs(vertical=parse_vertical("ellipsoidal")))[0])


def test_the_user_overrules_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", keys=keys_of(OTHER, (3076, 9002), (4096, 5103)))
    stated = CloudCrs(crs=ZONE, vertical=parse_vertical("ellipsoidal"), flag="--reference")
    found, reader = placed(path, stated)
    require_place(found)
    assert codes(reader.assumptions) == ["reference-crs-overrules", "reference-vertical-overrules"]
    assert ZONE in said(reader.notes, "reference-crs-overrules") and OTHER in said(
        reader.notes, "reference-crs-overrules"
    )
    # With its datum: the file's is not asked for.
    whole = CloudReader(path, CloudCrs(crs=f"{ZONE}+5728"))
    assert codes(whole.notes) == ["lidar-crs-overrules", "lidar-vertical-overrules"]
    with pytest.raises(InputError, match="LN02"):
        next(whole.chunks(ORIGIN))
    # The same said twice is no remark.
    agreeing = write(tmp_path / "c.laz", wkt=wkt1(ZONE))
    assert not CloudReader(agreeing, CloudCrs(crs=ZONE)).notes
    with refused("vertical-stated-twice", InputError):
        CloudReader(agreeing, CloudCrs(crs=f"{ZONE}+5728", vertical=parse_vertical("EGM96")))


def test_a_stated_datum_overrules_the_ellipsoid_of_a_crs_in_space(tmp_path: Path) -> None:
    for path in (
        write(tmp_path / "w.laz", wkt=CRS("EPSG:32631").to_3d().to_wkt()),
        write(tmp_path / "k.laz", keys=keys_of(ZONE, (4096, 4979))),
    ):
        found, reader = placed(path)
        require_place(found)
        assert not reader.assumptions
        stated = CloudReader(path, CloudCrs(vertical=parse_vertical("EPSG:5728")))
        assert codes(stated.notes) == ["lidar-vertical-overrules"]
        with pytest.raises(InputError, match="LN02"):
            next(stated.chunks(ORIGIN))


def test_a_unit_of_heights_that_is_not_known_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "c.laz", keys=keys_of(ZONE, (4096, 5030), (4099, 32767)))
    with refused("height-unit-unknown", InputError) as error:
        CloudReader(path, CloudCrs())
    assert "4099" in error.value.message


def test_a_wkt_that_cannot_be_read_is_named_where_keys_stand_for_it(tmp_path: Path) -> None:
    found, reader = placed(write(tmp_path / "c.laz", wkt='PROJCS["cut off', keys=keys_of(ZONE)))
    require_place(found)
    assert codes(reader.notes) == ["lidar-crs-unreadable"]


def test_an_error_of_place_tells_what_is_odd_about_the_crs(tmp_path: Path) -> None:
    """Keys that state feet beside coordinates in metres: the error names both units, and the option counts."""
    path = write(tmp_path / "c.laz", keys=keys_of(ZONE, (3076, 9002), (4099, 9001)))
    box = Thinning(1.0, low_in_geo=np.full(3, -1e3), high_in_geo=np.full(3, 1e3))
    with pytest.raises(InputError, match="foot") as error:
        read_thinned(CloudReader(path, CloudCrs()), ORIGIN, box)
    assert "metre" in error.value.message and "--lidar-crs" in error.value.message
    require_place(placed(path, CloudCrs(crs=ZONE))[0])


def test_remarks_on_many_tiles_are_said_once(tmp_path: Path) -> None:
    for tile in range(4):
        write(tmp_path / f"{tile}.laz", keys=keys_of(ZONE, (4099, 9002)), unit=(1, FOOT))
    notes = CloudReader(tmp_path, CloudCrs()).notes
    assert codes(notes) == ["lidar-height-unit"] and "3 more" in notes[0].sentence


def patched(path: Path, at: int, form: str, value: float) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)
    return path


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("field", "value", "code"),
    [
        ("scale", np.nan, "las-scale"),
        ("scale", 0.0, "las-scale"),
        ("scale", np.inf, "las-scale"),
        ("offset", np.nan, "las-offset"),
        ("offset", -np.inf, "las-offset"),
    ],
)
def test_scales_and_offsets_that_place_no_point_are_refused(
    tmp_path: Path, axis: int, field: str, value: float, code: str
) -> None:
    path = write(tmp_path / "c.laz", keys=keys_of(ZONE))
    patched(path, 131 + 8 * (axis + 3 * (field == "offset")), "<d", value)
    with refused(code, InputError) as error:
        open_las(path)
    assert error.value.field == f"{'xyz'[axis]} {field}"


@pytest.mark.parametrize("pointer", [-1, 0])
@pytest.mark.parametrize("point_format", [1, 6])
def test_points_without_a_table_of_chunks_are_read_in_order(
    tmp_path: Path, pointer: int, point_format: int
) -> None:
    """As a writer leaves them that streams, or was ended before its last step: three chunks, then nothing."""
    header = laspy.LasHeader(version="1.4" if point_format == 6 else "1.2", point_format=point_format)
    header.scales = np.full(3, STEP)
    las, count = laspy.LasData(header), 120_000
    las.x, las.y, las.z = np.random.default_rng(1).uniform(-99, 99, (3, count))
    path = tmp_path / "c.laz"
    las.write(path)
    whole = path.read_bytes()
    (at,) = struct.unpack_from("<I", whole, 96)
    (table,) = struct.unpack_from("<q", whole, at)
    path.write_bytes(whole[:table])
    patched(path, at, "<q", pointer)
    found = np.concatenate([chunk.position for chunk in open_las(path).chunks(50_000)])
    np.testing.assert_array_equal(found, np.column_stack([las.x, las.y, las.z]))
    # What is cut off is not made up.
    for less in (1, 5, 4000):
        path.write_bytes(path.read_bytes()[: table - less])
        with pytest.raises(InputError):
            list(open_las(path).chunks(50_000))
