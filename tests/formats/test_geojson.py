"""GeoJSON after RFC 7946: rings closed and anticlockwise, cut at the date line, no NaN; contours as GeoPackage."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.core.files import replace_text
from pipelines.formats.vector_files import ContourLine, feature, features_text, polygon, write_contours_gpkg
from pipelines.geodesy.crs import parse_crs


def area(ring: list[list[float]]) -> float:
    x, y = (np.array(ring[:-1]) - ring[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(1e-4, 5), st.booleans())
def test_ring_anywhere_on_earth_is_valid_and_keeps_its_area(
    lon: float, lat: float, size: float, clockwise: bool
) -> None:
    box = np.array([[0, 0], [size, 0], [size, size], [0, size]])
    corners = (box + np.array([lon, lat]))[:: -1 if clockwise else 1]
    corners[:, 0] -= 360.0 * np.round(corners[:, 0] / 360.0)  # as `lla_from_ecef` gives them
    geometry = polygon(corners)
    assert geometry is not None
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    total = 0.0
    for (ring,) in polygons:
        assert ring[0] == ring[-1]
        assert area(ring) > 0
        assert np.abs(np.array(ring)[:, 0]).max() <= 180
        total += area(ring)
    # Coordinates have eight decimals; a sliver of less than one of them beyond the date line is left out.
    assert total == pytest.approx(size**2, abs=4e-8 * size + 1e-12)


def test_ring_across_the_date_line_becomes_two() -> None:
    geometry = polygon([[179.0, -17], [-179.0, -17], [-179.0, -16], [179.0, -16]])
    assert geometry is not None
    assert geometry["type"] == "MultiPolygon"
    assert {min(lon for lon, _ in ring) for (ring,) in geometry["coordinates"]} == {179.0, -180.0}


def test_ring_without_area_is_an_unlocated_feature() -> None:
    assert polygon(np.zeros((0, 2))) is None
    assert polygon([[7.0, 46.0]] * 4) is None


def test_collection_is_json_without_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    replace_text(
        path,
        features_text(
            [feature(None, {"name": "Aé", "sigma_e_m": float("nan"), "clipped": True}), feature(None, {})]
        ),
    )
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection"
    assert document["features"][0]["properties"] == {"name": "Aé", "sigma_e_m": None, "clipped": True}
    assert document["features"][1] == {"type": "Feature", "geometry": None, "properties": {}}
    assert [path.name for path in tmp_path.iterdir()] == ["a.geojson"]


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32632+3855"])
def test_contours_are_a_geopackage_that_older_gis_know(tmp_path: Path, crs: str) -> None:
    """Version 1.2, from which GDAL 3.6 reads without a warning, with heights and CRS as they were written."""
    pyogrio = pytest.importorskip("pyogrio")
    path = tmp_path / "contours.gpkg"
    lines = [
        ContourLine(float(height), np.array([[0.0, height], [5, 2], [9, 4]]), height == 5) for height in (4, 5)
    ]
    write_contours_gpkg(path, lines, parse_crs(crs).wkt)
    with contextlib.closing(sqlite3.connect(path)) as database:
        ((application,),) = database.execute("PRAGMA application_id")
        ((version,),) = database.execute("PRAGMA user_version")
    assert (application.to_bytes(4, "big"), version) == (b"GPKG", 10200)
    meta, _, shapes, (height, major) = pyogrio.raw.read(path)
    assert meta["geometry_type"] == "LineString Z"
    assert (height.tolist(), major.tolist()) == ([4.0, 5.0], [False, True])
    assert np.frombuffer(shapes[0][9:], "<f8").reshape(-1, 3)[:, 2].tolist() == [4.0] * 3
    # Of a compound CRS GDAL reads its code, or its text where the code has two parts.
    assert meta["crs"] == crs or "EGM2008" in meta["crs"]
