"""Area of interest of a trained model: what its views measure, the same for every product."""

from __future__ import annotations

import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
import shapely
import torch
from plyfile import PlyData

from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, REPORT
from pipelines.core.workspace import Workspace
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import read_gaussians, write_gaussians
from pipelines.surface import measured_area
from pipelines.surface.measured_area import area_of
from pipelines.survey.area import Area
from pipelines.survey.measured_ground import MeasuredGround
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions, FilledAreaOptions
from pipelines.survey.report import read_report
from pipelines.survey.solution import Solution, read_sfm, read_solution
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import target_crs
from tests.deliver.raster.test_raster import GEO_FROM_MODEL, GSD, UTM, write_trained
from tests.refusals import logged_codes

LAKE, POND = shapely.Point(-7.5, 5.0).buffer(3.0), shapely.Point(8.0, -7.0).buffer(0.5)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A model that lacks the surface in a lake of 6 m and in a pond of 1 m."""
    made = write_trained(tmp_path_factory.mktemp("area") / "ws")
    gaussians = read_gaussians(made.path(GAUSSIANS))
    east, north, _ = GEO_FROM_MODEL.apply(gaussians.means.numpy()).T
    wet = shapely.contains_xy(LAKE, east, north) | shapely.contains_xy(POND, east, north)
    write_gaussians(made.path(GAUSSIANS), gaussians.select(torch.from_numpy(~wet)))
    return made


def _solved(workspace: Workspace) -> tuple[Workspace, Solution, SparseModel, Survey]:
    solution = read_solution(workspace)
    return workspace, solution, read_sfm(workspace, solution), load_survey(workspace)


def area(workspace: Workspace, fill: float | str | None = None) -> Area:
    options = FilledAreaOptions.model_validate({"fill": fill})
    return area_of(options, *_solved(workspace))


def test_area_is_what_the_views_measure(workspace: Workspace) -> None:
    found, seen = area(workspace), area(workspace, "all")
    assert found.polygon.contains(POND)
    assert not found.polygon.intersects(LAKE.buffer(-1.0))  # to a cell or two at its shore
    lost = seen.polygon.difference(found.polygon)
    assert lost.intersection(LAKE).area > 0.8 * LAKE.area
    # The rim, where the rays of three views meet at small angles, and the shore, to a cell.
    assert lost.area < LAKE.area + 0.08 * seen.polygon.area
    assert found.measured is not None
    assert seen.measured is not None
    assert found.measured > 0.95
    assert seen.measured == pytest.approx(1 - LAKE.area / seen.polygon.area, abs=0.08)


def test_painted_ground_is_no_part_of_the_area(workspace: Workspace, tmp_path: Path) -> None:
    """The model has ground in the lake, plain, where the photographs show a pattern: nothing measures it."""
    painted = Workspace(shutil.copytree(workspace.root, tmp_path / "ws"))
    whole = write_trained(tmp_path / "whole")
    gaussians = read_gaussians(whole.path(GAUSSIANS))
    east, north, _ = GEO_FROM_MODEL.apply(gaussians.means.numpy()).T
    gaussians.sh[torch.from_numpy(shapely.contains_xy(LAKE, east, north))] = 0.0
    write_gaussians(painted.path(GAUSSIANS), gaussians)
    squares = area(painted).polygon.intersection(LAKE).area / LAKE.area
    assert squares < 0.9  # the photographs' borders of squares are missing; within a square they are plain too
    assert area(whole).polygon.intersection(LAKE).area > 0.99 * LAKE.area


@pytest.mark.parametrize(("radius_m", "whole"), [(0.4, True), (4.0, False)])
def test_a_scrap_is_no_area(
    workspace: Workspace,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    radius_m: float,
    whole: bool,
) -> None:
    """A hundredth of the ground by chance, as after a training of a few steps, is not what a user wants to see."""
    seen = area(workspace, "all")
    ground = measured_area.measured_ground(*_solved(workspace))
    rows, columns = np.indices(ground.measured.shape)
    middle = shapely.centroid(seen.polygon)
    place = ground.corner + ground.size_m[0] * np.stack([columns, rows], axis=-1)
    near = np.linalg.norm(place - [middle.x, middle.y], axis=-1) < radius_m
    few = MeasuredGround(near, ground.corner, ground.size_m)
    monkeypatch.setattr(measured_area, "measured_ground", lambda *_: few)
    found = area(workspace)
    assert (found.polygon.area == seen.polygon.area) == whole
    assert ("hardly-measured" in logged_codes(caplog)) == whole


def test_area_is_found_once(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    first = area(workspace)
    monkeypatch.setattr("pipelines.surface.measured_area.measured_by", None)
    assert area(workspace).polygon.equals(first.polygon)


@pytest.mark.slow
def test_every_product_ends_at_the_same_area(workspace: Workspace) -> None:
    """Rasters, cloud, mesh, the splat's crop and the report: nothing in the lake, and one figure of hectares."""
    made = {
        "evaluate": {"renders": 0},
        "export-raster": {"crs": UTM, "gsd": GSD, "terrain": False, "hillshade": False, "colours": "splat"},
        "export-cloud": {"crs": UTM, "terrain": False},
        "export-mesh": {"crs": UTM},
        "export-ply": {"crop": True},
    }
    values = {name: run_stage(workspace, BY_NAME[name], options).manifest.values for name, options in made.items()}
    found, survey = area(workspace), load_survey(workspace)
    target = target_crs(CrsOptions(crs=UTM), survey.origin, np.zeros((1, 3)), survey.vertical)
    polygon = found.in_crs(target)
    report = read_report(workspace.path(REPORT))
    assert report.area_ha == pytest.approx(found.hectares)
    assert report.area_measured == pytest.approx(found.measured)
    for name in ("export-raster", "export-cloud", "export-mesh"):
        assert values[name]["area_ha"] == pytest.approx(found.hectares)
    assert values["export-raster"]["measured"] > 0.9
    with rasterio.open(workspace.path("raster/measured.tif")) as raster:
        mask, place = raster.read(1), raster.transform
    row, column = np.nonzero(mask)
    east, north = place @ (column + 0.5, row + 0.5)
    assert shapely.contains_xy(polygon.buffer(1e-3), east, north).all()
    assert len(row) * GSD**2 == pytest.approx(polygon.area, rel=0.01)
    points = laspy.read(workspace.path("cloud/cloud.laz"))
    assert shapely.contains_xy(polygon.buffer(0.01), np.array(points.x), np.array(points.y)).all()
    mesh = PlyData.read(workspace.path("mesh/mesh_crs.ply"))["vertex"]
    assert shapely.contains_xy(polygon.buffer(0.01), mesh["x"], mesh["y"]).all()
    assert values["export-ply"]["left_out"] > 0
