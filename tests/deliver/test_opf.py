"""The survey as an OPF project: what its own library validates, and what our import reads back as it was."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pipelines.core.errors import InputError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import GAUSSIANS, SPARSE, SURVEY
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver import opf
from pipelines.deliver.opf import run
from pipelines.deliver.options import ExportOpfOptions
from pipelines.formats.colmap import read_sparse
from pipelines.formats.opf import read_opf, read_opf_points
from pipelines.formats.opf_writer import OpfFrame, OpfPhotograph, OpfScene, internals_of, write_opf
from pipelines.formats.splat_ply import read_splat_ply, write_splat_ply
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.cameras import Camera, distort, project, undistort
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.sparse_model import SparseModel
from pipelines.surface.fusion import SurfaceCloud
from pipelines.survey.solution import Solution, read_sfm, read_solution
from pipelines.survey.survey import Survey
from tests.refusals import refused
from tests.trained_workspaces import trained_workspace, untrained

pytestmark = pytest.mark.usefixtures("one_thread")
# Northing first in metres, easting first in US feet, and as the place of the scene says.
WELLINGTON, LOS_ANGELES = (
    Origin(lat_deg=-41.3, lon_deg=174.8, alt_m=30.0),
    Origin(lat_deg=34, lon_deg=-118, alt_m=90),
)
SIZE = (1200, 900)


def exported(workspace: Workspace, **options: Any) -> tuple[Path, Summary]:
    out = workspace.root / "opf.partial"
    out.mkdir(exist_ok=True)
    summary = run(StageRun(workspace, out), ExportOpfOptions(**options))
    return out / "project.opf", summary


def imported(project: Path) -> SparseModel:
    return read_opf(project, lambda _: SIZE).model


def at(workspace: Workspace, origin: Origin | None) -> Workspace:
    survey = load_json(Survey, workspace.path(SURVEY))
    save_json(survey.model_copy(update={"origin": origin}), workspace.path(SURVEY))
    return workspace


def frame_of(project: Path) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the CRS of a project, and the function to its processing CRS: scale, swap, shift."""
    document = json.loads((project.parent / "scene_reference_frame.json").read_text())
    moved = document["base_to_canonical"]

    def processing(base: np.ndarray) -> np.ndarray:
        scaled = base * moved["scale"]
        return (scaled[:, [1, 0, 2]] if moved["swap_xy"] else scaled) + moved["shift"]

    return document["crs"]["definition"], processing


def in_crs(places_in_geo: np.ndarray, origin: Origin, definition: str) -> np.ndarray:
    """Return coordinates in the order of the axes of a CRS, by PROJ alone."""
    lat, lon, height = lla_from_enu(places_in_geo, origin).T
    target = CRS(definition)
    assert len(target.axis_info) == 3
    return np.stack(Transformer.from_crs("EPSG:4979", target).transform(lat, lon, height), axis=-1)


def test_the_splat_lies_in_the_frame_of_the_cameras(tmp_path: Path) -> None:
    """Centres where PROJ has them, in single precision 60 m around; long axes along the map's directions there."""
    scene, workspace = trained_workspace(tmp_path / "ws")
    rng = np.random.default_rng(1)
    splat = replace(
        read_splat_ply(workspace.path(GAUSSIANS)),
        quats_wxyz=rng.normal(size=(len(scene.point_in_geo), 4)).astype(np.float32),
        log_scales=np.tile(np.float32([1.0, -1.0, -2.0]), (len(scene.point_in_geo), 1)),
    )
    write_splat_ply(workspace.path(GAUSSIANS), splat)
    # Los Angeles in US feet, whose processing CRS is in metres.
    project_file, summary = exported(at(workspace, LOS_ANGELES), crs="EPSG:2229", cloud=False)
    definition, processing = frame_of(project_file)
    read = read_splat_ply(project_file.parent / "splat.ply")
    assert summary.values["gaussians"] == len(read) == len(splat)
    truth = processing(in_crs(scene.point_in_geo, LOS_ANGELES, definition))
    np.testing.assert_allclose(read.means, truth, rtol=0, atol=1e-4)
    axis, own = (matrix_from_quat_xyzw(np.roll(part.quats_wxyz, -1, axis=1))[:, :, 0] for part in (splat, read))
    ends = processing(in_crs(scene.point_in_geo + 10 * axis, LOS_ANGELES, definition))
    along = (ends - truth) / np.linalg.norm(ends - truth, axis=1, keepdims=True)
    # The plumb line turns by 1e-5 in the 60 m of the scene.
    assert np.abs(np.einsum("ni,ni->n", along, own)).min() > 1 - 1e-7
    np.testing.assert_allclose(read.log_scales, splat.log_scales, atol=1e-4)


def test_the_surface_is_a_point_cloud_of_the_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As its own library reads it: places and normals by PROJ, colours, of all squares inside the area."""
    resolve, pyopf_io = pytest.importorskip("pyopf.resolve"), pytest.importorskip("pyopf.io")
    _, workspace = trained_workspace(tmp_path / "ws")
    rng = np.random.default_rng(0)
    parts = [surface(rng, count) for count in (40, 25)]
    shown(monkeypatch, parts)
    project_file, summary = exported(at(workspace, WELLINGTON), crs="EPSG:2193")
    definition, processing = frame_of(project_file)
    (cloud,) = resolve.resolve(pyopf_io.load(str(project_file))).point_cloud_objs
    (node,) = cloud.nodes
    kept = [part.position[:, 0] > 0 for part in parts]
    truth = np.concatenate([part.position[rows] for part, rows in zip(parts, kept, strict=True)])
    assert summary.values["cloud_points"] == len(node) == len(truth) < 65 and not summary.warnings
    np.testing.assert_allclose(node.position, processing(in_crs(truth, WELLINGTON, definition)), rtol=0, atol=1e-4)
    rgb = np.concatenate([part.rgb[rows] for part, rows in zip(parts, kept, strict=True)])
    np.testing.assert_array_equal(node.color, np.column_stack([rgb, np.full(len(rgb), 255)]))
    normal = np.concatenate([part.normal[rows] for part, rows in zip(parts, kept, strict=True)])
    ends = processing(in_crs(truth + 10 * normal, WELLINGTON, definition))
    along = ends - processing(in_crs(truth, WELLINGTON, definition))
    cosine = np.einsum("ni,ni->n", along / np.linalg.norm(along, axis=1, keepdims=True), node.normal)
    assert cosine.min() > 1 - 1e-6
    # glTF's scene is y-up: its node turns the z-up points.
    np.testing.assert_array_equal(node.matrix[:3, :3] @ [0, 0, 1], [0, 1, 0])
    assert imported(project_file).image_name  # our own import takes the tie points, not the cloud


def surface(rng: np.random.Generator, count: int) -> SurfaceCloud:
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rgb = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return SurfaceCloud(rng.uniform(-60, 60, (count, 3)), normal, rgb, np.full(count, 0.02))


def shown(monkeypatch: pytest.MonkeyPatch, parts: list[SurfaceCloud]) -> None:
    """Let the trained model show these points; the area of interest is the east of the scene."""
    views: Any = SimpleNamespace(close=lambda: None)
    area: Any = SimpleNamespace(contains=lambda position: position[:, 0] > 0)
    monkeypatch.setattr(opf, "surface_views", lambda *_, **__: views)
    monkeypatch.setattr(opf, "fusion_settings", lambda *_: None)
    monkeypatch.setattr(opf, "area_of", lambda *_, **__: area)
    monkeypatch.setattr(opf, "shared_squares", lambda *_: iter(parts))


@pytest.mark.parametrize("parts", [[], None], ids=["no point", "no photographs"])
def test_a_project_without_a_cloud_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: list[SurfaceCloud] | None
) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    if parts is not None:
        shown(monkeypatch, parts)
    project_file, summary = exported(at(workspace, WELLINGTON))
    assert [warning.code for warning in summary.warnings] == ["opf-no-cloud"]
    kinds = [item["type"] for item in json.loads(project_file.read_text())["items"]]
    assert "point_cloud" not in kinds and kinds[-1] == "ext_georefgs_gaussian_splats"
    assert not (project_file.parent / "point_cloud").exists() and summary.values["cloud_points"] == 0


def residuals(model: SparseModel) -> np.ndarray:
    in_cam = np.einsum(
        "nij,nj->ni", model.rotation_cam_from_local[model.obs_image], model.point_in_local[model.obs_point]
    )
    in_cam += model.translation_cam_from_local[model.obs_image]
    return project(model.cameras[1], in_cam) - model.obs_xy_px


def observations(model: SparseModel) -> set[tuple[str, float, float]]:
    """Pixels in single precision to a thousandth, by photograph."""
    return {
        (model.image_name[image].rpartition("/")[2], round(x, 3), round(y, 3))
        for image, (x, y) in zip(model.obs_image.tolist(), np.float32(model.obs_xy_px).tolist(), strict=True)
    }


@pytest.mark.parametrize(
    ("origin", "crs"),
    [(None, None), (WELLINGTON, None), (WELLINGTON, "EPSG:2193"), (LOS_ANGELES, "EPSG:2229")],
    ids=["local", "around the scene", "northing first", "feet"],
)
def test_cameras_and_tie_points_come_back(tmp_path: Path, origin: Origin | None, crs: str | None) -> None:
    """At 1e-6 m in the CRS, and bent by the map no more than its curvature: 1e-8 of a ray."""
    scene, workspace = trained_workspace(tmp_path / "ws")
    project_file, summary = exported(at(workspace, origin), crs=crs)
    model, solution = imported(project_file), read_solution(workspace)
    definition, processing = frame_of(project_file)
    truth = scene.center_in_geo
    if origin is not None:
        truth = in_crs(truth, origin, definition)
    order = [model.image_name.index(name) for name in scene.names]
    np.testing.assert_allclose(model.cam_center_in_local[order], processing(truth), rtol=0, atol=1e-6)
    ours = solution.with_lenses(read_sfm(workspace, solution))
    assert observations(model) == observations(ours) and len(model.point_id) == summary.values["points"]
    assert len(model.obs_point) == len(ours.obs_point)
    # Single precision of the points, and of a map that is taken for Cartesian: its scale is off, heights are not.
    loose = {"EPSG:2193": 0.35, "EPSG:2229": 0.05}.get(crs or "", 0.02)
    loose += float(summary.values["lens_error_px"])
    assert np.abs(np.sort(np.hypot(*residuals(model).T)) - np.sort(_own_residuals(solution, ours))).max() < loose
    codes = {caution.code for caution in summary.cautions}
    # California's zone 5 is true to scale at that latitude, within 1e-5.
    assert ("opf-map-scale" in codes) == (crs == "EPSG:2193") and "opf-lens-replaced" in codes


def _own_residuals(solution: Solution, sparse: SparseModel) -> np.ndarray:
    """Of the same cameras with points as they see them, and OPF's lens, in the workspace's own frame."""
    from pipelines.geometry.intersection import refined_points
    from pipelines.survey.scene import network_of

    poses = solution.poses
    points = refined_points(network_of(sparse, poses, solution.point_in_model(sparse))).point_in_world
    rotation = poses.cam_from_model
    moved = -np.einsum("nij,nj->ni", rotation, poses.cam_center_in_model)
    own = replace(sparse, rotation_cam_from_local=rotation, translation_cam_from_local=moved, point_in_local=points)
    return np.hypot(*residuals(own).T)


def test_control_points_come_back_with_their_marks(tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    at(workspace, WELLINGTON)
    project_file, summary = exported(workspace)
    survey, points = load_json(Survey, workspace.path(SURVEY)), read_opf_points(project_file)
    given = [*survey.control_points, *survey.check_points]
    assert [point.name for point in points.points] == [point.name for point in given]
    assert [point.is_check for point in points.points] == [point in survey.check_points for point in given]
    assert points.crs_text is not None
    truth = in_crs(np.array([point.position_in_geo for point in given]), WELLINGTON, points.crs_text)
    np.testing.assert_allclose([point.xyz for point in points.points], truth, rtol=0, atol=1e-6)
    marks = {(mark.name, mark.image, mark.x_px, mark.y_px) for mark in points.marks}
    assert marks == {(point.name, mark.image, mark.x_px, mark.y_px) for point in given for mark in point.marks}
    assert summary.values["marks"] == len(marks) > 0


def test_the_librarys_own_reader_validates_the_project(tmp_path: Path) -> None:
    pyopf_io = pytest.importorskip("pyopf.io")
    resolve = pytest.importorskip("pyopf.resolve")
    _, workspace = trained_workspace(tmp_path / "ws")
    at(workspace, LOS_ANGELES)
    project_file, summary = exported(workspace)
    objects = resolve.resolve(pyopf_io.load(str(project_file)))
    calibration = objects.calibration
    assert len(calibration.calibrated_cameras.cameras) == summary.values["cameras"]
    assert (
        len(objects.input_control_points.gcps) == summary.values["control_points"] + summary.values["check_points"]
    )
    assert sum(len(node) for node in calibration.tracks.nodes) == summary.values["points"]
    assert (
        objects.input_cameras.captures[0].geolocation.crs.definition == objects.scene_reference_frame.crs.definition
    )
    assert objects.camera_list.cameras[0].id == calibration.calibrated_cameras.cameras[0].id
    extension = json.loads((project_file.parent / "calibrated_cameras.json").read_text())["cameras"][0][
        "extensions"
    ]
    assert len(extension["GEOREFGS_covariance"]["rotation_rad_position_m"]) == 21
    splats = json.loads(project_file.read_text())["items"][-1]
    assert splats["resources"] == [{"uri": "splat.ply", "format": "application/ext-georefgs-gaussian-splats+ply"}]
    assert {source["type"] for source in splats["sources"]} == {"scene_reference_frame", "calibration"}


@pytest.mark.parametrize(
    ("camera", "most_px"),
    [
        (Camera("OPENCV", *SIZE, np.array([1000.0, 1000.0, 590.0, 455.0, -0.05, 0.02, 1e-3, -5e-4])), 1e-9),
        (Camera("OPENCV_FISHEYE", *SIZE, np.array([700.0, 690.0, 590.0, 455.0, 0.03, -0.01, 2e-3, -4e-4])), 1e-6),
        (Camera("OPENCV", *SIZE, np.array([1000.0, 1001.0, 590.0, 455.0, -0.05, 0.02, 0.0, 0.0])), 0.4),
        (Camera("FULL_OPENCV", *SIZE, np.array([900, 900, 600, 450, 0.4, 0.1, 0, 0, 0.01, 0.5, 0.1, 0.02])), 0.2),
    ],
    ids=["exact", "fisheye", "two focal lengths", "rational"],
)  # fmt: skip
def test_lenses_are_those_of_opf_within_the_error_that_is_said(
    tmp_path: Path, camera: Camera, most_px: float
) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    sparse = replace(read_sparse(workspace.path(SPARSE)), cameras={1: camera})
    shots = [OpfPhotograph(name) for name in sparse.image_name]
    error_px = write_opf(tmp_path, OpfScene("n", OpfFrame("EPSG:32632", np.zeros(3)), sparse, shots, ()))
    assert error_px == internals_of(camera)[1] < most_px
    x, y = np.meshgrid(np.linspace(0, SIZE[0], 21), np.linspace(0, SIZE[1], 21))
    rays = undistort(camera, np.stack([x, y], axis=-1).reshape(-1, 2))
    read = read_opf(tmp_path / "project.opf", lambda _: SIZE).model.cameras[1]
    off = np.hypot(*(distort(read, rays) - distort(camera, rays)).T)
    assert off.max() <= 1.05 * error_px + 1e-6


def test_a_crs_that_is_no_map_is_refused(tmp_path: Path) -> None:
    _, workspace = trained_workspace(tmp_path / "ws")
    with refused("crs-not-projected", InputError):
        exported(at(workspace, LOS_ANGELES), crs="EPSG:4326")


def test_before_training_the_cameras_are_those_of_init_sim3(tmp_path: Path) -> None:
    scene, workspace = trained_workspace(tmp_path / "ws")
    untrained(workspace)
    project_file, summary = exported(at(workspace, None))
    assert (summary.values["gaussians"], summary.values["cloud_points"], summary.warnings) == (0, 0, ())
    model = imported(project_file)
    order = [model.image_name.index(name) for name in scene.names]
    processing = frame_of(workspace.root / "opf.partial/project.opf")[1]
    np.testing.assert_allclose(model.cam_center_in_local[order], processing(scene.center_in_geo), rtol=0, atol=1e-6)
