"""Export: the PLY and its sidecar alone put every Gaussian where the survey put it, and show the same image."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.stages import GAUSSIANS, MODEL, SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver.options import ExportPlyOptions
from pipelines.deliver.placement import Placement, solved_placement
from pipelines.deliver.ply import run
from pipelines.deliver.splat import placed_splat
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, enu_from_ecef
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity, covariance_at
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.reference import render_reference
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import Survey
from tests.refusals import refused

OPTIONS = ExportPlyOptions()
# The scene lies 3 km from the survey's origin, where vertical and north have visibly turned.
GEO_FROM_MODEL = Similarity(1.3, exp_so3(np.array([0.4, -1.1, 2.0])), np.array([2500.0, -1800.0, 40.0]))
PIVOT_IN_GEO = np.array([2000.0, -2000.0, 0.0])


def gaussians(count: int = 40, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=dtype)

    return Gaussians(4 * normal(3), normal(4), 0.3 * normal(3) - 0.5, normal() + 1, 0.4 * normal(16, 3))


def covariance() -> np.ndarray:
    half = np.random.default_rng(0).normal(size=(7, 7)) * np.array([1e-5, 1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.02])
    return half.T @ half


def survey() -> Survey:
    return Survey(
        origin=Origin(lat_deg=50.8231, lon_deg=-0.1372, alt_m=55.0),
        source_crs="EPSG:4326",
        vertical=VerticalDatum(name="EGM2008", stated=True),
        image_dir="images",
        cameras=(),
        images=(),
    )


def model(cov: np.ndarray | None = None) -> TrainedModel:
    return TrainedModel(
        geo_from_model=GEO_FROM_MODEL.to_record("model", "geo", covariance=cov, pivot=PIVOT_IN_GEO),
        model_from_local=Similarity().to_record("local", "model"),
        max_image_size=600,
        cameras=(),
        background=(0.0, 0.0, 0.0),
        sh_degree=3,
        iterations=1,
        gaussians=40,
        backend="cpu",
    )


def placed(trained: TrainedModel) -> Placement:
    return solved_placement(trained, survey(), gaussians().means.numpy(), None)


@pytest.fixture
def stage(tmp_path: Path) -> StageRun:
    root = tmp_path / "ws"
    save_json(survey(), root / SURVEY)
    save_json(model(covariance()), root / MODEL)
    write_gaussians(root / GAUSSIANS, gaussians())
    out = root / "export.partial"
    out.mkdir()
    return StageRun(Workspace(root), out)


def test_files_alone_put_the_gaussians_on_earth(stage: StageRun) -> None:
    summary = run(stage, OPTIONS)
    ply, sidecar = stage.out / "splat.ply", load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))
    positions = sidecar.ecef_from_file().apply(read_gaussians(ply).means.numpy())
    expected = ecef_from_enu(GEO_FROM_MODEL.apply(gaussians().means.numpy()), survey().origin)
    # About 10 m from the origin, float32 resolves 1e-6 m.
    np.testing.assert_allclose(positions, expected, rtol=0, atol=2e-6)
    assert summary.values["gaussians"] == 40
    assert sorted(file.name for file in stage.out.iterdir()) == [
        "splat.ply",
        "splat.ply.georef.json",
        "splat.ply.iso.xml",
    ]


def test_frame_is_east_north_up_at_its_own_rounded_origin(stage: StageRun) -> None:
    run(stage, OPTIONS)
    sidecar = load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))
    lat, lon, alt = sidecar.origin_lla
    assert (round(lat, 6), round(lon, 6), round(alt, 1)) == (lat, lon, alt)
    np.testing.assert_array_equal(sidecar.origin, ecef_from_lla([lat, lon, alt]))
    place = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    transform = sidecar.ecef_from_file()
    np.testing.assert_allclose(enu_from_ecef(transform.apply(np.eye(3)), place), np.eye(3), atol=1e-8)
    means = read_gaussians(stage.out / "splat.ply").means.numpy()
    assert np.abs(np.median(means, axis=0)).max() < 0.2  # rounded to 1e-6° and 0.1 m


@pytest.mark.parametrize(
    ("up", "places"), [("y", [[1, 0, 0], [0, 0, 1], [0, -1, 0]]), ("-y", [[1, 0, 0], [0, 0, -1], [0, 1, 0]])]
)
def test_another_axis_points_up_and_every_gaussian_stays_in_its_place(
    stage: StageRun, up: str, places: list[list[int]]
) -> None:
    run(stage, ExportPlyOptions(up=up))
    ply, sidecar = stage.out / "splat.ply", load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))
    positions = sidecar.ecef_from_file().apply(read_gaussians(ply).means.numpy())
    expected = ecef_from_enu(GEO_FROM_MODEL.apply(gaussians().means.numpy()), survey().origin)
    np.testing.assert_allclose(positions, expected, rtol=0, atol=2e-6)
    lat, lon, alt = sidecar.origin_lla
    in_enu = enu_from_ecef(sidecar.ecef_from_file().apply(np.eye(3)), Origin(lat_deg=lat, lon_deg=lon, alt_m=alt))
    np.testing.assert_allclose(in_enu, places, atol=1e-8)  # of x, y and z of the file
    # σ stay those of east, north and up, while the covariance is along the file's axes.
    assert sidecar.georeference_sigma == placed(model(covariance())).sidecar().georeference_sigma
    assert sidecar.covariance is not None and sidecar.georeference_sigma is not None
    assert sidecar.georeference_sigma.sigma_v_m == pytest.approx(np.sqrt(sidecar.covariance[5][5]))


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_rendered_image_is_the_same_from_the_same_place(stage: StageRun, up: str) -> None:
    run(stage, ExportPlyOptions(up=up))
    camera = Pinhole(32, 24, 30.0, 30.0, 16.0, 12.0)
    settings = RasterSettings(sh_degree=3, background=(0.2, 0.3, 0.4), near_m=0.01)
    cam_from_model = np.eye(4)
    cam_from_model[:3, :3], cam_from_model[:3, 3] = exp_so3(np.array([0.2, 0.1, 0.0])), [0.5, -0.3, 12.0]
    before = render_reference(gaussians().detached(), torch.tensor(cam_from_model).float(), camera, settings)
    # The camera moves with the model; a camera's frame keeps its metres, so its distance grows with the scale.
    ecef_from_ply = load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply")).ecef_from_file()
    geo = survey().origin
    model_from_cam = Similarity(1.0, cam_from_model[:3, :3], cam_from_model[:3, 3]).inverse()
    ecef_from_geo = Similarity(1.0, _axes(geo), ecef_from_enu(np.zeros(3), geo))
    ply_from_model = ecef_from_ply.inverse() @ ecef_from_geo @ GEO_FROM_MODEL
    ply_from_cam = ply_from_model @ model_from_cam
    moved = Similarity(1.0, ply_from_cam.rotation, ply_from_cam.translation).inverse().matrix()
    exported_gaussians = read_gaussians(stage.out / "splat.ply")
    after = render_reference(exported_gaussians, torch.tensor(moved).float(), camera, settings)
    assert before.colour.std() > 0.1  # there is something to see
    torch.testing.assert_close(after.colour, before.colour, rtol=0, atol=2e-4)
    torch.testing.assert_close(after.alpha, before.alpha, rtol=0, atol=2e-4)


def _axes(origin: Origin) -> np.ndarray:
    return (ecef_from_enu(np.eye(3), origin) - ecef_from_enu(np.zeros(3), origin)).T


def test_covariance_predicts_the_same_uncertainty_in_the_new_frame() -> None:
    export = placed_splat(gaussians(), placed(model(covariance())), OPTIONS)
    points_in_model = np.array([[0.0, 0, 0], [30, -20, 5]])
    in_geo = covariance_at(GEO_FROM_MODEL.apply(points_in_model), covariance(), PIVOT_IN_GEO)
    to_ecef, turn = export.placement.sidecar().ecef_from_file(), _axes(survey().origin)
    points_in_ply = to_ecef.inverse().apply(ecef_from_enu(GEO_FROM_MODEL.apply(points_in_model), survey().origin))
    in_ply = covariance_at(points_in_ply, np.array(export.placement.sidecar().covariance), np.zeros(3))
    expected = turn @ in_geo @ turn.T
    np.testing.assert_allclose(to_ecef.rotation @ in_ply @ to_ecef.rotation.T, expected, rtol=1e-6, atol=1e-12)


def test_sigma_of_the_georeference_is_that_of_the_covariance_at_the_origin() -> None:
    sidecar = placed(model(covariance())).sidecar()
    sigma = sidecar.georeference_sigma
    assert sigma is not None
    east, north, up = np.sqrt(np.diagonal(np.array(sidecar.covariance))[4:])
    assert (sigma.sigma_e_m, sigma.sigma_n_m, sigma.sigma_u_m) == pytest.approx((east, north, up))
    assert sigma.sigma_h_m == pytest.approx(np.hypot(east, north))
    assert sigma.sigma_3d_m == pytest.approx(np.sqrt(east**2 + north**2 + up**2))


def test_unknown_uncertainty_is_null_and_not_zero() -> None:
    sidecar = placed(model()).sidecar()
    assert sidecar.covariance is None
    assert (sidecar.accuracy, sidecar.georeference_sigma) == (None, None)


def test_transparent_gaussians_are_left_out() -> None:
    start = gaussians()
    start.logit_opacities[:5] = -8.0
    export = placed_splat(start, placed(model()), OPTIONS)
    assert (len(export.gaussians), export.left_out) == (35, 5)
    start.logit_opacities[:] = -8.0
    with refused("no-opaque-gaussians", DegenerateGeometryError):
        placed_splat(start, placed(model()), OPTIONS)


def test_sidecar_has_the_fields_that_were_promised(stage: StageRun) -> None:
    run(stage, OPTIONS)
    document = json.loads(sidecar_path(stage.out / "splat.ply").read_text(encoding="utf-8"))
    place = "format version crsId origin rotation scale ecefFromFile epoch originLla verticalDatum crsWkt"
    assert list(document) == [*place.split(), "covariance", "accuracy", "georeferenceSigma", "cautions"]
    assert (document["format"], document["version"], document["crsId"]) == ("georefgs", 2, "EPSG:4978")
    assert document["crsWkt"].startswith("GEODCRS[")
    assert np.array(document["covariance"]).shape == (7, 7)
    datum = {"name": "EGM2008", "stated": True, "note": "", "by_definition": False}
    assert document["verticalDatum"] == datum


def test_matrix_is_the_similarity_of_the_sidecar(stage: StageRun) -> None:
    run(stage, OPTIONS)
    path, sidecar = (
        sidecar_path(stage.out / "splat.ply"),
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply")),
    )
    document = json.loads(path.read_text(encoding="utf-8"))
    matrix = np.array(document["ecefFromFile"])
    points = np.random.default_rng(0).uniform(-500, 500, (20, 3))
    expected = sidecar.scale * points @ sidecar.ecef_from_file().rotation.T + sidecar.origin
    # Coordinates of 6e6 m, summed in another order, differ by units in the last place.
    np.testing.assert_allclose((matrix @ np.column_stack([points, np.ones(20)]).T).T[:, :3], expected, atol=4e-9)
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    del document["ecefFromFile"]  # as it was before the matrix
    path.write_text(json.dumps(document), encoding="utf-8")
    assert load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply")) == sidecar
    matrix[0, 3] += 0.01
    path.write_text(json.dumps({**document, "ecefFromFile": matrix.tolist()}), encoding="utf-8")
    with pytest.raises(InputError, match="ecefFromFile"):
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))


def test_sidecar_carries_the_cautions_of_the_model_on(stage: StageRun) -> None:
    caution = Remark(code="fixes-shifted", sentence="All fixes are 1.2 m too high.")
    path = stage.workspace.root / MODEL
    save_json(model(covariance()).model_copy(update={"cautions": (caution,)}), path)
    assert (
        run(stage, OPTIONS).cautions
        == load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply")).cautions
        == (caution,)
    )
    for product in (path, sidecar_path(stage.out / "splat.ply")):  # as they were before cautions
        document = json.loads(product.read_text(encoding="utf-8"))
        del document["cautions"]
        product.write_text(json.dumps(document), encoding="utf-8")
    assert load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply")).cautions == ()
    assert run(stage, OPTIONS).cautions == ()


def test_damaged_sidecar_is_refused(stage: StageRun) -> None:
    run(stage, OPTIONS)
    path = sidecar_path(stage.out / "splat.ply")
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"scale": 1.0', '"scale": -1.0'), encoding="utf-8")
    with pytest.raises(InputError, match="scale"):
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))
    path.write_text(text.replace('"rotation": [', '"rotation": [\n  1.0,', 1), encoding="utf-8")
    with pytest.raises(InputError, match="rotation"):
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.ply"))
