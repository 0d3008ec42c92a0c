"""Boundaries as programs and people write them: the same ground whatever encoding, unit, CRS and company."""

from __future__ import annotations

import json
import logging
import zipfile
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from ezdxf.filemanagement import new

from pipelines.core.errors import InputError
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.survey.area import boundary_area
from pipelines.survey.options import AreaOptions
from tests.refusals import logged_codes, refused

ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)
UTM = "EPSG:32632"
SQUARE = np.array([(-40.0, -40), (40, -40), (40, 40), (-40, 40)])  # 0.64 ha, of which the scene covers more
HECTARES = 0.64
CLOSE = 2e-4  # of an area: seven decimals of a degree are a centimetre of 80 m
POINTS = np.column_stack([np.random.default_rng(0).uniform(-50, 50, (300, 2)), np.zeros(300)])


def in_crs(plan: np.ndarray, crs: str = "EPSG:4326") -> np.ndarray:
    lla = lla_from_enu(np.column_stack([plan, np.zeros(len(plan))]), ORIGIN)
    return lla[:, [1, 0]] if crs == "EPSG:4326" else parse_crs(crs).xyz_from_lla(lla)[:, :2]


def hectares(path: Path, crs: str | None = None) -> float:
    area = boundary_area(AreaOptions(boundary=path, boundary_crs=crs), POINTS, ORIGIN)
    assert area is not None
    return area.hectares


def kml(shape: str, *, head: str = '<?xml version="1.0" encoding="UTF-8"?>\n', prefix: str = "") -> str:
    spaced = shape.replace("<", f"<{prefix}").replace(f"<{prefix}/", f"</{prefix}") if prefix else shape
    name = f"xmlns:{prefix[:-1]}" if prefix else "xmlns"
    place = f"<{prefix}Document><{prefix}Placemark>{spaced}</{prefix}Placemark></{prefix}Document>"
    return f'{head}<{prefix}kml {name}="http://www.opengis.net/kml/2.2">{place}</{prefix}kml>\n'


def coordinates(plan: np.ndarray = SQUARE, *, closed: bool = False, separator: str = ",") -> str:
    places = in_crs(np.vstack([plan, plan[:1]]) if closed else plan)
    words = " ".join(f"{x:.9f}{separator}{y:.9f}{separator}0" for x, y in places)
    return f"<coordinates>\n{words}\n</coordinates>"


def polygon(inside: str) -> str:
    return f"<Polygon><outerBoundaryIs><LinearRing>{inside}</LinearRing></outerBoundaryIs></Polygon>"


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (kml(polygon(coordinates())), "utf-8"),  # the ring is open
        (kml(polygon(coordinates(closed=True)), head="<!-- licence -->\n"), "utf-8"),
        (kml(polygon(coordinates(closed=True)), head="<?generator x?>\n<!DOCTYPE kml>\n"), "utf-8-sig"),
        (kml(polygon(coordinates()), head='<?xml version="1.0" encoding="UTF-16"?>'), "utf-16"),
        (kml(polygon(coordinates()), head=""), "utf-16-be"),  # without a byte order mark
        (kml(polygon(coordinates()), head='<?xml version="1.0" encoding="utf-16"?>'), "utf-8"),  # declared wrongly
        (
            kml(f"<name>Fläche</name>{polygon(coordinates())}", head='<?xml version="1.0" encoding="cp1252"?>'),
            "cp1252",
        ),
        (kml(f"<LinearRing>{coordinates()}</LinearRing>", prefix="k:"), "utf-8"),
        (kml(f"<LineString>{coordinates(closed=True)}</LineString>"), "utf-8"),
        (kml(f"<MultiGeometry>{polygon(coordinates(separator=', '))}</MultiGeometry>"), "utf-8"),
    ],
)
def test_kml_is_the_same_ground_however_it_is_written(tmp_path: Path, text: str, encoding: str) -> None:
    path = tmp_path / "site.kml"
    path.write_bytes(text.encode(encoding))
    assert hectares(path) == pytest.approx(HECTARES, rel=CLOSE)


@pytest.mark.parametrize("names", [("doc.kml",), ("files/site.KML", "second.kml"), ("../../../site.kml",)])
def test_kmz_is_read_where_it_lies(tmp_path: Path, names: tuple[str, ...]) -> None:
    """The first KML in the archive counts, whatever its name; nothing is unpacked onto the disk."""
    path = tmp_path / "a" / "b" / "c" / "site.kmz"
    path.parent.mkdir(parents=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("files/picture.png", b"\x89PNG")
        for number, name in enumerate(names):
            archive.writestr(name, kml(polygon(coordinates(SQUARE * (1 + number)))))
    assert hectares(path) == pytest.approx(HECTARES, rel=CLOSE)
    assert [one.name for one in tmp_path.rglob("*.*")] == ["site.kmz"]


def test_a_kmz_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "site.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("readme.txt", "no boundary")
    with refused("boundary-unreadable"):
        hectares(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", b" " * (65 << 20))  # 65 KiB that unpack to 65 MiB
    with refused("file-too-large"):
        hectares(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml(polygon(coordinates())))
    path.write_bytes(path.read_bytes()[:200])
    with refused("boundary-unreadable"):
        hectares(path)
    path.write_text(kml(polygon(coordinates())))
    with refused("boundary-format"):
        hectares(path)


def test_holes_of_kml_are_no_ground(tmp_path: Path) -> None:
    hole = f"<innerBoundaryIs><LinearRing>{coordinates(SQUARE / 4)}</LinearRing></innerBoundaryIs></Polygon>"
    path = tmp_path / "site.kml"
    path.write_text(kml(polygon(coordinates()).replace("</Polygon>", hole)))
    assert hectares(path) == pytest.approx(HECTARES * 15 / 16, rel=CLOSE)


def test_one_open_line_is_closed_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "site.kml"
    path.write_text(kml(f"<LineString>{coordinates()}</LineString>"))
    assert hectares(path) == pytest.approx(HECTARES, rel=CLOSE)
    assert logged_codes(caplog) == ["boundary-line-closed"]
    # Lines beside a polygon are no boundary: a road, a track.
    road = f"</Placemark><Placemark><LineString>{coordinates(SQUARE * 3)}</LineString>"
    path.write_text(kml(polygon(coordinates()) + road))
    assert hectares(path) == pytest.approx(HECTARES, rel=CLOSE)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (kml(polygon("&a;"), head='<!DOCTYPE kml [<!ENTITY a "7,46">]>'), "boundary-entities"),
        (kml(polygon("&a;"), head='<!DOCTYPE kml [<!ENTITY a SYSTEM "file:///etc/passwd">]>'), "boundary-entities"),
        ("<OGRVRTDataSource/>", "boundary-format"),
        ("<gpx><trk/></gpx>", "boundary-format"),
        (kml(polygon("<coordinates>7.7,46 7.8,x 7.8,46.1</coordinates>")), "boundary-unreadable"),
        (kml("<Folder>" * 300), "boundary-unreadable"),
        (kml(polygon("<coordinates>7.7,46 NaN,46 7.8,46.1</coordinates>")), "boundary-not-finite"),
    ],
)
def test_kml_that_is_refused(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "site.kml"
    path.write_text(text)
    with refused(code, InputError) as error:
        hectares(path)
    assert error.value.path == path


def geojson(plan: np.ndarray, **members: object) -> str:
    ring = np.vstack([plan, plan[:1]]).tolist()
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    return json.dumps({"type": "FeatureCollection", **members, "features": [feature]})


def named(name: str) -> dict[str, object]:
    return {"type": "name", "properties": {"name": name}}


@pytest.mark.parametrize(
    ("crs", "member", "option"),
    [
        (UTM, {}, UTM),
        (UTM, {"crs": named("urn:ogc:def:crs:EPSG::32632")}, None),
        (UTM, {"crs": {"type": "EPSG", "properties": {"code": 32632}}}, None),
        (UTM, {"crs": None}, UTM),
        ("EPSG:2056", {"crs": named("EPSG:2056")}, None),
        ("EPSG:4326", {"crs": named("urn:ogc:def:crs:OGC:1.3:CRS84")}, None),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_geojson_is_in_the_crs_that_is_said(
    tmp_path: Path, crs: str, member: dict[str, object], option: str | None, encoding: str
) -> None:
    path = tmp_path / "site.geojson"
    path.write_bytes(geojson(in_crs(SQUARE, crs), **member).encode(encoding))
    assert hectares(path, option) == pytest.approx(HECTARES, rel=1e-3)  # the scale of a map, 6e-4 here at most


def test_the_option_overrules_the_crs_of_a_file_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "site.geojson"
    path.write_text(geojson(in_crs(SQUARE, UTM), crs=named("EPSG:32631")))
    assert hectares(path, UTM) == pytest.approx(HECTARES, rel=1e-3)
    assert logged_codes(caplog) == ["boundary-crs-overrules"]


@pytest.mark.parametrize(
    ("members", "code"),
    [
        ({}, "boundary-no-degrees"),
        ({"crs": None}, "boundary-without-crs"),
        ({"crs": {"type": "link", "properties": {"href": "http://localhost/crs"}}}, "boundary-crs-member"),
        ({"crs": named("no such CRS")}, "crs-unknown"),
    ],
)
def test_projected_geojson_without_a_known_crs_is_refused(
    tmp_path: Path, members: dict[str, object], code: str
) -> None:
    path = tmp_path / "site.geojson"
    path.write_text(geojson(in_crs(SQUARE, UTM), **members))
    with refused(code, InputError):
        hectares(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrong", ["NaN", "Infinity", "-1e999"])
def test_a_corner_that_is_no_number_is_named(tmp_path: Path, wrong: str) -> None:
    text = geojson(in_crs(SQUARE)).replace(repr(float(in_crs(SQUARE)[2, 0])), wrong)
    (tmp_path / "site.geojson").write_text(text)
    with refused("boundary-not-finite", InputError) as error:
        hectares(tmp_path / "site.geojson")
    assert "corner 3 of shape 1" in error.value.message
    broken = in_crs(SQUARE, UTM)
    broken[1, 1] = float(wrong)
    with np.errstate(invalid="ignore"):
        write_gpkg(tmp_path / "site.gpkg", {"a": (UTM, broken)})
    with refused("boundary-not-finite", InputError):
        hectares(tmp_path / "site.gpkg")


def write_gpkg(path: Path, layers: dict[str, tuple[str | None, np.ndarray]]) -> None:
    for name, (crs, plan) in layers.items():
        shape = np.array([shapely.to_wkb(shapely.Polygon(plan))], dtype=object)
        pyogrio.raw.write(
            path, shape, [], [], layer=name, driver="GPKG", geometry_type="Polygon", crs=crs, append=path.exists()
        )


def test_each_layer_of_a_geopackage_is_in_its_own_crs(tmp_path: Path) -> None:
    path = tmp_path / "site.gpkg"
    layers = {}
    for turn, crs in enumerate(["EPSG:4326", UTM, "EPSG:2056"]):
        plan = SQUARE + np.array([100.0 * turn, 0])
        layers[f"layer {turn}"] = (crs, in_crs(plan, crs))
    write_gpkg(path, layers)
    assert hectares(path) == pytest.approx(3 * HECTARES, rel=1e-3)


Layers = dict[str, list[np.ndarray]]


def write_dxf(path: Path, layers: Layers, *, code: int | None, size: float = 1.0, form: str = "asc") -> None:
    document = new("R2010")
    if code is not None:
        document.header["$INSUNITS"] = code
    else:
        del document.header["$INSUNITS"]
    for layer, outlines in layers.items():
        for plan in outlines:
            places = (in_crs(plan, UTM) / size).tolist()
            document.modelspace().add_lwpolyline(places, close=True, dxfattribs={"layer": layer})
    document.paperspace().add_lwpolyline([(0, 0), (420, 0), (420, 297), (0, 297)], close=True)
    document.saveas(path, fmt=form)


@pytest.mark.parametrize(
    ("code", "size"),
    [(4, 0.001), (5, 0.01), (7, 1000.0), (2, 0.3048), (21, 1200 / 3937), (1, 0.0254), (0, 1.0), (None, 1.0)],
)
@pytest.mark.parametrize("form", ["asc", "bin"])
def test_the_unit_of_a_drawing_counts(
    tmp_path: Path, code: int | None, size: float, form: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "site.dxf"
    write_dxf(path, {"SITE": [SQUARE]}, code=code, size=size, form=form)
    assert hectares(path, UTM) == pytest.approx(HECTARES, rel=1e-3)
    assert logged_codes(caplog) == (["boundary-unit"] if size != 1.0 else [])


def test_a_unit_that_nobody_chose_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Coordinates in metres, and the header of a template: millimetres, inches."""
    for code in (4, 1):
        path = tmp_path / "site.dxf"
        write_dxf(path, {"SITE": [SQUARE]}, code=code)
        assert hectares(path, UTM) == pytest.approx(HECTARES, rel=1e-3)
    assert logged_codes(caplog) == ["boundary-unit-ignored"] * 2


FRAME = SQUARE * 225  # 18 km
PARCEL = SQUARE / 4 + np.array([300.0, 0])


@pytest.mark.parametrize(
    ("layers", "right"),
    [
        ({"FRAME": [FRAME], "PERIMETER": [SQUARE]}, HECTARES),
        ({"0": [FRAME, FRAME * 0.99, SQUARE]}, HECTARES),  # the frame is two lines, in the site's layer
        ({"A": [SQUARE], "B": [SQUARE / 8], "C": [FRAME, PARCEL * 9]}, HECTARES),  # names tell nothing
        ({"Grenze": [SQUARE / 2], "Häuser": [SQUARE, SQUARE / 8]}, HECTARES / 4),  # a name tells
        ({"SITE": [SQUARE, PARCEL]}, HECTARES * 17 / 16),  # one layer: all of it
        ({"FRAME": [FRAME]}, HECTARES * 225**2),  # nothing else to take
    ],
)
def test_the_site_is_taken_from_a_drawing_and_not_its_frame(
    tmp_path: Path, layers: Layers, right: float, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "site.dxf"
    write_dxf(path, layers, code=6)
    assert hectares(path, UTM) == pytest.approx(right, rel=3e-3)  # at 9 km, the scale of the map differs more
    wholly = all(len(outlines) == 1 for outlines in layers.values()) and len(layers) == 1
    assert logged_codes(caplog) == ([] if wholly or "SITE" in layers else ["boundary-layer"])


def test_lines_that_close_around_a_site_together_are_its_boundary(tmp_path: Path) -> None:
    document, corners = new("R2010"), in_crs(SQUARE, UTM).tolist()
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        document.modelspace().add_line(start, end)
    document.saveas(tmp_path / "site.dxf")
    assert hectares(tmp_path / "site.dxf", UTM) == pytest.approx(HECTARES, rel=1e-3)


@pytest.fixture(autouse=True)
def _log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
