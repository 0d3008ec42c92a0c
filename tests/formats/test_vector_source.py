"""Vector files that want GDAL to do more than read them: other drivers, addresses, SQL; and tables of QGIS."""

from __future__ import annotations

import contextlib
import http.server
import json
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from pipelines.core.errors import InputError
from pipelines.formats.boundary_file import Boundary, read_boundary
from pipelines.formats.vector_files import column_names, read_contours
from pipelines.formats.vector_source import gdal, layers_with_shapes

SQUARE = shapely.box(7.0, 46.0, 7.01, 46.02)
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS fid, NULL AS geom FROM n"


def package(path: Path, layer: str = "site") -> Path:
    gdal().raw.write(
        path,
        geometry=np.array([shapely.to_wkb(SQUARE)], dtype=object),
        field_data=[],
        fields=[],
        layer=layer,
        driver="GPKG",
        geometry_type="Polygon",
        crs="EPSG:4326",
        append=path.exists(),
    )
    return path


def area_of(boundary: Boundary) -> float:
    return sum(polygon.area for layer in boundary.layers for polygon in layer.polygons)


def execute(path: Path, *statements: str) -> Path:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as base:
        for statement in statements:
            base.execute(statement)
    return path


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    """Yield the address of a server, and what it was asked for."""
    asked: list[str] = []

    class Listener(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *words: object) -> None:
            """Say nothing."""

    listener = http.server.HTTPServer(("127.0.0.1", 0), Listener)
    threading.Thread(target=listener.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{listener.server_port}/plan.geojson", asked
    listener.shutdown()
    listener.server_close()


# What GDAL's other drivers know by content, by suffix that is taken for a boundary.
HOSTILE = {
    "a pipeline": ("site.json", '{"type": "gdal_streamed_alg", "command_line": "gdal vector pipeline ! read URL"}'),
    "a pipeline with a suffix": (
        "site.geojson",
        '{"type": "gdal_streamed_alg", "command_line": "gdal vector pipeline ! read /vsicurl/URL"}',
    ),
    "a service of features": ("site.json", '{"links": [{"rel": "data", "href": "URL"}], "title": "a"}'),
    "a source of another kind": (
        "site.kml",
        "<?xml version='1.0'?><OGRVRTDataSource><OGRVRTLayer name='a'><SrcDataSource>URL</SrcDataSource>"
        "</OGRVRTLayer></OGRVRTDataSource>",
    ),
    "a web feature service": (
        "site.kml",
        "<?xml version='1.0'?><OGRWFSDataSource><URL>URL</URL></OGRWFSDataSource>",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_no_address_in_a_file_is_opened(tmp_path: Path, server: tuple[str, list[str]], name: str) -> None:
    address, asked = server
    file, text = HOSTILE[name]
    (tmp_path / file).write_text(text.replace("URL", address))
    with pytest.raises(InputError) as caught:
        read_boundary(tmp_path / file, field="--boundary")
    assert caught.value.code in ("boundary-unreadable", "boundary-format", "boundary-without-area")
    assert (caught.value.path, asked) == (tmp_path / file, [])


def test_drivers_are_those_of_the_formats(tmp_path: Path) -> None:
    package(tmp_path / "a.gpkg")
    assert set(pyogrio.list_drivers()) <= {"GPKG", "GeoJSON", "KML", "LIBKML", "DXF"}


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, f_table_name TEXT, styleQML TEXT)",
        "CREATE TABLE notes (id INTEGER PRIMARY KEY, text TEXT)",
        f"CREATE VIEW counting AS {ENDLESS}",  # not one of the layers
        "CREATE VIEW names AS SELECT 'a' AS name",
    ],
)
def test_what_is_no_layer_is_passed_over(tmp_path: Path, statement: str) -> None:
    path = execute(package(tmp_path / "site.gpkg"), statement)
    if "TABLE" in statement:
        name = statement.split()[2]
        execute(
            path,
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) "
            f"VALUES ('{name}', 'attributes', '{name}')",
        )
        execute(path, f"INSERT INTO {name} DEFAULT VALUES")
    before = path.read_bytes()
    boundary = read_boundary(path, field="--boundary")
    assert area_of(boundary) == pytest.approx(SQUARE.area)
    assert path.read_bytes() == before
    if "TABLE" in statement:
        assert layers_with_shapes(path) == ["site"]


@pytest.mark.parametrize("select", [ENDLESS, "SELECT fid, geom FROM site"])
@pytest.mark.parametrize("name", ["plan", 'a "plan"', "PLAN"])
def test_layer_that_is_a_view_is_named_and_not_executed(tmp_path: Path, select: str, name: str) -> None:
    path = package(tmp_path / "site.gpkg")
    quoted, text = '"' + name.replace('"', '""') + '"', name.replace("'", "''")
    execute(
        path,
        f"CREATE VIEW {quoted} AS {select}",
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
        f"VALUES ('{text}', 'features', '{text}', 4326)",
        f"INSERT INTO gpkg_geometry_columns VALUES ('{text}', 'geom', 'POLYGON', 4326, 0, 0)",
    )
    began = time.monotonic()
    with pytest.raises(InputError) as caught:
        read_boundary(path, field="--boundary")
    assert (caught.value.code, caught.value.field) == ("layer-is-view", "--boundary")
    assert repr(name) in caught.value.message and time.monotonic() - began < 10  # one that is executed never ends


@pytest.mark.parametrize("table", ["gpkg_contents", "gpkg_geometry_columns", "contours"])
def test_own_tables_that_are_views(tmp_path: Path, table: str) -> None:
    path = package(tmp_path / "contours.gpkg", "contours")
    execute(path, f"ALTER TABLE {table} RENAME TO kept", f"CREATE VIEW {table} AS {ENDLESS}")
    for read in (read_contours, lambda file: read_boundary(file, field="--boundary")):
        with pytest.raises(InputError):
            read(path)


def test_names_of_columns_are_taken_once() -> None:
    names = ["fid", "name", "NAME", "Name 2", "geom", "GEOM", "FID", "area", "a\0b", "a b"]
    columns = column_names(names)
    assert columns[1] == "name" and columns[7] == "area"
    folded = [column.casefold() for column in columns]
    assert len(set(folded)) == len(names) and not {"fid", "geom"} & set(folded) and "\0" not in "".join(columns)


def test_boundaries_of_every_suffix_are_read(tmp_path: Path) -> None:
    ring = list(SQUARE.exterior.coords)
    text = json.dumps({"type": "Polygon", "coordinates": [ring]})
    places = " ".join(f"{x},{y}" for x, y in ring)
    kml = (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon><outerBoundaryIs>'
        f"<LinearRing><coordinates>{places}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
    )
    for name, content in (("a.geojson", text), ("a.json", text), ("a.kml", kml)):
        (tmp_path / name).write_text(content)
        assert area_of(read_boundary(tmp_path / name, field="--boundary")) == pytest.approx(SQUARE.area), name
