"""Rigs of several lenses: one pose an instant, and the lenses' places in the rig, against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.geometry.similarity import umeyama
from pipelines.sfm.colmap_reconstruction import map_matches
from pipelines.sfm.features import SfmJob
from pipelines.sfm.rigs import hold_in_body, reference_alone
from pipelines.survey.survey import Companion, Fix, Survey
from tests.refusals import logged_codes
from tests.sfm_truth import Views, matched_views, survey_of_views

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

HEIGHT_M = 60.0
LENSES = {
    key: Camera("SIMPLE_RADIAL", 640, 480, np.array([focal, 320.0, 240.0, bend]))
    for key, focal, bend in ((1, 540.0, -0.05), (2, 548.0, -0.04), (3, 533.0, -0.06), (4, 537.0, -0.05))
}
# Places of lenses in the rig, in metres: of a multispectral camera, and of one at the other end of a boom.
OFFSET_M = np.array([[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0.5, 0.03, 0.05]])
BLANK = 5  # instant at which the reference lens shows nothing
# A photograph with ten times as many features has noise of 0.3 px for the same σ.
NOISE_PX = 0.1
TURN = np.radians([[0, 0, 0], [0.5, -0.3, 0.2], [-0.4, 0.6, -0.3], [0.2, 0.4, 0.5]])


def scene(folder: Path) -> tuple[SfmJob, FloatArray]:
    """A job of 12 instants of four lenses, three lines to and fro, and the centres (12, 4, 3)."""
    rng = np.random.default_rng(7)
    place = np.array(
        [(16.0 * (k if line % 2 else 3 - k), 18.0 * line, HEIGHT_M) for line in range(3) for k in range(4)]
    )
    place += rng.normal(0, 1.0, place.shape)
    rig_from_world = [exp_so3(rng.normal(0, 0.05, 3)) @ np.diag([1.0, -1.0, -1.0]) for _ in place]
    lens_from_rig = [exp_so3(turn) for turn in TURN]
    center = np.array(
        [[at + rig.T @ off for off in OFFSET_M] for at, rig in zip(place, rig_from_world, strict=True)]
    )
    rotation = np.array([[lens @ rig for lens in lens_from_rig] for rig in rig_from_world])
    order = [(k, lens) for lens in range(4) for k in range(len(place))]  # companions follow the reference
    views = Views(
        [f"{k:02d}_{lens}.tif" for k, lens in order],
        [lens + 1 for _, lens in order],
        np.array([rotation[at] for at in order]),
        np.array([center[at] for at in order]),
    )
    point = rng.uniform((-35, -35, -4), (85, 72, 4), (900, 3))
    survey = survey_of_views(views, LENSES)
    companions = tuple(
        Companion(
            name=f"{k:02d}_{lens}.tif",
            camera_id=lens + 1,
            sha256="",
            beside=f"{k:02d}_0.tif",
            stated_quat_xyzw=tuple(quat_xyzw_from_matrix(lens_from_rig[lens]).tolist()),
        )
        for k, lens in order
        if lens
    )
    survey = survey.model_copy(update={"companions": companions})
    shown = np.ones((len(order), len(point)))
    shown[BLANK] = 0
    return matched_views(folder, survey, views, LENSES, point, noise_px=NOISE_PX, shown=shown), center


def offsets_in_rig(model: Any, center: FloatArray) -> FloatArray:
    """Errors (12, 3) in metres of the lenses' places beside the reference of their instant; NaN: not solved."""
    by_name = {model.images[key].name: model.images[key] for key in model.reg_image_ids()}
    solved = np.full(center.shape, np.nan)
    for k, lens in np.ndindex(center.shape[:2]):
        if (image := by_name.get(f"{k:02d}_{lens}.tif")) is not None:
            solved[k, lens] = image.projection_center()
    place = umeyama(solved[:, 0], center[:, 0])
    placed = place.apply(solved)
    return np.asarray(np.linalg.norm((placed - placed[:, :1]) - (center - center[:, :1]), axis=2)[:, 1:])


def _is_put_into_its_body(model: Any, survey: Survey, center: FloatArray) -> None:
    """Of lenses of one body, one cannot be half a metre away: at the reference's place it sees the same ground."""
    cameras = tuple(prior.model_copy(update={"serial": "7", "make_model": "M"}) for prior in survey.cameras)
    images = []
    for image in survey.images:
        k, lens = map(int, image.name[:-4].split("_"))
        covariance = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        x, y, z = center[k, lens].tolist()
        fix = Fix(position_in_geo=(x, y, z), cov_in_geo=covariance, source="csv", sigma_source="file")
        images.append(image.model_copy(update={"fix": fix}))
    held, references = type(model)(model), dict.fromkeys((2, 3, 4), 1)
    assert not hold_in_body(pycolmap, held, survey, references)
    survey = survey.model_copy(update={"cameras": cameras, "images": tuple(images)})
    assert hold_in_body(pycolmap, held, survey, references)
    place = {sensor.id: pose.translation for sensor, pose in held.rigs[1].non_ref_sensors.items()}
    assert [bool(np.any(place[key])) for key in (2, 3, 4)] == [True, True, False]
    # 0.5 m of 60 m are 4.5 px, which rotation and focal length take; the relief of 4 m leaves 0.3 px.
    held.update_point_3d_errors()
    assert held.compute_mean_reprojection_error() < 0.3


@pytest.mark.slow
def test_the_lenses_of_an_instant_keep_their_places(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """At 60 m, where a pixel is 11 cm; the rig places the photograph that matches none."""
    job, center = scene(tmp_path)
    model, _ = map_matches(pycolmap, job, SILENT)
    assert model.num_reg_images() == center.shape[0] * center.shape[1]
    assert model.num_reg_frames() == len(center)
    error_m = offsets_in_rig(model, center)
    print(error_m.max(axis=0))
    assert error_m.max() < 0.02
    assert not logged_codes(caplog)
    _is_put_into_its_body(model, job.survey, center)
    alone = reference_alone(model, job.survey)
    assert sorted(alone.images[key].name for key in alone.reg_image_ids()) == [f"{k:02d}_0.tif" for k in range(12)]
    assert alone.is_valid()
    for image in alone.images.values():
        same = next(each for each in model.images.values() if each.name == image.name)
        np.testing.assert_allclose(image.cam_from_world().matrix(), same.cam_from_world().matrix(), atol=1e-12)
