"""Deliverables of a survey without a place on Earth: in its local metric frame, and none of them claims a place."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio

from pipelines.core.errors import InputError
from pipelines.core.products import load_json, save_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.deliver.options import ExportPlyOptions
from pipelines.deliver.overview import overview
from pipelines.formats.cloud_ply import CloudPoints
from pipelines.formats.georef_sidecar import CrsSidecar, GeorefSidecar, sidecar_path
from pipelines.formats.geotiff import Band, RasterFrame, RasterKind, write_mosaic, write_part
from pipelines.formats.las import LazWriter
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.survey.options import CrsOptions
from pipelines.survey.survey import KnownDistance, PointMarks, Survey
from pipelines.survey.target_crs import target_crs
from tests.refusals import refused
from tests.trained_workspaces import trained_workspace, write_adjustment

LOCAL = VerticalDatum(name="local frame", stated=True)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Return a trained workspace whose survey has three distances, and neither positions nor ground points."""
    _, workspace = trained_workspace(tmp_path_factory.mktemp("local"))
    survey = load_json(Survey, workspace.path(SURVEY))
    ends = [PointMarks(name=point.name, marks=point.marks) for point in survey.control_points]
    place = [np.array(point.position_in_geo) for point in survey.control_points]
    distances = tuple(
        KnownDistance(
            ends=(ends[k], ends[k + 1]), distance_m=float(np.linalg.norm(place[k] - place[k + 1])), sigma_m=0.02
        )
        for k in range(3)
    )
    update = {
        "origin": None,
        "vertical": LOCAL,
        "images": tuple(image.model_copy(update={"fix": None, "attitude": None}) for image in survey.images),
        "sessions": (),
        "control_points": (),
        "distances": distances,
    }
    save_json(survey.model_copy(update=update), workspace.root / SURVEY)
    write_adjustment(workspace)
    return workspace


@pytest.fixture
def workspace(made: Workspace, tmp_path: Path) -> Workspace:
    shutil.copytree(made.root, tmp_path / "ws")
    return Workspace(tmp_path / "ws")


def test_the_splat_is_in_the_local_frame_and_states_no_place(workspace: Workspace) -> None:
    run_stage(workspace, BY_NAME["export-ply"], {"min_opacity": ExportPlyOptions().min_opacity})
    path = workspace.root / "export/splat.ply"
    sidecar = load_json(GeorefSidecar, sidecar_path(path))
    assert (sidecar.crs_id, sidecar.origin_lla, sidecar.matrix, sidecar.crs_wkt) == (None, None, None, "")
    assert (sidecar.origin, sidecar.rotation) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert sidecar.georeference_sigma is None
    with refused("not-on-earth", InputError):
        sidecar.ecef_from_file()
    metadata = path.with_name("splat.ply.iso.xml").read_text("utf-8")
    assert "EX_GeographicBoundingBox" not in metadata and "not on Earth" in metadata
    document = json.loads(sidecar_path(path).read_text("utf-8"))
    document["originLla"] = [46.0, 7.0, 0.0]
    sidecar_path(path).write_text(json.dumps(document), "utf-8")
    with pytest.raises(InputError):
        load_json(GeorefSidecar, sidecar_path(path))


def test_cameras_have_local_coordinates_and_no_footprints_on_a_map(workspace: Workspace) -> None:
    run_stage(workspace, BY_NAME["export-cameras"], {})
    folder = workspace.root / "cameras"
    sidecar = load_json(CrsSidecar, sidecar_path(folder / "cameras.csv"))
    assert (sidecar.crs, sidecar.crs_wkt) == ("local metric frame, not on Earth", "")
    assert json.loads((folder / "footprints.geojson").read_text("utf-8"))["features"] == []
    rows = (folder / "cameras.csv").read_text("utf-8").splitlines()
    assert rows[0].split(",")[2:5] == ["x", "y", "z"] and max(map(float, rows[1].split(",")[2:5])) < 1000


def test_what_needs_a_place_on_earth_is_refused(workspace: Workspace) -> None:
    with refused("not-on-earth", InputError) as caught:
        run_stage(workspace, BY_NAME["export-tiles"], {})
    assert "export-ply" in str(caught.value)
    with refused("not-on-earth", InputError):
        run_stage(workspace, BY_NAME["export-cameras"], {"crs": "EPSG:32632"})
    with refused("not-on-earth", InputError):
        target_crs(CrsOptions(crs="EPSG:32632"), None, np.zeros((1, 3)), LOCAL)
    with refused("not-on-earth", InputError):
        _ = load_json(Survey, workspace.path(SURVEY)).origin_on_earth


def test_the_overview_has_no_place(workspace: Workspace) -> None:
    result = overview(workspace, CrsOptions())
    assert result.center_lla is None and result.bounds.on_earth is None
    assert result.bounds.crs == "local metric frame, not on Earth"
    assert result.feature()["geometry"] is None


def test_coordinates_are_those_of_the_frame() -> None:
    target = target_crs(CrsOptions(), None, np.zeros((1, 3)), LOCAL)
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(target.xyz_from_geo(points), points)
    np.testing.assert_array_equal(target.geo_from_xyz(points), points)
    assert (target.crs.wkt, target.crs.wkt1, target.crs.units) == ("", "", ("metre",) * 3)
    assert target.axes == ("x", "y") and target.horizontal_unit_m == 1.0
    sidecar = target.sidecar([points.min(axis=0), points.max(axis=0)], None, None, ())
    assert sidecar.operation.startswith("none") and sidecar.crs_wkt == ""


def test_clouds_and_rasters_carry_no_crs(tmp_path: Path) -> None:
    laz, cov = tmp_path / "a.laz", np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
    points = CloudPoints(
        np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
        np.tile(np.array([0, 0, 1], np.float32), (2, 1)),
        np.zeros((2, 3), np.uint8),
        cov,
        np.zeros(2, np.uint8),
    )
    with LazWriter(laz, wkt1="", angular=False, near=np.zeros(3), software="test") as writer:
        writer.write(points)
    with laspy.open(laz) as file:
        assert file.header.parse_crs() is None and file.header.point_count == 2
    frame = RasterFrame("", -1.0, 2.0, 0.5, 0.5, 4, 3)
    kind = RasterKind("float32", (Band("height", "metre"),))
    write_part(tmp_path / "part.tif", np.ones((1, 3, 4), np.float32), frame)
    write_mosaic(tmp_path / "a.tif", [(tmp_path / "part.tif", 0, 0)], frame, kind, {})
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs is None and raster.bounds.left == -1.0
