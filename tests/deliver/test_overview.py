"""Overview of a result: its bounds against PROJ, its accuracy, and what was made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import NOT_CHECKED, Remark, load_json, save_json
from pipelines.core.stages import DELIVERABLES, DESCRIPTIONS, MODEL, SPLAT, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.deliver.overview import overview
from pipelines.geodesy.enu import ecef_from_enu
from pipelines.geodesy.vertical import VerticalDatum, parse_vertical
from pipelines.survey.options import CrsOptions
from pipelines.survey.report import AccuracySummary
from pipelines.survey.survey import Survey
from tests.reports import report_with
from tests.scenes import TrueScene
from tests.trained_workspaces import trained_workspace


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrueScene, Workspace]:
    return trained_workspace(tmp_path_factory.mktemp("flight"))


@pytest.fixture
def copied(tmp_path: Path) -> Workspace:
    return trained_workspace(tmp_path / "ws")[1]


def ecef(scene: TrueScene, workspace: Workspace) -> np.ndarray:
    return ecef_from_enu(scene.point_in_geo, load_json(Survey, workspace.path(SURVEY)).origin)


def test_bounds_are_those_of_the_points_in_the_coordinates_of_proj(made: tuple[TrueScene, Workspace]) -> None:
    scene, workspace = made
    bounds = overview(workspace, CrsOptions(crs="EPSG:2056")).bounds
    geographic = bounds.on_earth
    assert geographic is not None
    from_ecef = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, height = from_ecef.transform(*ecef(scene, workspace).T)
    # Float32 means of a frame 100 m away: 1e-5 m, or 1e-10°.
    expected = np.quantile(np.column_stack([lon, lat]), [0.01, 0.99], axis=0)
    np.testing.assert_allclose(
        [[geographic.west, geographic.south], [geographic.east, geographic.north]], expected, atol=1e-9
    )
    np.testing.assert_allclose(geographic.height_m, np.quantile(height, [0.01, 0.99]), atol=1e-4)
    swiss = Transformer.from_crs("EPSG:4326", "EPSG:2056", always_xy=True).transform(lon, lat)
    np.testing.assert_allclose(bounds.low[:2], np.quantile(swiss, 0.01, axis=1), atol=1e-2)
    np.testing.assert_allclose(bounds.high[:2], np.quantile(swiss, 0.99, axis=1), atol=1e-2)
    assert bounds.crs == "EPSG:2056"


def test_without_a_crs_the_zone_of_the_scene_is_said(made: tuple[TrueScene, Workspace]) -> None:
    result = overview(made[1], CrsOptions())
    assert (result.bounds.crs, result.bounds.heights) == ("EPSG:32632", "ellipsoidal")
    assert "EPSG:32632" in result.bounds.assumed[0]
    assert result.gaussians == 80
    assert result.center_lla is not None
    assert result.center_lla[:2] == pytest.approx((46.0, 7.75), abs=1e-3)


def test_geoid_without_its_grid_gives_way_only_where_nobody_asked_for_it(copied: Workspace) -> None:
    survey = load_json(Survey, copied.path(SURVEY))
    datum = VerticalDatum(name="EGM2008", stated=True)
    save_json(survey.model_copy(update={"vertical": datum}), copied.path(SURVEY))
    bounds = overview(copied, CrsOptions()).bounds
    assert bounds.heights == "ellipsoidal"
    assert "EGM2008 is not installed" in bounds.assumed[-1]
    with pytest.raises(InputError, match="not installed"):
        overview(copied, CrsOptions(vertical=parse_vertical("EGM2008")))
    with pytest.raises(InputError, match="far outside"):
        overview(copied, CrsOptions(crs="EPSG:28992"))


def test_accuracy_is_that_of_the_evaluation_and_unknown_where_nothing_checks_it(copied: Workspace) -> None:
    before = overview(copied, CrsOptions()).accuracy
    assert before is not None and before.kind == "predicted"  # by the adjustment: not evaluated
    scene = AccuracySummary(cells=4, rms_sigma_h_m=0.03, rms_sigma_v_m=0.04, reason=None)
    unchecked = Remark(code=NOT_CHECKED, sentence="Nothing checks the positions.")
    for cautions, kind in (((), "predicted"), ((unchecked,), "unknown")):
        save_json(report_with(scene=scene, cautions=cautions), copied.root / "evaluate/report.json")
        accuracy = overview(copied, CrsOptions()).accuracy
        assert accuracy is not None
        assert accuracy.kind == kind
        assert (accuracy.rmse_h_m is None) == (kind == "unknown")


def test_untrained_workspace_says_what_to_run(copied: Workspace) -> None:
    copied.path(MODEL).unlink()
    with pytest.raises(MissingProductError, match=f"georef train {copied.root}"):
        overview(copied, CrsOptions())


def test_every_file_that_is_handed_over_has_its_description() -> None:
    handed_over = [SPLAT, *(product for spec in DELIVERABLES for product in (spec.product, *spec.also))]
    assert [product for product in handed_over if product not in DESCRIPTIONS] == []


def test_feature_is_the_rectangle_with_all_the_rest(copied: Workspace) -> None:
    (copied.root / "cameras/colmap").mkdir(parents=True)
    (copied.root / "cameras/colmap/cameras.bin").write_bytes(bytes(1500))
    result = overview(copied, CrsOptions())
    document = result.feature()
    bounds = result.bounds.on_earth
    assert bounds is not None
    assert document["bbox"] == [bounds.west, bounds.south, bounds.east, bounds.north]
    ring = np.array(document["geometry"]["coordinates"][0])
    assert ring.min(axis=0) == pytest.approx([bounds.west, bounds.south], abs=1e-8)
    files = {file["path"]: file["bytes"] for file in document["properties"]["files"]}
    assert files == {"cameras/colmap": 1500}
    assert f"georef export-cameras {copied.root}" in document["properties"]["further"]


def test_rectangle_across_the_date_line_has_two_parts(made: tuple[TrueScene, Workspace]) -> None:
    result = overview(made[1], CrsOptions())
    assert result.bounds.on_earth is not None
    on_earth = replace(result.bounds.on_earth, west=179.9, east=-179.8)
    across = replace(result, bounds=replace(result.bounds, on_earth=on_earth))
    geometry = across.feature()["geometry"]
    assert geometry is not None
    assert geometry["type"] == "MultiPolygon"
