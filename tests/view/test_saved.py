"""Saved measurements come back, whatever their names; other files are refused with the place of the fault."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.core.errors import InputError
from pipelines.survey.saved_measurements import (
    MEASUREMENTS,
    Kind,
    NamedMeasurement,
    Quantity,
    SavedPoint,
    read_measurements,
)
from pipelines.view import saved
from pipelines.view.saved import PACKAGE, TABLES, SavedMeasurements
from tests.refusals import refused

NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), min_size=1, max_size=8)
FINITE = st.floats(-1e6, 1e6)
PLACES = st.tuples(FINITE, FINITE, FINITE)
LLA = st.tuples(st.floats(-89, 89), st.floats(-179, 179), st.floats(-100, 9000))


def saved_point(place, lla, sigma) -> SavedPoint:
    cov = np.outer(place, place).tolist()
    return SavedPoint.model_validate(
        {
            "position_in_geo": place,
            "cov_of_surface": cov,
            "images": ["a/b.jpg"],
            "xyz": place,
            "sigma_m": sigma,
            "lla": lla,
        }
    )


POINTS = st.builds(saved_point, st.tuples(*3 * (st.floats(-100, 100),)), LLA, st.none() | PLACES)
MEASUREMENT = st.builds(
    NamedMeasurement,
    name=NAMES,
    kind=st.sampled_from(["point", "distance", "polyline", "area", "volume", "profile"]),
    crs=NAMES,
    model=NAMES,
    points=st.lists(POINTS, min_size=1, max_size=3).map(tuple),
    quantities=st.lists(
        st.builds(Quantity, name=NAMES, value=FINITE, sigma=st.none() | FINITE, unit=NAMES), max_size=3
    ).map(tuple),
)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(measurements=st.lists(MEASUREMENT, max_size=3))
def test_what_is_saved_comes_back(tmp_path: Path, measurements: list[NamedMeasurement]) -> None:
    kept = SavedMeasurements(tmp_path)
    for old in kept.all:  # of the example before
        kept.remove(old)
    assert read_measurements(tmp_path) == []
    for measurement in measurements:
        kept.put(measurement)
    assert read_measurements(tmp_path) == measurements == list(kept.all)
    if not measurements:
        return
    document = json.loads((tmp_path / MEASUREMENTS).read_text("utf-8"))
    for feature, measurement in zip(document["features"], measurements, strict=True):
        assert feature["properties"]["name"] == measurement.name
        assert feature["geometry"]["type"] in ("Point", "LineString", "Polygon")
    for kind, file in TABLES.items():
        own = [each for each in measurements if each.kind == kind]
        assert (tmp_path / file).exists() == bool(own)
        if own:
            with (tmp_path / file).open(encoding="utf-8", newline="") as handle:
                rows = list(csv.DictReader(handle))
            assert len(rows) == len(own)
            for row, each in zip(rows, own, strict=True):
                shape = shapely.from_wkt(row["wkt"])
                places = shapely.get_coordinates(shape, include_z=True)[: len(each.points)]
                np.testing.assert_allclose(places, [point.xyz for point in each.points], rtol=1e-7, atol=1e-4)
    layers = [layer for layer, _ in pyogrio.list_layers(tmp_path / PACKAGE)]
    assert set(layers) == {TABLES[each.kind].removesuffix(".csv") for each in measurements}
    assert sum(pyogrio.read_info(tmp_path / PACKAGE, layer)["features"] for layer in layers) == len(measurements)


def test_without_a_file_nothing_is_saved(tmp_path: Path) -> None:
    assert read_measurements(tmp_path) == []


@pytest.mark.parametrize(
    ("text", "code", "field"),
    [
        ("no json", "not-measurements", None),
        ("[]", "not-measurements", None),
        ('{"features": [{"properties": {}}]}', "not-measurements", None),
        (
            '{"features": [{"properties": {"georef": {"name": "a"}}}]}',
            "measurement-invalid",
            "features[0].properties.georef.kind",
        ),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, code: str, field: str | None) -> None:
    (tmp_path / MEASUREMENTS).write_text(text, "utf-8")
    with refused(code, InputError) as caught:
        read_measurements(tmp_path)
    assert caught.value.field == field
    assert str(tmp_path / MEASUREMENTS) in str(caught.value)


def measurement(name: str) -> NamedMeasurement:
    return NamedMeasurement(
        name=name, kind="point", crs="C", model="m", points=(saved_point((1, 2, 3), (1, 2, 3), None),)
    )


def names(folder: Path) -> list[str]:
    return [each.name for each in read_measurements(folder)]


def test_two_viewers_keep_what_the_other_saves(tmp_path: Path) -> None:
    one, two = SavedMeasurements(tmp_path), SavedMeasurements(tmp_path)
    first, second, third = map(measurement, ("first", "second", "third"))
    one.put(first)
    two.put(second)
    one.put(third)
    assert names(tmp_path) == ["first", "second", "third"] == [each.name for each in one.all]
    two.remove(first)
    two.remove(first)  # somebody else was faster
    assert names(tmp_path) == ["second", "third"]
    one.put(first, row=0)  # undone
    one.put(first.model_copy(update={"name": "again"}))
    assert names(tmp_path) == ["again", "second", "third"]
    # A file that somebody damages meanwhile stays as it is, and so does what the viewer has.
    (tmp_path / MEASUREMENTS).write_text("{", "utf-8")
    with refused("not-measurements", InputError):
        one.put(measurement("fourth"))
    assert ((tmp_path / MEASUREMENTS).read_text("utf-8"), len(one.all)) == ("{", 3)


def test_kinds_are_those_of_the_page() -> None:
    page = (Path(saved.__file__).parent / "page" / "measure.js").read_text("utf-8")
    assert all(f"{kind}: [" in page for kind in Kind.__args__)


DEEP = "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize(
    "text",
    [f'{{"features": {DEEP}}}', DEEP, f'{{"features": [{{"properties": {{"georef": {DEEP}}}}}]}}', "{" * 9999],
)
def test_deep_brackets_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / MEASUREMENTS).write_text(text, "utf-8")
    with refused("not-measurements", InputError):
        SavedMeasurements(tmp_path)


def located(name: str, *quantities: str, kind: Kind = "point", lla=(46.0, 7.0, 1.0), points: int = 1):
    places = tuple(saved_point((k, 2 * k * k, 3), lla, None) for k in range(points))
    made = tuple(Quantity(name=each, value=1.5, sigma=0.1, unit="m") for each in quantities)
    return NamedMeasurement(name=name, kind=kind, crs="C", model="m", points=places, quantities=made)


@pytest.mark.parametrize(
    "quantity", ["fid", "FID", "geom", "Geom", "NAME", "name", "kind", "Kind", "georef", "a\0b"]
)
def test_quantities_with_names_of_columns(tmp_path: Path, quantity: str) -> None:
    saved = SavedMeasurements(tmp_path)
    for each in (located(quantity), located("wall", quantity, quantity.upper()), located("later", "length")):
        saved.put(each)
    assert names(tmp_path) == [quantity, "wall", "later"]
    meta, _, _, values = pyogrio.raw.read(tmp_path / PACKAGE, layer="points")
    at = list(meta["fields"]).index("name")
    assert list(values[at])[1:] == ["wall", "later"]
    assert any(np.asarray(column)[1] == 1.5 for column in values if np.asarray(column).dtype.kind == "f")


@pytest.mark.parametrize("kind", ["point", "distance", "area", "profile"])
def test_measurements_in_a_local_frame(tmp_path: Path, kind: Kind) -> None:
    """Without a place on Earth they have no geometry in longitude and latitude, and are saved once a press."""
    saved = SavedMeasurements(tmp_path)
    saved.put(located("first", "length", kind=kind, lla=None, points=4))
    saved.put(located("second", "length", kind=kind, lla=None, points=4))
    assert names(tmp_path) == ["first", "second"]
    saved.put(located("on Earth", "length", kind=kind, points=4))
    _, _, shapes, _ = pyogrio.raw.read(tmp_path / PACKAGE, layer=TABLES[kind].removesuffix(".csv"))
    assert [shape is None for shape in shapes] == [True, True, False]


@pytest.mark.filterwarnings("error")
def test_shapes_of_several_kinds_are_one_layer(tmp_path: Path) -> None:
    """An area of two points is a line."""
    saved = SavedMeasurements(tmp_path)
    for count in (1, 2, 4):
        places = tuple(saved_point((k, k, 0), (46 + k * k * 1e-5, 7 + k * 1e-5, 0.0), None) for k in range(count))
        saved.put(located(f"{count}", kind="area").model_copy(update={"points": places}))
    _, _, shapes, _ = pyogrio.raw.read(tmp_path / PACKAGE, layer="areas")
    assert [shapely.from_wkb(shape).geom_type for shape in shapes] == ["Point", "LineString", "Polygon"]
