"""The provider of Processing in examples/qgis, in QGIS without windows; `georef` is a program that hands out files.

What needs QGIS is run by `.ci/run qgis`, which says so where it is missing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from pipelines.formats.vector_files import ContourLine, write_contours_gpkg, write_polygons_gpkg
from tests.qgis.qgis_python import qgis_python

REPOSITORY = Path(__file__).parents[2]
PLUGINS = REPOSITORY / "examples/qgis"
EAST, NORTH, CELL = 403_200.0, 5_097_100.0, 0.5
WKT = rasterio.CRS.from_epsg(32632).to_wkt()
ACCURACY = {"kind": "measured", "rmse_h_m": 0.049, "rmse_v_m": 0.133}

pytestmark = pytest.mark.qgis

# Stands for georef: writes down its words, tells messages, and prints its result.
PROGRAM = """#!{python}
import json, sys, time
from pathlib import Path
words = sys.argv[1:]
with Path({words!r}).open("a", encoding="utf-8") as file:
    file.write(json.dumps(words) + "\\n")
def tell(kind, **content):
    print(json.dumps({{"kind": kind, **content}}), file=sys.stderr, flush=True)
tell("begin", name="stages", total=2)
tell("log", name="pipelines", level=30, text="the datum of the heights is assumed")
tell("advance", steps=1, note="half", left_s=None)
if "broken" in words[2]:
    tell("error", error_kind="input", text="error: broken: no survey [WS]")
    sys.exit(1)
tell("end")
print({result!r})
"""


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with rasters and change, and beside it the program."""
    folder = tmp_path_factory.mktemp("qgis")
    workspace = folder / "work space; $(touch shell)"
    for name in ("raster", "change"):
        (workspace / name).mkdir(parents=True)
    ramp = np.linspace(0.0, 1.0, 400, dtype=np.float32).reshape(20, 20)
    write(workspace / "raster/orthophoto.tif", np.stack([255 * ramp] * 4).astype(np.uint8))
    for name, values in (
        ("dsm", 1600 + 40 * ramp),
        ("dtm", 1600 + 9 * ramp),
        ("sigma_h", ramp),
        ("sigma_v", 2 * ramp),
    ):
        write(workspace / f"raster/{name}.tif", values[None])
    hole = {"type": "Polygon", "coordinates": [[[7.75, 46.02], [7.751, 46.02], [7.751, 46.021], [7.75, 46.02]]]}
    hole_text = json.dumps({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": hole}]})
    (workspace / "raster/interpolated.geojson").write_text(hole_text, encoding="utf-8")
    ends = np.array([[EAST, NORTH - 5], [EAST + 9, NORTH - 5]])
    lines = [ContourLine(height, ends, is_major=height == 1605.0) for height in (1604.0, 1605.0, 1606.0)]
    write_contours_gpkg(workspace / "raster/contours.gpkg", lines, WKT)
    write(workspace / "change/difference.tif", (ramp - 0.5)[None])
    write(workspace / "change/sigma.tif", 0.1 * ramp[None])
    write(workspace / "change/significant.tif", (1 + 2.99 * ramp).astype(np.uint8)[None])
    shapes = [shapely.box(EAST + at, NORTH - 4, EAST + at + 3, NORTH) for at in (0, 5)]
    rows = [{"name": name, "net_m3": volume} for name, volume in (("R1", -12.0), ("R2", 7.5))]
    write_polygons_gpkg(workspace / "change/regions.gpkg", {"regions": (shapes, rows)}, WKT)
    return workspace


def write(path: Path, bands: np.ndarray[Any, Any]) -> None:
    """Write a raster in UTM zone 32 north."""
    form = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2], "dtype": bands.dtype.name}
    place = {"crs": "EPSG:32632", "transform": from_origin(EAST, NORTH, CELL, CELL)}
    with rasterio.open(path, "w", driver="GTiff", **form, **place) as file:
        file.write(bands)


@pytest.fixture(scope="module")
def done(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What QGIS says of each algorithm, and the words of each call."""
    folder = tmp_path_factory.mktemp("calls")
    photos = folder / "photos"
    photos.mkdir()
    outline = {"type": "Polygon", "coordinates": [[[7.7, 46.0], [7.8, 46.0], [7.8, 46.1], [7.7, 46.0]]]}
    info = {
        "type": "Feature",
        "geometry": outline,
        "properties": {"area_ha": 0.5, "quality": {"accuracy": ACCURACY}},
    }
    program = folder / "georef"
    text = PROGRAM.format(python=sys.executable, words=str(folder / "words"), result=json.dumps(info))
    program.write_text(text, encoding="utf-8")
    program.chmod(0o755)
    stable = folder / "stable.geojson"
    stable.write_text(json.dumps({**info, "properties": {}}), encoding="utf-8")
    (survey.parent / "broken").mkdir()
    workspace = str(survey)
    calls = {
        "run": {"PHOTOS": str(photos), "WORKSPACE": workspace, "PRESET": 1, "BOUNDARY": str(stable)},
        "exportraster": {"WORKSPACE": workspace, "CRS": "EPSG:25832", "CONTOURS": 1.0, "CONTOURS_OF": 1},
        "change": {"EARLIER": workspace, "LATER": workspace, "OF": 1, "STABLE": str(stable)},
        "info": {"WORKSPACE": workspace, "AREA": str(folder / "area.geojson")},
        "info of nothing": {"WORKSPACE": str(survey.parent / "broken"), "AREA": str(folder / "none.geojson")},
    }
    listed = [(f"georef:{name.partition(' ')[0]}", values) for name, values in calls.items()]
    (folder / "calls.json").write_text(json.dumps(listed), encoding="utf-8")
    home = folder / "home"
    home.mkdir(mode=0o700)
    environment = {**os.environ, "GEOREF": str(program), "QT_QPA_PLATFORM": "offscreen", "HOME": str(home)}
    # QGIS names layers after their files, unless these are temporary: those of a user are not.
    environment |= {"XDG_RUNTIME_DIR": str(home), "TMPDIR": str(home), "PYTHONPATH": ""}
    script = REPOSITORY / "tests/qgis/driver.py"
    command = [qgis_python(), str(script), str(PLUGINS), str(folder / "calls.json")]
    ran = subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 0, ran.stderr
    documents = dict(zip(calls, json.loads(ran.stdout.splitlines()[-1]), strict=True))
    words = [json.loads(line) for line in (folder / "words").read_text(encoding="utf-8").splitlines()]
    assert not list(folder.rglob("shell"))
    return {
        name: {**document, "words": call} for (name, document), call in zip(documents.items(), words, strict=True)
    }


def layers_of(document: dict[str, Any]) -> dict[str, Any]:
    assert "error" not in document, document
    assert all(layer["valid"] for layer in document["layers"])
    return {layer["name"]: layer for layer in document["layers"]}


def test_run_is_one_call_of_the_program(done: dict[str, Any], survey: Path) -> None:
    words = done["run"]["words"]
    assert words[:3] == ["--json-progress", "run", str(survey)] and words[-1] == "--json"
    assert {"--preset=fast", "--deliver=raster"} <= set(words)
    (boundary,) = (word for word in words if word.startswith("--boundary="))
    assert boundary.endswith(".gpkg")
    assert "the datum of the heights is assumed" in done["run"]["log"]
    assert 50.0 in done["run"]["progress"]
    assert done["run"]["results"]["DSM"] == str(survey / "raster/dsm.tif")


def test_rasters_arrive_styled(done: dict[str, Any]) -> None:
    words = done["exportraster"]["words"]
    assert {"export-raster", "--crs=EPSG:25832", "--contours=1.0", "--contours-of=surface"} <= set(words)
    layers = layers_of(done["exportraster"])
    order = [
        "Contour lines",
        "Interpolated",
        "Vertical σ",
        "Horizontal σ",
        "Terrain model",
        "Surface model",
        "Orthophoto",
    ]
    assert list(layers) == order  # from the uppermost
    assert [name for name in order if layers[name]["shown"]] == ["Contour lines", "Interpolated", "Orthophoto"]
    assert layers["Orthophoto"]["renderer"] == "multibandcolor" and layers["Orthophoto"]["crs"] == "EPSG:32632"
    for name in ("Horizontal σ", "Vertical σ", "Surface model", "Terrain model"):
        assert layers[name]["renderer"] == "singlebandpseudocolor", name
    assert layers["Vertical σ"]["legend"][0] == "0"  # σ counts from zero: colours of two surveys can be compared
    hatched = layers["Interpolated"]
    assert hatched["symbols"][0]["style"] == "b_diagonal" and hatched["features"] == 1
    contours = layers["Contour lines"]
    assert contours["legend"] == ["major", "minor"] and contours["features"] == 3 and contours["labelled"]
    widths = [float(symbol["line_width"]) for symbol in contours["symbols"]]
    assert widths[0] > 2 * widths[1]


def test_change_arrives_styled(done: dict[str, Any], survey: Path) -> None:
    words = done["change"]["words"]
    assert words[1:4] == ["change", str(survey), str(survey)] and "--of=terrain" in words
    assert any(word.startswith("--stable=") for word in words)
    layers = layers_of(done["change"])
    ramp = [float(text) for text in layers["Later minus earlier height"]["legend"]]
    assert ramp[0] == -ramp[-1] and 0.0 in ramp  # white at no change
    assert layers["Significant change"]["legend"] == ["no significant change", "lowered", "raised", "doubtful"]
    assert layers["Regions of change"]["legend"] == ["raised", "lowered"]
    assert layers["Regions of change"]["features"] == 2


def test_info_is_an_outline(done: dict[str, Any]) -> None:
    layers = layers_of(done["info"])
    assert layers["Outline"]["features"] == 1 and layers["Outline"]["crs"] == "EPSG:4326"
    assert json.loads(done["info"]["results"]["ACCURACY"]) == ACCURACY


def test_an_error_of_the_program_is_that_of_the_algorithm(done: dict[str, Any]) -> None:
    failed = done["info of nothing"]
    assert failed["error"].endswith("broken: no survey [WS]") and not failed["layers"]
