"""Trained cameras handed over: every file alone puts every photograph where the truth is."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pyproj import Proj, Transformer

from pipelines.core.errors import InputError
from pipelines.core.products import NOT_CHECKED, Remark, load_json, save_json
from pipelines.core.stages import MODEL, SPARSE, SURVEY
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver.cameras import run
from pipelines.deliver.options import ExportCamerasOptions
from pipelines.formats.cloud_ply import open_cloud_ply
from pipelines.formats.colmap import flatten, read_sparse, write_sparse
from pipelines.formats.georef_sidecar import CrsSidecar, GeorefSidecar, sidecar_path
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, enu_from_ecef, geo_from_enu_at, lla_from_enu
from pipelines.geometry.cameras import Camera, project
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.sfm.imported_model import import_model, import_poses
from pipelines.survey.photographs import covered_pinhole
from pipelines.survey.solution import SolvedLens, TrainedModel
from pipelines.survey.survey import Survey
from tests.oracles import map_from_cam
from tests.scenes import TrueScene
from tests.trained_workspaces import IMAGES, load_adjustment, scene_of, trained_workspace, untrained

pycolmap = pytest.importorskip("pycolmap")
pytestmark = pytest.mark.usefixtures("one_thread")


@dataclass(frozen=True)
class Handover:
    """True scene, workspace with its trained model, and what the stage made of it."""

    scene: TrueScene
    workspace: Workspace
    out: Path
    summary: Summary

    def rows(self) -> list[dict[str, str]]:
        with (self.out / "cameras.csv").open(encoding="utf-8") as handle:
            return list(csv.DictReader(handle))

    def columns(self, *names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in self.rows()])

    @property
    def origin(self) -> Origin:
        """Of the frame `geo`."""
        return survey_origin(self.workspace)

    @property
    def ecef(self) -> np.ndarray:
        """True centres, Earth-centred."""
        return ecef_from_enu(self.scene.center_in_geo, self.origin)


def survey_origin(workspace: Workspace) -> Origin:
    return load_json(Survey, workspace.path(SURVEY)).origin


def handed_over(workspace: Workspace, out: Path, **options: object) -> Summary:
    out.mkdir()
    return run(StageRun(workspace, out), ExportCamerasOptions(**options))


@pytest.fixture(scope="module")
def handover(tmp_path_factory: pytest.TempPathFactory) -> Handover:
    root = tmp_path_factory.mktemp("cameras")
    scene, workspace = trained_workspace(root / "ws")
    return Handover(scene, workspace, root / "out", handed_over(workspace, root / "out"))


def test_table_has_the_true_positions_in_the_utm_zone_of_the_scene(handover: Handover) -> None:
    from_ecef = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, alt = from_ecef.transform(*handover.ecef.T)
    easting, northing = Proj("EPSG:32632")(lon, lat)
    expected = np.column_stack([easting, northing, alt])
    np.testing.assert_allclose(handover.columns("x", "y", "z"), expected, atol=1e-4)  # four decimals
    assert [row["name"] for row in handover.rows()] == list(handover.scene.names)
    assert [row["split"] for row in handover.rows()].index("test") == 2
    sidecar = CrsSidecar.model_validate_json(sidecar_path(handover.out / "cameras.csv").read_text(encoding="utf-8"))
    assert (sidecar.crs, sidecar.vertical_datum.name) == ("EPSG:32632", "ellipsoidal")
    assert "UTM" in sidecar.assumed[0]


def test_angles_count_from_grid_north_by_the_convergence_of_the_projection(handover: Handover) -> None:
    origin = handover.origin
    lla = lla_from_enu(handover.scene.center_in_geo, origin)
    for index, angles in enumerate(handover.columns("omega_deg", "phi_deg", "kappa_deg")):
        convergence = np.radians(Proj("EPSG:32632").get_factors(lla[index, 1], lla[index, 0]).meridian_convergence)
        cos, sin = np.cos(convergence), np.sin(convergence)
        grid_from_enu = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        enu_from_cam = geo_from_enu_at(lla[index], origin).T @ handover.scene.geo_from_cam[index]
        np.testing.assert_allclose(map_from_cam(angles), grid_from_enu @ enu_from_cam, atol=1e-7)
        assert abs(np.degrees(convergence)) > 0.5  # the test would notice if it were left out


def test_table_is_the_input_of_another_survey(handover: Handover) -> None:
    poses = read_trajectory(handover.out / "cameras.csv")
    assert poses.names == handover.scene.names
    np.testing.assert_array_equal(poses.xyz, handover.columns("x", "y", "z"))
    np.testing.assert_array_equal(poses.sigma_enu_m, handover.columns("sigma_e_m", "sigma_n_m", "sigma_u_m"))
    origin = handover.origin
    turn = geo_from_enu_at(lla_from_enu(handover.scene.center_in_geo, origin), origin)
    assert poses.quat_xyzw is not None
    np.testing.assert_allclose(
        turn @ matrix_from_quat_xyzw(poses.quat_xyzw), handover.scene.geo_from_cam, atol=1e-7
    )


def test_sigma_is_that_of_the_measurements(handover: Handover) -> None:
    """Control points of 1 cm fix the scene; at 100 m, cameras of 0.3 px are known to centimetres and 0.01°."""
    position = handover.columns("sigma_e_m", "sigma_n_m", "sigma_u_m")
    angles = handover.columns("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")
    assert (position > 1e-3).all()
    assert (position < 0.1).all()
    assert (angles > 1e-3).all()
    assert (angles < 0.2).all()
    assert handover.summary.values["median_camera_sigma_v_m"] == pytest.approx(np.median(position[:, 2]), abs=1e-4)


def test_colmap_model_opens_with_small_reprojection_error_in_the_frame_of_the_splat(handover: Handover) -> None:
    model = pycolmap.Reconstruction(str(handover.out / "colmap"))
    assert (model.num_reg_images(), model.num_points3D()) == (IMAGES, 80)
    # Mean length of a residual of 0.3 px in two axes, less what three coordinates of each point take up.
    assert 0.2 < model.compute_mean_reprojection_error() < 0.3 * np.sqrt(np.pi / 2)
    ecef_from_file = load_json(GeorefSidecar, sidecar_path(handover.out / "colmap")).ecef_from_file()
    centers = {image.name: image.projection_center() for image in model.images.values()}
    found = ecef_from_file.apply(np.array([centers[name] for name in handover.scene.names]))
    np.testing.assert_allclose(found, handover.ecef, atol=1e-6)
    origin = handover.origin
    points = np.array([model.points3D[index + 1].xyz for index in range(80)])
    off = enu_from_ecef(ecef_from_file.apply(points), origin) - handover.scene.point_in_geo
    assert np.abs(off).max() < 0.2  # 0.3 px at 100 m, a tenth of that along good rays


def test_nerfstudio_projects_a_point_to_its_pixel(handover: Handover) -> None:
    """Its own formulas: OpenGL axes, then OpenCV's polynomial."""
    document = json.loads((handover.out / "transforms.json").read_text(encoding="utf-8"))
    file_from_ecef = (
        load_json(GeorefSidecar, sidecar_path(handover.out / "transforms.json")).ecef_from_file().inverse()
    )
    origin = handover.origin
    point_in_geo = np.array([3.0, -4.0, 5.0])
    point = file_from_ecef.apply(ecef_from_enu(point_in_geo, origin))
    assert document["camera_model"] == "OPENCV"
    for frame, center, rotation in zip(
        document["frames"], handover.scene.center_in_geo, handover.scene.geo_from_cam, strict=True
    ):
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ [*point, 1.0]
        u, v = x / -z, -y / -z
        r2 = u * u + v * v
        radial = 1 + r2 * (frame["k1"] + r2 * (frame["k2"] + r2 * frame["k3"]))
        p1, p2 = frame["p1"], frame["p2"]
        bent = (
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
        )
        pixel = (frame["fl_x"] * bent[0] + frame["cx"], frame["fl_y"] * bent[1] + frame["cy"])
        expected = project(handover.scene.camera, ((point_in_geo - center) @ rotation)[None])[0]
        np.testing.assert_allclose(pixel, expected, atol=1e-5)
    assert [frame["file_path"] for frame in document["frames"]] == list(handover.scene.names)


def test_sfm_imports_what_is_exported(handover: Handover) -> None:
    """The same cameras and, of COLMAP's model, the same tie points."""
    survey, given = load_json(Survey, handover.workspace.path(SURVEY)), read_sparse(handover.out / "colmap")
    taken = {
        "colmap": flatten(import_model(handover.out / "colmap", survey)),
        "transforms.json": flatten(import_poses(handover.out / "transforms.json", survey)[0]),
    }
    for found in taken.values():
        assert found.image_name == given.image_name
        np.testing.assert_allclose(found.rotation_cam_from_local, given.rotation_cam_from_local, atol=1e-6)
        np.testing.assert_allclose(found.cam_center_in_local, given.cam_center_in_local, atol=1e-6)
        ray = np.array([[0.2, -0.3, 1.0], [-0.4, 0.1, 1.0]])
        for image in range(IMAGES):
            pixels = project(found.camera_of(image), ray)
            np.testing.assert_allclose(pixels, project(given.camera_of(image), ray), atol=1e-6)
    np.testing.assert_allclose(taken["colmap"].point_in_local, given.point_in_local, atol=1e-6)
    np.testing.assert_allclose(taken["colmap"].obs_xy_px, given.obs_xy_px, atol=1e-6)
    np.testing.assert_array_equal(taken["colmap"].obs_point, given.obs_point)


def test_nerfstudio_finds_points_and_splits(handover: Handover) -> None:
    document = json.loads((handover.out / "transforms.json").read_text(encoding="utf-8"))
    names = list(handover.scene.names)
    assert document["test_filenames"] == document["val_filenames"] == [names[2]]
    assert document["train_filenames"] == [*names[:2], *names[3:]]
    (chunk,) = open_cloud_ply(handover.out / document["ply_file_path"]).chunks(1000)
    model = read_sparse(handover.out / "colmap")
    np.testing.assert_array_equal(chunk.position, model.point_in_local)


def drawn_dots(scene: TrueScene, folder: Path) -> None:
    """Draw each photograph of a scene: a blurred dot where the lens shows a point."""
    y, x = np.mgrid[: scene.camera.height, : scene.camera.width] + 0.5
    for name, rotation, center in zip(scene.names, scene.geo_from_cam, scene.center_in_geo, strict=True):
        picture = np.full(x.shape, 30.0)
        for u, v in project(scene.camera, (scene.point_in_geo - center) @ rotation):
            if 20 < u < scene.camera.width - 20 and 20 < v < scene.camera.height - 20:
                near = (slice(int(v) - 15, int(v) + 16), slice(int(u) - 15, int(u) + 16))
                picture[near] += 200 * np.exp(-((x[near] - u) ** 2 + (y[near] - v) ** 2) / (2 * 2.5**2))
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.clip(picture, 0, 255).astype(np.uint8), (cv2.IMWRITE_JPEG_QUALITY, 100))


def test_points_lie_at_their_dots_in_the_undistorted_photographs(tmp_path: Path) -> None:
    """The lens is the adjusted one: SfM's would miss the dots by pixels."""
    scene, workspace = trained_workspace(tmp_path / "ws")
    drawn_dots(scene, workspace.root)
    lens = SolvedLens(camera_id=1, model=scene.camera.model, params=tuple(scene.camera.params.tolist()))
    model = load_json(TrainedModel, workspace.path(MODEL))
    save_json(model.model_copy(update={"lenses": (lens,)}), workspace.path(MODEL))
    sparse = read_sparse(workspace.path(SPARSE))
    other = replace(scene.camera, params=scene.camera.params * [1.01, 1.01, 1, 1, 0, 0, 0, 0])
    write_sparse(replace(sparse, cameras={1: other}), workspace.path(SPARSE))
    handed_over(workspace, tmp_path / "out", undistorted=True)
    folder = tmp_path / "out" / "undistorted"
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    file_from_ecef = load_json(GeorefSidecar, sidecar_path(folder)).ecef_from_file().inverse()
    points = file_from_ecef.apply(ecef_from_enu(scene.point_in_geo, survey_origin(workspace)))
    measured = []
    for image in model.images.values():
        picture = cv2.imread(str(folder / "images" / image.name), cv2.IMREAD_GRAYSCALE).astype(float) - 30
        camera = model.cameras[image.camera_id]
        assert picture.shape == (camera.height, camera.width)
        pixels = np.array([image.project_point(point) for point in points])
        for u, v in pixels:
            others = np.sort(np.hypot(*(pixels - (u, v)).T))[1]
            if others > 40 and 20 < u < camera.width - 20 and 20 < v < camera.height - 20:
                top, left = int(v) - 10, int(u) - 10
                cut = np.clip(picture[top : top + 21, left : left + 21] - 10, 0, None)
                y, x = np.mgrid[:21, :21] + 0.5
                measured.append([(cut * x).sum() / cut.sum() + left - u, (cut * y).sum() / cut.sum() + top - v])
        # Observations follow the rays of SfM's pixels under the adjusted lens.
        seen = [point for point in image.points2D if point.has_point3D()]
        xy = np.array([point.xy for point in seen])
        expected = np.array([image.project_point(model.points3D[point.point3D_id].xyz) for point in seen])
        assert np.median(np.hypot(*(xy - expected).T)) < 1.0
    assert len(measured) > 100
    # The interpolation is right to 0.022 px along each axis, and quality 95 adds noise of a hundredth.
    assert np.abs(np.mean(measured, axis=0)).max() < 0.01
    assert np.hypot(*np.array(measured).T).max() < 0.05


@pytest.mark.parametrize("k1", [-0.1, 0.0, 0.1])
def test_an_undistorted_picture_shows_nothing_from_beyond_its_photograph(k1: float) -> None:
    camera = Camera("OPENCV", 1200, 900, np.array([1000.0, 1010.0, 620.0, 440.0, k1, 0.0, 1e-3, 0.0]))
    pinhole = covered_pinhole(camera)
    assert (pinhole.width, pinhole.height, pinhole.cx, pinhole.cy) == (1200, 900, 620.0, 440.0)
    pixels = np.stack(np.meshgrid(np.arange(1200) + 0.5, np.arange(900) + 0.5), axis=-1)
    shown = project(camera, pinhole.rays(pixels))
    assert (shown >= 0.5 - 1e-9).all() and (shown <= np.array([1199.5, 899.5]) + 1e-9).all()
    # No larger than it must be: some pixel lies at the photograph's edge, unless nothing had to be enlarged.
    if pinhole.fx > camera.params[0]:
        assert min((shown - 0.5).min(), (np.array([1199.5, 899.5]) - shown).min()) < 0.01
    else:
        assert k1 < 0


def test_footprints_project_back_to_the_border_of_their_photograph(handover: Handover) -> None:
    document = json.loads((handover.out / "footprints.geojson").read_text(encoding="utf-8"))
    assert len(document["features"]) == IMAGES
    origin = handover.origin
    lens = handover.scene.camera
    for index, feature in enumerate(document["features"]):
        properties = feature["properties"]
        assert (properties["name"], properties["time"][:10]) == (handover.scene.names[index], "2023-11-14")
        assert properties["sigma_e_m"] > 0
        ring = np.array(feature["geometry"]["coordinates"][0])
        lla = np.column_stack([ring[:, ::-1], np.full(len(ring), origin.alt_m)])
        east_north = enu_from_ecef(ecef_from_lla(lla), origin)[:, :2]
        # On its ray, the height is unknown to the file: find the one at which the vertex meets the border.
        center, rotation = handover.scene.center_in_geo[index], handover.scene.geo_from_cam[index]
        off = []
        for east, north in east_north:
            heights = np.linspace(-5, 25, 601)
            candidates = np.column_stack([np.full((601, 2), (east, north)), heights])
            pixel = project(lens, (candidates - center) @ rotation)
            off.append(np.nanmin(np.abs(_inside(pixel, lens.width, lens.height))))
        # Heights in steps of 0.05 m move a pixel by less than one.
        assert np.max(off) < 1.0
        assert not properties["clipped"]
    text = sidecar_path(handover.out / "footprints.geojson").read_text(encoding="utf-8")
    sidecar = CrsSidecar.model_validate_json(text)
    assert (sidecar.crs, sidecar.vertical_datum.name, sidecar.units[0]) == ("EPSG:4979", "ellipsoidal", "degree")
    assert sidecar.bounds[0][:2] == pytest.approx(_corners(document).min(axis=0), abs=1e-8)


def _corners(document: dict[str, Any]) -> np.ndarray:
    return np.concatenate([feature["geometry"]["coordinates"][0] for feature in document["features"]])


def _inside(pixel: np.ndarray, width: int, height: int) -> np.ndarray:
    """Distance of pixels from the border of the image, negative outside."""
    return np.minimum.reduce([pixel[:, 0], width - pixel[:, 0], pixel[:, 1], height - pixel[:, 1]])


def test_unchecked_positions_have_no_sigma(handover: Handover, tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    model = load_json(TrainedModel, workspace.path(MODEL))
    unchecked = Remark(code=NOT_CHECKED, sentence="Nothing checks the positions.")
    save_json(model.model_copy(update={"cautions": (unchecked,)}), workspace.root / MODEL)
    summary = handed_over(workspace, tmp_path / "out", crs="EPSG:4326")
    table = replace(handover, out=tmp_path / "out")
    assert {row["sigma_e_m"] + row["sigma_kappa_deg"] for row in table.rows()} == {""}
    assert {caution.code for caution in summary.cautions} == {NOT_CHECKED, "cameras-without-sigma"}
    assert summary.values["median_camera_sigma_h_m"] is None
    # Degrees with nine decimals; ω φ κ count from true north where the CRS has no grid.
    poses = read_trajectory(tmp_path / "out" / "cameras.csv")
    assert poses.geographic
    assert table.columns("kappa_deg")[0, 0] != handover.columns("kappa_deg")[0, 0]


def test_covariances_are_full_and_those_of_the_table(handover: Handover) -> None:
    with np.load(handover.out / "covariances.npz") as file:
        found = {name: file[name] for name in file.files}
    assert tuple(found["camera_name"]) == handover.scene.names
    assert found["camera_cov"].shape == (IMAGES, 6, 6)
    # The middle of the scene is near enough that its axes are those of each camera.
    sigma = np.sqrt(np.diagonal(found["camera_cov"], axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[:, 3:], handover.columns("sigma_e_m", "sigma_n_m", "sigma_u_m"), atol=6e-5)
    with (handover.out / "camera_covariances.csv").open(encoding="utf-8", newline="") as handle:
        head, *rows = csv.reader(handle)
    assert (head[0], head[1], head[-1], len(head)) == ("name", "cov_rotation_e_rotation_e", "cov_u_u", 22)
    upper = np.array([row[1:] for row in rows], dtype=float)
    np.testing.assert_allclose(upper, found["camera_cov"][:, *np.triu_indices(6)], rtol=1e-8)
    # Points lie where the COLMAP model beside has them, and their covariances are proper ones.
    model = read_sparse(handover.out / "colmap")
    places = dict(zip(model.point_id.tolist(), model.point_in_local, strict=True))
    np.testing.assert_allclose(found["position"], [places[key] for key in found["point_id"].tolist()], atol=1e-9)
    assert (np.linalg.eigvalsh(found["point_cov_m2"]) > 0).all()
    # A tie point adds the errors of its own rays to those of cameras and lens.
    posterior = load_adjustment(handover.workspace)
    in_geo = posterior.solution.similarity.apply(scene_of(posterior.solution, posterior.sparse).point_in_model)
    of_cameras = posterior.of_scene(in_geo, posterior.sparse.obs_point, posterior.sparse.obs_image)
    more = np.trace(found["point_cov_m2"], axis1=1, axis2=2) - np.trace(of_cameras, axis1=1, axis2=2)
    assert (more > 0).all()


def test_cameras_are_exported_before_training(handover: Handover, tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    untrained(workspace)
    summary = handed_over(workspace, tmp_path / "out")
    assert summary.values["cameras"] == IMAGES
    table = replace(handover, out=tmp_path / "out")
    np.testing.assert_allclose(table.columns("x", "y", "z"), handover.columns("x", "y", "z"), atol=1e-4)
    np.testing.assert_array_equal(table.columns("sigma_e_m"), handover.columns("sigma_e_m"))


def test_crs_of_another_country_is_refused_before_the_work_begins(handover: Handover, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="EPSG:28992"):
        handed_over(handover.workspace, tmp_path / "out", crs="EPSG:28992")
    assert list((tmp_path / "out").iterdir()) == []


def test_nerfstudio_leaves_out_the_lens_that_it_cannot_hold_beside_the_others(tmp_path: Path) -> None:
    """COLMAP's model holds both."""
    _, workspace = trained_workspace(tmp_path / "ws")
    sparse = read_sparse(workspace.path(SPARSE))
    fisheye = Camera("OPENCV_FISHEYE", 1200, 900, np.array([900.0, 900.0, 600.0, 450.0, 0.01, 0.0, 0.0, 0.0]))
    owner = np.where(np.arange(IMAGES) < 2, 2, 1)
    write_sparse(
        replace(sparse, cameras={**sparse.cameras, 2: fisheye}, image_camera_id=owner), workspace.path(SPARSE)
    )
    summary = handed_over(workspace, tmp_path / "out")
    document = json.loads((tmp_path / "out" / "transforms.json").read_text(encoding="utf-8"))
    assert [frame["file_path"] for frame in document["frames"]] == list(sparse.image_name[2:])
    assert "nerfstudio-one-camera-model" in {caution.code for caution in summary.cautions}
    assert [
        caution.code
        for caution in load_json(GeorefSidecar, sidecar_path(tmp_path / "out" / "transforms.json")).cautions
    ] == ["nerfstudio-one-camera-model"]
    assert pycolmap.Reconstruction(str(tmp_path / "out" / "colmap")).num_cameras() == 2
