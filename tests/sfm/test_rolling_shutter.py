"""Rolling shutter: tie points, marks and photographs are moved to where a global shutter would have shown them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipelines.core.products import save_json
from pipelines.core.types import FloatArray
from pipelines.formats.colmap import ROLLING_SHUTTER, flatten, load_reconstruction, read_sparse, write_sparse
from pipelines.geometry.cameras import Camera
from pipelines.geometry.rolling_shutter import depths_at, in_global_shutter, in_rolling_shutter
from pipelines.geometry.rotations import geo_from_cam
from pipelines.geometry.similarity import umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.readout_times import with_readouts, with_velocities
from pipelines.ingest.remarks import Remarks
from pipelines.sfm.adjustment import adjust_finally
from pipelines.sfm.global_shutter_points import correct_tie_points
from pipelines.simulate.lens import BrownLens, Pose
from pipelines.survey.marks import bearings_at
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.scene import _rolling_shift
from pipelines.survey.survey import CameraPrior, Fix, Survey, SurveyImage
from tests.sfm_scenes import survey_of

pycolmap = pytest.importorskip("pycolmap")

READOUT_S, SPEED_M_S, HEIGHT_M = 0.03, 15.0, 60.0
LENS = BrownLens("opencv", 640, 480, 544.0, (322.0, 238.0), -0.045, 0.012, 4e-4, -3e-4)
CAMERA = Camera("OPENCV", 640, 480, np.array(LENS.colmap_params))
IDENTITY = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))


def flight() -> list[Pose]:
    """Three lines of six photographs, there and back, with headings along the flight."""
    poses = []
    for line in range(3):
        ahead = 1.0 if line % 2 == 0 else -1.0
        for step in range(6):
            center = np.array([15.0 * ahead * (step - 2.5), 18.0 * line, HEIGHT_M])
            turn = geo_from_cam([90.0 * ahead, -88.0 + line, 2.0 * (step % 2)])
            poses.append(Pose(center, turn, np.array([ahead * SPEED_M_S * READOUT_S, 0.0, 0.0])))
    return poses


def seen_by(pose: Pose, points: np.ndarray) -> np.ndarray:
    """Return the pixels of points as a rolling shutter shows them, by the simulator's own lens."""
    share = np.full(len(points), 0.5)
    for _ in range(8):
        pixels = LENS.project((points - pose.at_row(share)) @ pose.geo_from_cam)
        share = pixels[:, 1] / LENS.height
    return pixels


def true_model(poses: list[Pose], points: np.ndarray) -> SparseModel:
    """Return the true cameras and points, with the observations of a rolling shutter, a tenth of a pixel off."""
    rows, noise = [], np.random.default_rng(1).normal(0, 0.03, (len(poses), len(points), 2))
    for image, pose in enumerate(poses):
        xy = seen_by(pose, points)
        inside = (xy > 4).all(axis=1) & (xy < [636, 476]).all(axis=1)
        rows += [(point, image, *(xy[point] + noise[image, point])) for point in np.flatnonzero(inside)]
    table = np.array(sorted(rows))
    several = np.bincount(table[:, 0].astype(int), minlength=len(points))[table[:, 0].astype(int)] >= 3
    table = table[several]
    kept, point = np.unique(table[:, 0].astype(int), return_inverse=True)
    rotation = np.array([pose.geo_from_cam.T for pose in poses])
    center = np.array([pose.center for pose in poses])
    return SparseModel(
        cameras={1: CAMERA},
        image_id=np.arange(1, len(poses) + 1),
        image_name=tuple(f"{image:02d}.jpg" for image in range(len(poses))),
        image_camera_id=np.ones(len(poses), dtype=np.int64),
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_id=np.arange(1, len(kept) + 1),
        point_in_local=points[kept],
        point_rgb=np.zeros((len(kept), 3), dtype=np.uint8),
        point_error_px=np.full(len(kept), np.nan),
        obs_point=point.astype(np.int64),
        obs_image=table[:, 1].astype(np.int64),
        obs_xy_px=table[:, 2:],
    )


def rms_m(model: object, poses: list[Pose], points: np.ndarray) -> float:
    """Return the RMS error of the points, after an alignment by the cameras alone."""
    flat = flatten(model)
    fitted = umeyama(flat.cam_center_in_local, np.array([pose.center for pose in poses]))
    apart, _ = cKDTree(points).query(fitted.apply(flat.point_in_local))
    return float(np.sqrt(np.square(apart).mean()))


def surveyed(folder: Path) -> tuple[list[Pose], FloatArray, Survey]:
    """Return a fast flight, points on the ground, and its survey; the model that its shutter shows is written."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-60, 60, 1000), rng.uniform(-30, 66, 1000), rng.uniform(0, 12, 1000)])
    poses = flight()
    write_sparse(true_model(poses, points), folder)
    names = [f"{image:02d}.jpg" for image in range(len(poses))]
    survey = survey_of(names)
    camera = survey.cameras[0].model_copy(update={"readout_s": READOUT_S, "width": 640, "height": 480})
    images = [
        SurveyImage(
            name=name,
            camera_id=1,
            sha256="",
            fix=Fix(position_in_geo=tuple(pose.center), cov_in_geo=IDENTITY, source="csv", sigma_source="file"),
            velocity_in_geo=tuple(pose.travel / READOUT_S),
        )
        for name, pose in zip(names, poses, strict=True)
    ]
    return poses, points, survey.model_copy(update={"cameras": (camera,), "images": tuple(images)})


@pytest.mark.slow
def test_a_photograph_that_has_lost_its_points_is_no_obstacle(tmp_path: Path) -> None:
    poses, _, survey = surveyed(tmp_path)
    model, last = load_reconstruction(tmp_path), len(poses)
    for row, point in enumerate(model.images[last].points2D):
        if point.has_point3D():
            model.delete_observation(last, row)
    corrected, _ = correct_tie_points(model, survey, lambda each: adjust_finally(pycolmap, each, threads=1))
    assert corrected.images[last].num_points3D == 0 < corrected.images[last - 1].num_points3D


@pytest.mark.slow
def test_tie_points_marks_and_photographs_of_a_fast_flight(tmp_path: Path) -> None:
    poses, points, survey = surveyed(tmp_path)
    still = [replace(pose, travel=np.zeros(3)) for pose in poses]
    write_sparse(true_model(still, points), tmp_path / "still")
    raw, global_ = (load_reconstruction(folder) for folder in (tmp_path, tmp_path / "still"))
    adjust_finally(pycolmap, raw, threads=1)
    adjust_finally(pycolmap, global_, threads=1)
    model, shutter = correct_tie_points(raw, survey, lambda each: adjust_finally(pycolmap, each, threads=1))
    assert shutter is not None
    # Velocities of the other sign make the observations worse, and are refused.
    back = [
        each.model_copy(update={"velocity_in_geo": tuple(-np.array(each.velocity_in_geo))})
        for each in survey.images
    ]
    wrong = survey.model_copy(update={"images": tuple(back)})
    kept, none = correct_tie_points(raw, wrong, lambda each: adjust_finally(pycolmap, each, threads=1))
    assert kept is raw and none is None
    # Rows are off by up to 2 px; what is left are the marks' own tenth of a pixel, and the drift of the model.
    assert rms_m(model, poses, points) < 1.2 * rms_m(global_, poses, points) < 0.4 * rms_m(raw, poses, points)

    # Marks between tie points, and rays of the corrected photograph, have the depth of the points around them.
    folder = tmp_path / "corrected"
    write_sparse(flatten(model), folder)
    save_json(shutter, folder / ROLLING_SHUTTER)
    sparse = read_sparse(folder)
    place = np.array([[2.0, 8.0, 6.0]])
    pixel = seen_by(poses[2], place)
    in_cam = (place - poses[2].center) @ poses[2].geo_from_cam
    exact = in_cam[0, :2] / in_cam[0, 2]
    bearing = bearings_at(sparse, 2, pixel)[0]
    off_px = 544 * np.linalg.norm(bearing[:2] / bearing[2] - exact)
    # Relief of 6 m about the mean depth is a ninth of a motion of 2 px; the lens was adjusted besides.
    assert off_px < 0.4

    shift = _rolling_shift(sparse, 2)
    assert shift is not None
    y, x = np.mgrid[0:480, 0:640]
    assert sparse.travel_in_cam is not None
    depth, travel = float(np.median(depths_at(sparse, 2, sparse.obs_xy_px[:9]))), sparse.travel_in_cam[2]
    stripes = (127 + 120 * np.sin(x / 9.0) * np.sin(y / 11.0)).astype(np.float32)
    full = np.stack([x, y], axis=-1) + 0.5
    moved = in_global_shutter(CAMERA, full.reshape(-1, 2), np.full(x.size, 54.0), travel * 54.0 / depth)
    seen = moved.reshape(480, 640, 2).astype(np.float32) - 0.5
    photo = cv2.remap(stripes, seen[..., 0], seen[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    cv2.imwrite(str(tmp_path / "a.png"), photo)
    cv2.imwrite(str(tmp_path / "b.png"), stripes)
    shots = [Photograph("a", tmp_path / "a.png", CAMERA, "", shift), Photograph("b", tmp_path / "b.png", CAMERA)]
    cache = ImageCache(tmp_path / "cache", shots, 640)
    mask = cache.mask(0)
    assert 0 < cache.mask(1).sum() - mask.sum() < 8 * (640 + 480)
    corrected, truth = cache.image(0).astype(float), cache.image(1).astype(float)
    # Relief about the mean depth, and two interpolations, leave a part.
    assert np.abs(corrected - truth)[mask].mean() < 0.35 * np.abs(photo - stripes)[mask].mean()


def test_correction_and_its_inverse() -> None:
    rng = np.random.default_rng(2)
    xy, depth = rng.uniform([5, 5], [635, 475], (200, 2)), rng.uniform(40, 80, 200)
    travel = np.array([0.1, -0.45, 0.05])
    seen = in_rolling_shutter(CAMERA, xy, depth, travel)
    assert np.abs(seen - xy).max() > 2
    np.testing.assert_allclose(in_global_shutter(CAMERA, seen, depth, travel), xy, atol=1e-4)


def test_readout_and_velocity_from_table_and_positions() -> None:
    remarks = Remarks()
    prior = CameraPrior(
        camera_id=1, model="SIMPLE_RADIAL", width=4000, height=2250, params=(1.0,), focal_source="exif"
    )
    cameras = [prior.model_copy(update={"make_model": model}) for model in ("DJI FC300S", "Hasselblad L1D-20c", "")]
    assert [camera.readout_s for camera in with_readouts(cameras, IngestOptions(), remarks)] == [0.033, 0.047, 0]
    assert [remark.code for remark in remarks.assumptions] == ["rolling-shutter"] * 2
    given = with_readouts(cameras, IngestOptions(rolling_shutter=0.02), remarks)
    assert {camera.readout_s for camera in given} == {0.02}

    turn = np.array([[0, 0, 50], [20, 0, 50], [40, 0, 50], [60, 0, 50], [80, 0, 50]], dtype=float)
    images = [
        SurveyImage(
            name=f"{row}.jpg",
            camera_id=1,
            sha256="",
            timestamp_s=time_s,
            fix=Fix(position_in_geo=tuple(place), cov_in_geo=IDENTITY, source="csv", sigma_source="file"),
        )
        for row, (place, time_s) in enumerate(zip(turn, (0.0, 2.0, 4.0, 100.0, 200.0), strict=True))
    ]
    moving = with_velocities(images, given[:1], None, IngestOptions(), remarks)
    assert [image.velocity_in_geo for image in moving] == [(10.0, 0.0, 0.0)] * 3 + [None] * 2
    assert "velocity-unknown" in [remark.code for remark in remarks.warnings]
