"""Area of interest: files of boundaries in every form are the same ground; the default is what photographs see."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from ezdxf.filemanagement import new

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.formats.boundary_file import BOUNDARY_FORMATS
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.area import Area, boundary_area, scene_in_geo, seen_area
from pipelines.survey.options import BOUNDARY_SUFFIXES, AreaOptions, CrsOptions
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import target_crs
from tests.refusals import refused
from tests.scenes import (
    NOISELESS,
    Measured,
    TrueScene,
    looking_at,
    sparse_model,
    survey_of,
    trained_cameras,
    trained_model,
)

ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)
UTM = "EPSG:32632"
# A square of 80 m with a yard of 20 m in it.
OUTER = np.array([(-40.0, -40), (40, -40), (40, 40), (-40, 40)])
YARD = np.array([(-10.0, -10), (-10, 10), (10, 10), (10, -10)])
POINTS = np.column_stack([np.random.default_rng(0).uniform(-50, 50, (300, 2)), np.zeros(300)])


def in_crs(plan: np.ndarray, crs: str) -> np.ndarray:
    lla = lla_from_enu(np.column_stack([plan, np.zeros(len(plan))]), ORIGIN)
    return lla[:, [1, 0]] if crs == "EPSG:4326" else parse_crs(crs).xyz_from_lla(lla)[:, :2]


def written(folder: Path, suffix: str) -> Path:
    path = folder / f"boundary{suffix}"
    crs = "EPSG:4326" if suffix in (".geojson", ".json", ".kml") else UTM
    outer, yard = in_crs(OUTER, crs), in_crs(YARD, crs)
    if suffix == ".dxf":
        document = new("R2010")
        document.modelspace().add_lwpolyline(outer.tolist(), close=True)
        document.saveas(path)
        return path
    driver = {".gpkg": "GPKG", ".kml": "KML"}.get(suffix, "GeoJSON")
    geometry = np.array([shapely.to_wkb(shapely.Polygon(outer, [yard]))], dtype=object)
    target = path.with_suffix(".geojson") if suffix == ".json" else path
    pyogrio.raw.write(target, geometry, [], [], driver=driver, geometry_type="Polygon", crs=crs, layer="area")
    return target.rename(path) if target != path else path


@pytest.mark.parametrize("suffix", [".geojson", ".json", ".gpkg", ".kml", ".dxf"])
def test_a_boundary_is_the_same_ground_in_every_form(tmp_path: Path, suffix: str) -> None:
    """To a centimetre: degrees are written with seven decimals at least. A DXF has closed lines, without holes."""
    stated = {"boundary_crs": UTM} if suffix == ".dxf" else {}
    area = boundary_area(AreaOptions(boundary=written(tmp_path, suffix), **stated), POINTS, ORIGIN)
    assert area is not None
    expected = 0.64 if suffix == ".dxf" else 0.64 - 0.04
    assert area.hectares == pytest.approx(expected, rel=2e-4)
    np.testing.assert_allclose(area.polygon.bounds, (-40, -40, 40, 40), atol=0.01)
    places = np.array([(39.9, 0, 5), (40.1, 0, 5), (0, 0, 5), (30, -39.9, 5)])
    assert area.contains(places).tolist() == [True, False, suffix == ".dxf", True]


def test_suffixes_of_the_option_are_those_of_the_reader() -> None:
    assert frozenset(BOUNDARY_FORMATS) == BOUNDARY_SUFFIXES


VRT = "<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>/etc/passwd</SrcDataSource></OGRVRTLayer>"
POINT = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [7.75, 46.02]}}


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("a.kml", "<?xml version='1.0'?>" + VRT, "boundary-format"),
        ("a.geojson", VRT, "boundary-format"),
        ("a.txt", "{}", "boundary-format"),
        ("a.geojson", "{", "boundary-unreadable"),
        ("a.geojson", json.dumps({"type": "FeatureCollection", "features": [POINT]}), "boundary-without-area"),
        ("a.gpkg", "SQLite format 3\0" + "x" * 200, "boundary-unreadable"),
    ],
)
def test_what_is_no_boundary_is_refused(tmp_path: Path, name: str, content: str, code: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with refused(code, InputError) as error:
        boundary_area(AreaOptions(boundary=path), POINTS, ORIGIN)
    assert (error.value.path, error.value.field) == (path, "--boundary")


def test_a_boundary_states_a_crs_and_lies_at_the_survey(tmp_path: Path) -> None:
    with refused("boundary-without-crs", InputError):
        boundary_area(AreaOptions(boundary=written(tmp_path, ".dxf")), POINTS, ORIGIN)
    with refused("boundary-elsewhere", InputError):
        boundary_area(AreaOptions(boundary=written(tmp_path, ".gpkg")), np.add(POINTS, [500, 0, 0]), ORIGIN)


def solved(centers: np.ndarray) -> tuple[Solution, SparseModel, Survey]:
    """Return a solved survey of level ground that looks straight down, with a pixel of the same size everywhere."""
    rng = np.random.default_rng(1)
    scene = TrueScene(
        centers,
        looking_at(centers, centers * [1, 1, 0] + [0, 1e-3, 0]),
        np.column_stack([rng.uniform(-80, 80, (6000, 2)), np.zeros(6000)]),
        np.zeros((0, 3)),
        geo_from_local=Similarity(),
    )
    sparse = sparse_model(scene, NOISELESS, rng)
    poses = CameraPoses(sparse.rotation_cam_from_local, centers)
    model = trained_model(Similarity(), cameras=trained_cameras(scene.names, poses))
    return model, sparse, survey_of(scene, NOISELESS, Measured(), rng)


def test_default_is_the_ground_that_three_photographs_see() -> None:
    """Five photographs in a row, 12 m apart at 40 m: from the third to the third last frame there are three.

    A frame is 1200 × 900 px at a focal length of 1020: 47 × 35 m. The smoothing may round the corners.
    """
    centers = np.array([(east, 0.0, 40.0) for east in (-24, -12, 0, 12, 24)])
    solution, sfm, survey = solved(centers)
    area = seen_area(solution, sfm, scene_in_geo(solution, sfm))
    half = 40 * 600 / 1020, 40 * 450 / 1020
    expected = shapely.box(-half[0], -half[1], half[0], half[1])
    common = area.polygon.intersection(expected).area / area.polygon.union(expected).area
    assert area.polygon.geom_type == "Polygon"
    assert not area.polygon.interiors
    assert common > 0.9
    target = target_crs(CrsOptions(crs=UTM), survey.origin, POINTS, survey.vertical)
    # UTM's scale is 0.9997 here, and the survey lies 250 ppm above the ellipsoid.
    assert area.in_crs(target).area == pytest.approx(area.polygon.area, rel=1.5e-3)


def test_two_photographs_have_no_area() -> None:
    solution, sfm, _ = solved(np.array([(0.0, 0.0, 40.0), (5.0, 0.0, 40.0)]))
    with refused("no-common-ground", DegenerateGeometryError):
        seen_area(solution, sfm, scene_in_geo(solution, sfm))


def test_an_area_without_extent_contains_nothing() -> None:
    assert not Area(shapely.Polygon(), 0.0, "nothing").contains(POINTS).any()
