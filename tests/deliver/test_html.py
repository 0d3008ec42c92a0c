"""The page in one file: its content is the truth on Earth, names stay text, and it fits into its limit."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.manifest import hash_file
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import GAUSSIANS, MODEL, SAVED_MEASUREMENTS, SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver import html
from pipelines.deliver.html import fitted, run
from pipelines.deliver.options import ExportHtmlOptions
from pipelines.deliver.pages import RENDERER
from pipelines.deliver.placement import ENU_FROM_Y_UP
from pipelines.formats.georef_sidecar import GeorefSidecar
from pipelines.formats.spz import decode_spz
from pipelines.geodesy.enu import ecef_from_enu
from pipelines.splat.gaussians import write_gaussians
from pipelines.splat.initialise import gaussians_of_size
from pipelines.survey.saved_measurements import NamedMeasurement, Quantity, SavedPoint
from pipelines.survey.survey import Survey
from pipelines.view.saved import SavedMeasurements
from tests.delivered_scenes import splat_arrays
from tests.refusals import refused
from tests.scenes import TrueScene
from tests.trained_workspaces import GEO_FROM_MODEL, trained_workspace

pytestmark = pytest.mark.usefixtures("one_thread")
HOSTILE = '</script><img src=x onerror="document.title=1">'
_SCENE = re.compile(r'<script type="application/json" id="scene">(.*?)</script>', re.DOTALL)
_SPLAT = re.compile(r'<script type="text/plain" id="splat">([A-Za-z0-9+/=]*)</script>')
_POLICY = re.compile(r'Content-Security-Policy" content="([^"]*)"')


def exported(workspace: Workspace, **options: Any) -> tuple[str, dict[str, Any], Any]:
    """Return page, its content and the summary of the stage."""
    out = workspace.root / "html.partial"
    out.mkdir(exist_ok=True)
    summary = run(StageRun(workspace, out), ExportHtmlOptions(**options))
    text = (out / "splat.html").read_text("utf-8")
    found = _SCENE.search(text)
    assert found is not None and summary.values["bytes"] == len(text.encode())
    return text, json.loads(found[1]), summary


def with_measurements(workspace: Workspace, *names: str, model: str) -> np.ndarray:
    """Save measurements of two known places in `geo` (2, 3), which are returned."""
    places = np.array([[10.0, -4.0, 3.0], [14.0, -1.0, 3.0]])
    points = tuple(
        SavedPoint(
            position_in_geo=tuple(place), cov_of_surface=((0.0,) * 3,) * 3, images=(), xyz=tuple(place),
            sigma_m=None, lla=None,
        )
        for place in places.tolist()
    )  # fmt: skip
    quantity = Quantity("distance", 5.0, 0.012, "m")
    for name in names:
        SavedMeasurements(workspace.root / Path(SAVED_MEASUREMENTS).parent).put(
            NamedMeasurement(
                name=name, kind="distance", crs="EPSG:32632", model=model, points=points, quantities=(quantity,)
            )
        )
    return places


def test_cameras_points_and_measurements_are_at_their_places_on_earth(tmp_path: Path) -> None:
    scene, workspace = trained_workspace(tmp_path / "ws")
    places = with_measurements(workspace, HOSTILE, model=hash_file(workspace.path(MODEL), {}))
    text, page, summary = exported(workspace)
    survey = load_json(Survey, workspace.path(SURVEY))
    ecef_from_page = GeorefSidecar.model_validate(page["georef"]).ecef_from_file()

    def ecef(rows: list[dict[str, Any]]) -> np.ndarray:
        return ecef_from_page.apply(np.array([row["at"] for row in rows]))

    # Four decimals of a metre, and the millimetres of float32 Gaussians do not enter.
    assert np.abs(ecef(page["cameras"]) - ecef_from_enu(scene.center_in_geo, survey.origin)).max() < 1e-4
    true_points = [point.position_in_geo for point in (*survey.control_points, *survey.check_points)]
    assert np.abs(ecef(page["points"]) - ecef_from_enu(true_points, survey.origin)).max() < 1e-4
    (measured,) = page["measurements"]
    assert (
        np.abs(ecef_from_page.apply(np.array(measured["at"])) - ecef_from_enu(places, survey.origin)).max() < 1e-4
    )
    assert measured["name"] == HOSTILE and measured["quantities"][0]["sigma"] == 0.012 and not measured["older"]
    assert HOSTILE not in text
    assert summary.values["cameras"] == len(scene.names) and summary.values["loss_psnr_db"] is None
    _check_views(scene, survey, page, ecef_from_page.rotation)


def _check_views(scene: TrueScene, survey: Survey, page: dict[str, Any], ecef_from_page: np.ndarray) -> None:
    """Cameras look along the true axes, and the two CRSs are those of the middle of the scene."""
    frame = ecef_from_enu(np.vstack([np.eye(3), np.zeros(3)]), survey.origin)
    ecef_from_geo = (frame[:3] - frame[3]).T
    for camera, geo_from_cam in zip(page["cameras"], scene.geo_from_cam, strict=True):
        axes = ecef_from_page @ np.array(camera["cam_from_page"]).T
        np.testing.assert_allclose(axes, ecef_from_geo @ geo_from_cam, atol=1e-6)
    lla, utm = page["crs"]
    assert [axis["name"] for axis in lla["axes"]] == ["lon", "lat", "h"] and utm["error_m"] < 1e-3
    facts = {fact["name"]: fact["value"] for fact in page["facts"]}
    assert {"Place", "CRS", "Accuracy", "Splat"} <= set(facts)


def test_measurements_of_another_training_say_so(tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    with_measurements(workspace, "wall", model="of an earlier model")
    assert exported(workspace)[1]["measurements"][0]["older"]


def test_page_runs_its_two_scripts_alone_and_names_no_address(tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    text, _, _ = exported(workspace)
    policy = _POLICY.search(text)
    assert policy is not None and "default-src &#x27;none&#x27;" in policy[1] and "http" not in policy[1]
    scripts = re.findall(r'<script(?: id="renderer")?>(.*?)</script>', text, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"sha256-{digest}" in policy[1].replace("&#x27;", "'")
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    for owner in ("three.js authors", "WORLD LABS", "Arjun Barrett"):  # licences of what the renderer is made of
        assert owner in scripts[0]
    assert RENDERER.stat().st_size < 1.2e6


def test_splat_is_upright_for_readers_of_spz(tmp_path: Path) -> None:
    scene, workspace = trained_workspace(tmp_path / "ws")
    text, page, _ = exported(workspace)
    spz = _SPLAT.search(text)
    assert spz is not None
    means = decode_spz(base64.b64decode(spz[1])).means @ ENU_FROM_Y_UP.T
    places = GeorefSidecar.model_validate(page["georef"]).ecef_from_file().apply(means)
    survey = load_json(Survey, workspace.path(SURVEY))
    assert np.abs(places - ecef_from_enu(scene.point_in_geo, survey.origin)).max() < 1e-3


def test_a_local_frame_has_a_page_without_coordinates_on_earth(tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    survey = load_json(Survey, workspace.path(SURVEY))
    save_json(survey.model_copy(update={"origin": None}), workspace.path(SURVEY))
    _, page, _ = exported(workspace)
    facts = {fact["name"]: fact["value"] for fact in page["facts"]}
    assert page["crs"] == [] and "local" in facts["Place"]


def test_a_large_splat_loses_harmonics_then_gaussians_and_says_so() -> None:
    """Each smaller limit loses more; the file fits, and the loss is that of the renders of what it holds."""
    whole, seen = splat_arrays(1500), []

    def measure(held: Any, of: Any) -> float:
        seen.append((len(held), held.sh.shape[1]))
        assert of is whole
        return 30.0

    full = fitted(whole, 10**7, measure)
    assert (full.count, full.degree, full.psnr_db) == (1500, 3, None) and not seen
    sizes = [len(full.spz) - 1, 34_000, 15_000, 5_600]
    held = [fitted(whole, size, measure) for size in sizes]
    assert all(len(one.spz) <= size for one, size in zip(held, sizes, strict=True))
    assert [one.degree for one in held] == sorted((one.degree for one in held), reverse=True)
    assert held[0].count == 1500 and held[0].degree < 3 and held[-1].count < 400 and held[-1].degree == 0
    assert seen == [(one.count, (one.degree + 1) ** 2) for one in held]
    assert all(str(number) in held[-1].sentence for number in (held[-1].count, 1500, 30.0))
    with refused("page-too-small", InputError):
        fitted(whole, 50, measure)


def test_the_page_of_a_reduced_splat_states_its_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Renders of the reduced splat against the whole: what was merged is near it, and not it."""
    scene, workspace = trained_workspace(tmp_path / "ws")
    means = GEO_FROM_MODEL.inverse().apply(scene.point_in_geo)
    colours = np.random.default_rng(0).uniform(0, 1, means.shape)
    write_gaussians(workspace.path(GAUSSIANS), gaussians_of_size(means, colours, np.full(len(means), 3.0)))
    limit = {}

    def tighter(whole: Any, most_bytes: int, psnr_db: Any, *, mip_filter: bool) -> Any:
        limit["held"] = fitted(whole, 500, psnr_db)
        return limit["held"]

    monkeypatch.setattr(html, "fitted", tighter)
    _, page, summary = exported(workspace)
    loss = summary.values["loss_psnr_db"]
    assert summary.values["gaussians_in_page"] < summary.values["gaussians"] and 5 < loss < 60
    (remark,) = summary.warnings
    assert remark.code == "splat-reduced" and f"{loss:.1f} dB" in remark.sentence
    assert f"{loss:.1f} dB" in next(fact["value"] for fact in page["facts"] if fact["name"] == "Splat")
    assert replace(limit["held"], psnr_db=None).sentence in remark.sentence
