"""A survey that stands on another program's cameras is as accurate as one that stands on ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.core.progress import SILENT
from pipelines.formats.colmap import flatten
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.imported_model import ImportedModel, import_model
from pipelines.survey.survey import Survey
from tests import foreign_files as write
from tests.drawn_surveys import Flight, Receiver, drawn, flight, missed, surveyed
from tests.sfm_truth import Views, matched_views

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.usefixtures("one_thread")
Adjust = Literal["auto", "yes", "no"]
_FILES = {write.opensfm: "reconstruction.json", write.metashape: "cameras.xml", write.nerfstudio: "transforms.json"}
RTK = Receiver((0.02, 0.02, 0.03), (0.02, 0.02, 0.03))


def check_rmse(survey: Survey, model: SparseModel) -> np.ndarray:
    """RMSE (3,) of the check points along east, north, up."""
    points = geolocate(survey, model, GeolocateOptions()).points
    posterior, _ = estimate_similarity(survey, model, points, InitSim3Options())
    return np.sqrt(np.mean(missed(posterior, survey)[0] ** 2, axis=0))


def of_another_world(model: SparseModel, rng: np.random.Generator) -> SparseModel:
    """Cameras with other errors of 3 mm and 0.003° at 100 m, in a turned world of 46 mm units, on the Earth."""
    turn, size = Rotation.from_rotvec([0.7, 1.9, -0.4]).as_matrix(), np.ptp(model.cam_center_in_local)
    noise = exp_so3(np.radians(3e-3) * rng.normal(size=(len(model.image_name), 3)))
    center = model.cam_center_in_local + rng.normal(0, 3e-5 * size, model.cam_center_in_local.shape)
    points = model.point_in_local + rng.normal(0, 3e-5 * size, model.point_in_local.shape)
    rotation = noise @ model.rotation_cam_from_local @ turn.T
    center, points = (270.0 * xyz @ turn.T + [4.1e6, 6.2e5, 4.8e6] for xyz in (center, points))
    return replace(
        model,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=points,
    )


def test_check_points_are_as_good_as_with_our_own_model(tmp_path: Path) -> None:
    """Both have the errors that image observations leave; what a program adds shows by less than a fifth."""
    of = flight(16, 120, check=12)
    rng = np.random.default_rng(4)
    survey = surveyed(of, drawn(of, rng), RTK, 0.02, rng)
    foreign = of_another_world(of.model, rng)
    path = write.opensfm(foreign, tmp_path / "reconstruction.json")
    own, others = (check_rmse(survey, model) for model in (of.model, flatten(import_model(path, survey))))
    assert (others < 1.2 * own + 1e-3).all(), (own, others)  # 1 mm: of small errors a fifth is less


def with_errors(
    model: SparseModel, of: Flight, rng: np.random.Generator, position_m: float, turn_deg: float, focal: float
) -> SparseModel:
    """Cameras with errors of their own, and another focal length, in a turned world of other units."""
    turn, scale = Rotation.from_rotvec([0.7, 1.9, -0.4]).as_matrix(), 0.046
    error = position_m * np.ptp(model.cam_center_in_local) / np.ptp(of.scene.center_in_geo)
    noise = exp_so3(np.radians(turn_deg) * rng.normal(size=(len(model.image_name), 3)))
    rotation = noise @ model.rotation_cam_from_local @ turn.T
    center, points = (
        scale * (xyz + rng.normal(0, error, xyz.shape)) @ turn.T + [310.0, -20.0, 5.0]
        for xyz in (model.cam_center_in_local, model.point_in_local)
    )
    camera = model.cameras[1]
    lens = replace(camera, params=np.concatenate([camera.params[:2] * focal, camera.params[2:]]))
    return replace(
        model,
        cameras={1: lens},
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=points,
    )


def imported(
    path: Path,
    of: Flight,
    survey: Survey,
    monkeypatch: pytest.MonkeyPatch,
    adjust: Literal["auto", "yes", "no"] = "auto",
) -> SparseModel:
    """The model that the stage makes of a file, with the flight's own observations as matches."""
    scene, folder = of.scene, path.parent / "sfm"
    folder.mkdir()
    turned = np.swapaxes(scene.geo_from_cam, 1, 2)
    views = Views(list(scene.names), [1] * len(scene.names), turned, scene.center_in_geo)
    job = matched_views(folder, survey, views, {1: scene.camera}, scene.point_in_geo, noise_px=0.5, seed=3)
    for step in ("extract_features", "match_features"):  # The database has both already.
        monkeypatch.setattr(f"pipelines.sfm.known_poses.{step}", lambda *_: None)
    options = job.options.model_copy(update={"import_model": path, "adjust_imported": adjust})
    engine = ImportedModel.of(path, triangulates=False)
    return flatten(engine.reconstruct(replace(job, options=options), SILENT))


def file_in(folder: Path, write_file: Callable[[SparseModel, Path], Path]) -> Path:
    folder.mkdir()
    return folder / _FILES[write_file]


# Centimetres and degrees that cameras have from fixes and an IMU, of another camera constant, or none at all.
@pytest.mark.parametrize(
    ("write_file", "position_m", "turn_deg", "focal"),
    [
        (write.opensfm, 0.03, 0.05, 1.0),
        (write.metashape, 0.3, 0.05, 1.0),
        pytest.param(write.nerfstudio, 0.01, 0.01, 1.002, marks=pytest.mark.slow),
    ],
)
def test_errors_of_another_program_are_adjusted_away(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    write_file: Callable[[SparseModel, Path], Path],
    position_m: float,
    turn_deg: float,
    focal: float,
) -> None:
    """Its file has tie points or none; ours are adjusted from its cameras to where they are from our own."""
    of = flight(16, 250, check=12)
    rng = np.random.default_rng(7)
    survey = surveyed(of, of.scene, RTK, 0.02, rng)
    own = imported(write_file(of.model, file_in(tmp_path / "own", write_file)), of, survey, monkeypatch, "yes")
    foreign = with_errors(of.model, of, rng, position_m, turn_deg, focal)
    path = write_file(foreign, file_in(tmp_path / "foreign", write_file))
    caplog.clear()
    model = imported(path, of, survey, monkeypatch)
    assert "imported-cameras-adjusted" in codes(caplog)
    error_m, others_m = check_rmse(survey, own), check_rmse(survey, model)
    assert (others_m < 1.2 * error_m + 1e-3).all(), (error_m, others_m)


def test_cameras_at_the_minimum_stay_and_held_ones_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Exact cameras lower χ² by one a parameter when adjusted, by chance; those of 3 cm stay only on request."""
    of = flight(16, 250, check=12)
    survey = surveyed(of, of.scene, RTK, 0.02, np.random.default_rng(7))
    exact = imported(
        write.metashape(of.model, file_in(tmp_path / "exact", write.metashape)), of, survey, monkeypatch
    )
    assert not {"imported-cameras-adjusted", "imported-cameras-fit-worse"} & codes(caplog)
    same_shape(exact, of.model)
    foreign = with_errors(of.model, of, np.random.default_rng(7), 0.03, 0.05, 1.0)
    path = write.opensfm(foreign, file_in(tmp_path / "held", write.opensfm))
    held = imported(path, of, survey, monkeypatch, "no")
    assert "imported-cameras-fit-worse" in codes(caplog)
    same_shape(held, foreign)


def same_shape(model: SparseModel, other: SparseModel) -> None:
    """Centres of cameras agree in a frame that may be moved, turned and scaled, by 1e-6 of their extent."""
    placed = umeyama(model.cam_center_in_local, other.cam_center_in_local).apply(model.cam_center_in_local)
    extent = float(np.ptp(other.cam_center_in_local))
    np.testing.assert_allclose(placed, other.cam_center_in_local, rtol=0, atol=1e-6 * extent)


def codes(caplog: pytest.LogCaptureFixture) -> set[str]:
    return {getattr(record, "code", "") for record in caplog.records}
