"""Cameras that other programs have solved: each file gives back the cameras and tie points that were written."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.core.errors import InputError
from pipelines.core.fingerprints import fingerprints
from pipelines.core.stages import BY_NAME
from pipelines.formats.colmap import flatten, write_sparse
from pipelines.formats.solved_cameras import SolvedCameras
from pipelines.geometry.cameras import Camera, named_parameters, project, undistort
from pipelines.geometry.similarity import umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.foreign_cameras import foreign_file
from pipelines.sfm.imported_model import ImportedModel, import_model, import_poses
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey
from tests import foreign_files as write
from tests.refusals import codes, logged_codes, refused, said
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of, write_workspace

pytest.importorskip("pycolmap")

LENS = Camera(
    "FULL_OPENCV", 1200, 900, np.array([1020.0, 1020, 603, 447, -0.045, 0.012, 3e-4, -2e-4, 1e-3, 0, 0, 0])
)
Writer = Callable[[SparseModel, Path], Path]
WRITERS: dict[str, Writer] = {
    "metashape": lambda model, folder: write.metashape(model, folder / "cameras.xml"),
    "opensfm": lambda model, folder: write.opensfm(model, folder / "reconstruction.json"),
    "odm": lambda model, folder: write.odm(model, folder / "project"),
    "nerfstudio": lambda model, folder: write.nerfstudio(model, folder / "transforms.json"),
    "realityscan": lambda model, folder: write.realityscan(model, folder / "cameras.csv"),
    "opf": lambda model, folder: write.opf(model, folder / "opf"),
}


@pytest.fixture
def surveyed() -> tuple[SparseModel, Survey]:
    rng = np.random.default_rng(0)
    scene = replace(make_scene(images=6, points=60), camera=LENS)
    return sparse_model(scene, Noise(), rng), survey_of(scene, Noise(), Measured(), rng)


def solved(path: Path, size: tuple[int, int] = (1200, 900)) -> SolvedCameras:
    """Read a file as if the survey had all of its photographs."""
    file = foreign_file(path)
    assert file is not None
    return file.read(file.path, lambda _: size)


def assert_same_cameras(found: SparseModel, true: SparseModel) -> None:
    assert found.image_name == true.image_name
    np.testing.assert_allclose(found.rotation_cam_from_local, true.rotation_cam_from_local, atol=1e-6)
    shift = found.cam_center_in_local - true.cam_center_in_local  # of a map's coordinates
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-6)
    rays = undistort(true.cameras[1], true.obs_xy_px)
    rays = np.column_stack([rays, np.ones(len(rays))])
    for image in range(len(true.image_name)):
        np.testing.assert_allclose(
            project(found.camera_of(image), rays), project(true.camera_of(image), rays), atol=1e-6
        )


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_come_back(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    path = WRITERS[kind](model, tmp_path)
    found, _ = import_poses(path, survey)
    assert_same_cameras(flatten(found), model)
    assert ImportedModel.of(path, triangulates=False).triangulates is (kind not in {"opensfm", "opf"})
    expected = {"nerfstudio": [], "metashape": ["rolling-shutter-not-taken", "georeference-not-taken"]}
    assert set(expected.get(kind, ["georeference-not-taken"])) <= set(logged_codes(caplog))


@pytest.mark.parametrize("kind", ["opensfm", "opf"])
def test_tie_points_come_back(surveyed: tuple[SparseModel, Survey], tmp_path: Path, kind: str) -> None:
    """The pixels of OPF have single precision."""
    model, survey = surveyed
    found = flatten(import_model(WRITERS[kind](model, tmp_path), survey))
    assert_same_cameras(found, model)
    kept = model.of_images(np.arange(6))
    tolerance = 1e-6 if kind == "opensfm" else 1e-5
    np.testing.assert_allclose(found.point_in_local, kept.point_in_local, atol=tolerance)
    np.testing.assert_array_equal(found.obs_point, kept.obs_point)
    np.testing.assert_array_equal(found.obs_image, kept.obs_image)
    np.testing.assert_allclose(found.obs_xy_px, kept.obs_xy_px, atol=1e-6 if kind == "opensfm" else 1e-4)


def test_observations_that_opensfm_has_rejected_are_left_out(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, survey = surveyed
    found = flatten(import_model(write.opensfm(model, tmp_path / "reconstruction.json", rejected=7), survey))
    np.testing.assert_allclose(found.obs_xy_px, np.delete(model.obs_xy_px, 7, axis=0), atol=1e-6)


def test_photographs_that_the_survey_lacks_are_left_out(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    fewer = survey.model_copy(update={"images": survey.images[1:5]})
    path = write.opensfm(model, tmp_path / "reconstruction.json")
    found = flatten(import_model(path, fewer))
    assert found.image_name == model.image_name[1:5]
    assert "2 images of the imported model are not in the survey" in caplog.text
    with refused("too-few-images-in-survey", InputError):
        import_poses(path, survey.model_copy(update={"images": survey.images[:2]}))


def test_disabled_cameras_and_components_of_metashape(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    """Two components have a common frame by their transforms; without one, the larger component is taken."""
    model, _ = surveyed
    path = write.metashape(model, tmp_path / "a.xml", off=[2])
    found = solved(path)
    assert "disabled" in said(found.remarks, "disabled-cameras") and "cameras-without-pose" in codes(found.remarks)
    assert found.model.image_name == tuple(name for i, name in enumerate(model.image_name) if i != 2)
    text = path.read_text()
    turn, move, scale = Rotation.from_rotvec([0.2, -0.7, 1.1]).as_matrix(), np.array([3.0, -8.0, 2.0]), 3.5
    second = (
        f'<component id="1"><transform><rotation>{" ".join(map(repr, turn.ravel().tolist()))}</rotation>'
        f"<translation>{' '.join(map(repr, move.tolist()))}</translation><scale>{scale}</scale></transform>"
        "</component>"
    )
    first = '<component id="0"><transform>'
    text = text.replace(
        "<scale>7</scale></transform></component>", f"<scale>7</scale></transform></component>{second}"
    )
    for index in (0, 1):
        text = text.replace(
            f'camera id="{index}" sensor_id="0" component_id="0"',
            f'camera id="{index}" sensor_id="0" component_id="1"',
        )
    path.write_text(text)
    center = solved(path).model.cam_center_in_local
    world = np.array([4e6, 5e5, 4.5e6]) + 7 * model.cam_center_in_local
    world[:2] = move + scale * model.cam_center_in_local[:2] @ turn.T
    world = world[[0, 1, 3, 4, 5]]
    np.testing.assert_allclose(center - center[0], world - world[0], rtol=1e-9, atol=1e-5)
    path.write_text(
        text.replace(first, '<component id="0"><partition>'.replace("partition", "other")).replace(
            "<scale>7</scale></transform>", "<scale>7</scale></other>"
        )
    )
    alone = solved(path)
    assert alone.model.image_name == tuple(model.image_name[i] for i in (3, 4, 5))
    assert "several-models" in codes(alone.remarks)


def test_calibration_from_the_corner_is_photoscans(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    """PhotoScan until 1.1, and MeshLab: fx, fy, cx, cy, and p1 before p2 as OpenCV."""
    model, _ = surveyed
    path = write.metashape(model, tmp_path / "a.xml")
    text = path.read_text()
    begin, end = text.index("<f>"), text.index("</calibration>")
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    lens = "".join(f"<{key}>{value!r}</{key}>" for key, value in named_parameters(LENS).items() if key in names)
    path.write_text(text[:begin] + lens + text[end:])
    assert_same_cameras(solved(path).model, model)


def test_intrinsics_of_nerfstudio_at_the_top_at_frames_and_by_angle(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, _ = surveyed
    path = write.nerfstudio(model, tmp_path / "transforms.json")
    document = json.loads(path.read_text())
    lens = {
        key: document["frames"][0][key]
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2")
    }
    for frame in document["frames"]:
        for key in lens:
            del frame[key]
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    path.write_text(json.dumps({**document, **lens}))
    assert_same_cameras(solved(path).model, model)
    document["frames"][0] |= {"fl_x": 900.0, "fl_y": 901.0}
    path.write_text(json.dumps({**document, **lens}))
    several = solved(path).model
    np.testing.assert_allclose(several.camera_of(0).params[:2], [900.0, 901.0])
    np.testing.assert_allclose(several.camera_of(1).params[:2], [1020.0, 1020.0])
    del document["frames"][0]["fl_x"], document["frames"][0]["fl_y"], document["camera_model"]
    path.write_text(json.dumps({**document, "camera_angle_x": 1.1}))  # as of Blender: no size, no lens
    plain = solved(path).model.camera_of(0)
    assert plain.model == "PINHOLE"
    np.testing.assert_allclose(plain.params, [600 / np.tan(0.55), 600 / np.tan(0.55), 600, 450])


@pytest.mark.parametrize("heights", [(1620.0, 1620.3), (0.0, 60.0)])
def test_degrees_are_no_coordinates_of_realityscan(tmp_path: Path, heights: tuple[float, float]) -> None:
    """A flight at one height, and one of an orbit; the same numbers as metres of a room are read."""
    low, high = heights

    def table(scale: float) -> Path:
        rows = [
            f"{i}.jpg,{7.75 + 1e-3 * i},{46.02 + 1e-3 * i},{(low + (high - low) * i / 2) * scale},0,0,0,24"
            for i in range(3)
        ]
        (path := tmp_path / "a.csv").write_text("\n".join(["#name,x,y,alt,heading,pitch,roll,f", *rows]))
        return path

    with refused("positions-in-degrees", InputError):
        solved(table(1.0))
    assert len(solved(table(1e-5)).model.image_name) == 3


@pytest.mark.parametrize("kind", ["opensfm", "opf"])
def test_cameras_solved_on_smaller_copies_are_enlarged(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, kind: str
) -> None:
    """1200×900 are 3000×2251 pixels, rounded; other proportions, and pinholes, are refused."""
    model, survey = surveyed
    large = survey.model_copy(
        update={"cameras": (survey.cameras[0].model_copy(update={"width": 3000, "height": 2251}),)}
    )
    found = flatten(import_model(WRITERS[kind](model, tmp_path), large))
    scale = np.array([2.5, 2251 / 900])
    camera = found.camera_of(0)
    assert (camera.width, camera.height) == (3000, 2251)
    np.testing.assert_allclose(camera.params[:4], LENS.params[:4] * np.tile(scale, 2), rtol=1e-12)
    np.testing.assert_allclose(camera.params[4:], LENS.params[4:], atol=1e-12)
    np.testing.assert_allclose(found.obs_xy_px, model.of_images(np.arange(6)).obs_xy_px * scale, atol=1e-3)
    square = large.model_copy(update={"cameras": (large.cameras[0].model_copy(update={"height": 3000}),)})
    with refused("photograph-size", InputError):
        import_poses(WRITERS[kind](model, tmp_path), square)
    flat = replace(model, cameras={1: Camera("PINHOLE", 1200, 900, np.array([1020.0, 1020, 603, 447]))})
    with refused("undistorted-copies", InputError):
        import_poses(WRITERS[kind](flat, tmp_path), large)


def test_names_of_cameras_in_odm_with_and_without_version(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    """A shot names `v2 x`, ODM's `cameras.json` the same camera `x`, beside another one of the same size."""
    model, _ = surveyed
    folder = write.odm(model, tmp_path / "p")
    right, wrong = write.opensfm_camera(model), {**write.opensfm_camera(model), "focal_x": 0.5, "focal_y": 0.5}
    (folder / "cameras.json").write_text(json.dumps({"y": wrong, "x": right}))
    with refused("lens-missing", InputError):
        solved(folder)
    shots = folder / "odm_report/shots.geojson"
    shots.write_text(shots.read_text().replace('"filename"', '"camera": "v2 x", "filename"'))
    assert_same_cameras(solved(folder).model, model)


def test_columns_of_realityscan_in_any_order(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    model, _ = surveyed
    path = write.realityscan(model, tmp_path / "a.csv")
    rows = [line.lstrip("#").split(",") for line in path.read_text().splitlines()]
    order = np.random.default_rng(1).permutation(len(rows[0]))
    text = "\n".join(",".join(row[i] for i in order) for row in rows)
    path.write_text(f"#cameras 6\n#{text}\n")
    assert_same_cameras(solved(path).model, model)


def test_columns_of_realityscan_have_other_names_since_its_second_version(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    model, _ = surveyed
    path = write.realityscan(model, tmp_path / "a.csv")
    rows = path.read_text().splitlines()[1:]
    header = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
    path.write_text("\n".join([header, *rows]) + "\n")
    found = solved(path)
    assert_same_cameras(found.model, model)
    assert codes(found.remarks) == ["georeference-not-taken"]


def test_cameras_of_opf_without_a_file_are_left_out(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    """As in the project that the specification gives as an example."""
    model, _ = surveyed
    path = write.opf(model, tmp_path / "opf")
    listed = path.with_name("camera-list.json")
    document = json.loads(listed.read_text())
    del document["cameras"][1]
    listed.write_text(json.dumps(document))
    found = solved(path)
    assert "cameras-without-file" in codes(found.remarks)
    rest = np.delete(np.arange(6), 1)
    np.testing.assert_allclose(found.model.rotation_cam_from_local, model.rotation_cam_from_local[rest], atol=1e-6)
    assert len(found.model.obs_point) == len(model.of_images(rest).obs_point)


def test_points_of_opf_may_share_matches(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    """As in the glTF that the specification gives as an example."""
    path = write.opf(surveyed[0], tmp_path / "opf")
    file = path.with_name("ranges.bin")
    ranges = np.frombuffer(file.read_bytes(), "<u4").reshape(-1, 2).copy()
    ranges[1] = ranges[0]
    file.write_bytes(ranges.tobytes())
    found = solved(path).model
    first, second = (found.obs_xy_px[found.obs_point == point] for point in (0, 1))
    np.testing.assert_array_equal(first, second)
    assert len(first) > 1


def _edited(path: Path, edit: Callable[[str], str]) -> Path:
    path.write_text(edit(path.read_text()))
    return path


HOSTILE: dict[str, tuple[Callable[[SparseModel, Path], Path], str]] = {
    "mirrored": (
        lambda m, f: _edited(
            write.nerfstudio(m, f / "transforms.json"),
            lambda t: json.dumps(_with_matrix(json.loads(t), np.diag([1.0, 1.0, -1.0, 1.0]))),
        ),
        "rotation-impossible",
    ),
    "scaled": (
        lambda m, f: _edited(
            write.nerfstudio(m, f / "transforms.json"),
            lambda t: json.dumps(_with_matrix(json.loads(t), np.diag([2.0, 2.0, 2.0, 1.0]))),
        ),
        "rotation-impossible",
    ),
    "nan": (
        lambda m, f: _edited(write.metashape(m, f / "a.xml"), lambda t: t.replace("<k1>", "<k1>nan ")),
        "not-a-number",
    ),
    "far": (
        lambda m, f: _edited(
            write.realityscan(m, f / "a.csv"), lambda t: re.sub(r"image_001.jpg,[^,]*", "image_001.jpg,3e9", t)
        ),
        "position-impossible",
    ),
    "uri": (lambda m, f: write.opf(m, f / "opf", uri="../secret.gltf"), "file-outside-folder"),
    "draft": (
        lambda m, f: _edited(
            write.opf(m, f / "opf"), lambda t: t.replace('"version": "1.0"', '"version": "1.0-draft7"')
        ),
        "opf-version",
    ),
    "forged": (lambda m, f: _forged(write.opf(m, f / "opf")), "file-damaged"),
    "cut": (lambda m, f: _cut(write.opf(m, f / "opf")), "file-cut-off"),
    "entity": (
        lambda m, f: _edited(
            write.metashape(m, f / "a.xml"), lambda t: t.replace("?>", '?><!DOCTYPE d [<!ENTITY a "b">]>', 1)
        ),
        "xml-invalid",
    ),
    "no-focal": (
        lambda m, f: _edited(
            write.opensfm(m, f / "r.json"), lambda t: t.replace('"focal_x": 0.85', '"focal_x": -0.85')
        ),
        "focal-length-impossible",
    ),
    "sphere": (
        lambda m, f: _edited(write.opensfm(m, f / "r.json"), lambda t: t.replace('"brown"', '"spherical"')),
        "lens-not-convertible",
    ),
    "no-lens": (lambda m, f: _without_lens(write.odm(m, f / "p")), "lens-missing"),
}


def _with_matrix(document: dict[str, list[dict[str, object]]], by: np.ndarray) -> object:
    frame = document["frames"][2]
    frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ by).tolist()
    return document


def _forged(path: Path) -> Path:
    write.forged_range(path.parent, 1 << 20)
    return path


def _cut(path: Path) -> Path:
    (path.parent / "pixels.bin").write_bytes(b"")
    return path


def _without_lens(folder: Path) -> Path:
    (folder / "cameras.json").unlink()
    return folder


@pytest.mark.parametrize("kind", HOSTILE)
def test_nonsense_is_refused(surveyed: tuple[SparseModel, Survey], tmp_path: Path, kind: str) -> None:
    make, code = HOSTILE[kind]
    path = make(surveyed[0], tmp_path)
    with refused(code, InputError) as error:
        solved(path)
    assert error.value.path is not None


def test_a_path_is_answered_by_what_it_is(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    model, survey = surveyed
    write_sparse(model, tmp_path / "sparse")
    assert import_model(tmp_path / "sparse/images.bin", survey).num_reg_images() == 6
    for name, content, word in (
        ("project.psx", "<x/>", "Export Cameras"),
        ("cameras.json", json.dumps({"v2": write.opensfm_camera(model)}), "shots.geojson"),
        ("part.json", '{"format": "application/opf-calibrated-cameras+json"}', ".opf"),
        ("positions.csv", "name,x,y,z\na.jpg,1,2,3\n", ".csv"),
        ("empty.bin", "", ".bin"),
    ):
        (tmp_path / name).write_text(content)
        with refused("not-solved-cameras", InputError) as error:
            import_model(tmp_path / name, survey)
        assert word in error.value.message and error.value.path == tmp_path / name
    with refused("folder-missing", InputError):
        import_model(tmp_path / "nowhere", survey)


def test_files_are_found_in_the_folders_of_projects(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model, survey = surveyed
    folder = write.odm(model, tmp_path / "project")
    (folder / "opensfm").mkdir()
    whole = write.opensfm(model, folder / "opensfm/reconstruction.json")
    with caplog.at_level(logging.ERROR):
        assert import_poses(folder, survey)[1] == whole  # it has tie points, shots.geojson has none
    write.opf(model, tmp_path / "opf")
    assert import_poses(tmp_path / "opf", survey)[1] == tmp_path / "opf/project.opf"


def test_a_frame_of_another_scale_and_turn_is_a_similarity(
    surveyed: tuple[SparseModel, Survey], tmp_path: Path
) -> None:
    """A program's own world differs from `local`: the cameras agree up to a similarity."""
    model, survey = surveyed
    turn = Rotation.from_rotvec([1.0, -0.4, 2.0]).as_matrix()
    center = 30.0 * model.cam_center_in_local @ turn.T + [650_000.0, 5_100_000.0, 400.0]
    rotation = model.rotation_cam_from_local @ turn.T
    moved = replace(
        model,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=30.0 * model.point_in_local @ turn.T + [650_000.0, 5_100_000.0, 400.0],
    )
    found = flatten(import_model(write.opensfm(moved, tmp_path / "reconstruction.json"), survey))
    fitted = umeyama(found.cam_center_in_local, model.cam_center_in_local)
    np.testing.assert_allclose(fitted.apply(found.cam_center_in_local), model.cam_center_in_local, atol=1e-7)
    assert np.abs(found.cam_center_in_local).max() < 1e4


def test_files_beside_the_cameras_count_for_staleness(surveyed: tuple[SparseModel, Survey], tmp_path: Path) -> None:
    model, survey = surveyed
    workspace = write_workspace(tmp_path / "ws", survey, model)
    spec = BY_NAME["sfm"]

    def fingerprint(path: Path) -> str:
        return fingerprints(workspace, spec, SfmOptions(import_model=path), {}).hashes["--import"]

    beside = {
        write.opensfm(model, tmp_path / "reconstruction.json"): tmp_path / "tracks.csv",
        write.odm(model, tmp_path / "odm") / "odm_report/shots.geojson": tmp_path / "odm/cameras.json",
        write.opf(model, tmp_path / "opf"): tmp_path / "opf/pixels.bin",
    }
    for path, other in beside.items():
        before = fingerprint(path)
        assert fingerprint(path) == before
        other.write_bytes(other.read_bytes() + b" ")
        assert fingerprint(path) != before
