"""Matches of photographs that stay out, sought where positions, attitudes and the model's depth predict them.

Plain matching compares a feature with all those of the other photograph. On rows of plants or roofs none is unique,
and of a photograph from far below the others, few are. Where the model is placed on Earth, fixes and attitudes
predict the camera of a photograph outside it; the photographs inside tell how far such a prediction is off.

1. A feature of a photograph of the model has the depth of the points around it. Its place, size and turn in the
   photograph outside follow.
2. Features are compared with those that lie within three σ of that place and agree with size and turn. The ratio
   test, a looser one, asks each to be unique among these alone, in both photographs.
3. The matches are verified like all others, together with those known before.
"""

import logging
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.colmap import lens_of_colmap
from pipelines.geometry.cameras import Camera, Reconstruction, bearings, project
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.statistics import NORMAL_MAD
from pipelines.sfm.colmap_database import add_matches, copy_database, finish_database, remove_database
from pipelines.sfm.features import SfmJob, verify_matches
from pipelines.sfm.near_matches import Expected, SiftFeatures, matches_near
from pipelines.sfm.parts import placed_by_positions
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

_FEWEST_REGISTERED = 6  # with fix and attitude: they tell the σ of a prediction
_SIGMAS = 3.0
_NEAREST = 5  # registered photographs whose errors a prediction shares
_FEWEST_SEEN = 10  # points of a photograph of the model that the one outside is predicted to show
_MOST_NEAR = 40  # photographs of the model, the nearest ones, that are asked for it
_MOST_PARTNERS = 8  # of a photograph: those with most such points
_MOST_PAIRS = 400  # of all photographs outside
_POINTS_AROUND = 5  # of the model, that give a feature its depth
_MOST_DISTANCE = 0.8  # of two descriptors of length one
_RATIO = 0.9  # of the distance of the best over that of the second; of plain matching 0.8
_FEWEST_MATCHES = 15  # COLMAP's fewest inliers of a pair
_LEAST_SIGMA_PX = 3.0


@dataclass(frozen=True)
class _View:
    """Camera of a photograph in the model's frame: rotation (3, 3) camera ← model and centre (3,)."""

    camera: Camera
    rotation: FloatArray
    center: FloatArray

    def pixels(self, point: FloatArray) -> FloatArray:
        return project(self.camera, (point - self.center) @ self.rotation.T)


@dataclass(frozen=True)
class _ModelPhotograph:
    """Photograph of a model: its camera, and pixels (N, 2) and places (N, 3) of the points that it shows."""

    view: _View
    xy_px: FloatArray
    point: FloatArray


@dataclass(frozen=True)
class _Prediction:
    """Where cameras are, by fix and attitude: `geo_from_model`, errors of the registered, and σ.

    `fixes` (K, 3) and `error` (K, 3) are in geo, `boresight` is a rotation vector in each camera's frame, by its
    number: lenses of a rig look elsewhere.
    """

    geo_from_model: Similarity
    fixes: FloatArray
    error: FloatArray
    boresight: dict[int, FloatArray]
    sigma_m: float
    sigma_rad: float


def add_predicted(colmap: ModuleType, job: SfmJob, model: Reconstruction, progress: Progress) -> int:
    """Add predicted matches of the photographs outside a model to those in the database, and verify them.

    Returns:
        The number of pairs that have got matches; 0 where positions and attitudes predict nothing.
    """
    prediction = _prediction(model, job.survey)
    if prediction is None:
        return 0
    outside = _outside(model, job.survey, prediction)
    inside = {key: _model_photograph(model, key) for key in sorted(model.reg_image_ids())}
    matches: dict[tuple[int, int], IntArray] = {}
    pairs = 0
    with colmap.Database.open(job.database) as opened, progress.task("predicted matches", len(outside)) as task:
        for key, view in outside.items():
            features = SiftFeatures.read(opened, key)
            for other in _partners(view, inside, prediction)[: _MOST_PAIRS - pairs]:
                theirs = SiftFeatures.read(opened, other)
                expected = _expected(theirs, inside[other], view, prediction)
                rows = matches_near(theirs, features, expected, ratio=_RATIO, most_distance=_MOST_DISTANCE)
                if len(rows) >= _FEWEST_MATCHES:
                    pair = (min(key, other) - 1, max(key, other) - 1)
                    matches[pair] = rows if other < key else rows[:, ::-1]
                pairs += 1
            task.advance()
    if matches:
        draft = job.database.with_name("predicted.db")
        remove_database(draft)
        copy_database(job.database, draft)
        add_matches(colmap, draft, matches)
        verify_matches(colmap, replace(job, database=draft), np.array(sorted(matches), dtype=np.int64), progress)
        finish_database(draft, job.database)
        remove_database(draft)
    return len(matches)


def _prediction(model: Reconstruction, survey: Survey) -> _Prediction | None:
    """Return how fixes and attitudes predict cameras of a model; None: they do not place it, or are too few."""
    measured = {image.name: image for image in survey.images}
    geo_from_model = placed_by_positions(model, measured)
    if isinstance(geo_from_model, str):
        return None
    fixes, error, turns, cameras = [], [], [], []
    for key in sorted(model.reg_image_ids()):
        image = model.images[key]
        fix, attitude = measured[image.name].fix, measured[image.name].attitude
        if fix is None or attitude is None:
            continue
        fixes.append(fix.position_in_geo)
        error.append(geo_from_model.apply(image.projection_center()[None])[0] - fix.position_in_geo)
        geo_from_cam = geo_from_model.rotation @ image.cam_from_world().rotation.matrix().T
        cameras.append(image.camera_id)
        turns.append(log_so3(matrix_from_quat_xyzw(attitude.quat_xyzw).T @ geo_from_cam))
    if len(fixes) < _FEWEST_REGISTERED:
        return None
    at, off, turned, camera = (np.array(column) for column in (fixes, error, turns, cameras))
    boresight = {int(key): np.median(turned[camera == key], axis=0) for key in np.unique(camera)}
    turned -= np.array([boresight[key] for key in camera.tolist()])
    rows = range(len(at))
    near = [_error_near(at[row], np.delete(at, row, axis=0), np.delete(off, row, axis=0)) for row in rows]
    apart = off - np.array(near)
    sigma_m, sigma_rad = (NORMAL_MAD * float(np.median(np.abs(each))) for each in (apart, turned))
    # Fixes near one line leave a tilt of the model about it, which attitudes of one heading take for a boresight.
    _, width_m, _ = np.linalg.svd(at - at.mean(axis=0), compute_uv=False)  # √N times the extent
    sigma_rad = float(np.hypot(sigma_rad, sigma_m / max(float(width_m), sigma_m)))
    return _Prediction(geo_from_model, at, off, boresight, sigma_m, sigma_rad)


def _error_near(position: FloatArray, fixes: FloatArray, error: FloatArray) -> FloatArray:
    """Return the error (3,) of fixes around a position: neighbours share most of it."""
    near = np.linalg.norm(fixes - position, axis=1).argsort()[:_NEAREST]
    return np.asarray(np.median(error[near], axis=0))


def _outside(model: Reconstruction, survey: Survey, prediction: _Prediction) -> dict[int, _View]:
    """Return predicted cameras, in the model's frame, of photographs that are not in it, by COLMAP's numbers."""
    inside = set(model.reg_image_ids())
    back = prediction.geo_from_model.inverse()
    views = {}
    for key, image in enumerate(survey.images, start=1):
        if (
            key in inside
            or image.fix is None
            or image.attitude is None
            or image.camera_id not in prediction.boresight
        ):
            continue
        position = np.array(image.fix.position_in_geo)
        position = position + _error_near(position, prediction.fixes, prediction.error)
        geo_from_cam = matrix_from_quat_xyzw(image.attitude.quat_xyzw) @ exp_so3(
            prediction.boresight[image.camera_id]
        )
        rotation = geo_from_cam.T @ prediction.geo_from_model.rotation
        views[key] = _View(lens_of_colmap(model.cameras[image.camera_id]), rotation, back.apply(position[None])[0])
    return views


def _model_photograph(model: Reconstruction, key: int) -> _ModelPhotograph:
    image = model.images[key]
    view = _View(
        lens_of_colmap(model.cameras[image.camera_id]),
        image.cam_from_world().rotation.matrix(),
        image.projection_center(),
    )
    seen = [point for point in image.points2D if point.has_point3D()]
    xy = np.array([point.xy for point in seen]).reshape(-1, 2)
    return _ModelPhotograph(
        view, xy, np.array([model.points3D[point.point3D_id].xyz for point in seen]).reshape(-1, 3)
    )


def _partners(view: _View, inside: dict[int, _ModelPhotograph], prediction: _Prediction) -> list[int]:
    """Return the photographs of the model that show most points that a camera is predicted to show."""
    size = np.array([view.camera.width, view.camera.height])
    near = sorted(inside, key=lambda key: float(np.linalg.norm(inside[key].view.center - view.center)))
    count = {}
    for key in near[:_MOST_NEAR]:
        point = inside[key].point
        xy, away = view.pixels(point), np.linalg.norm(point - view.center, axis=1)
        margin = _SIGMAS * _sigma_px(view, away, prediction)[:, None]
        with np.errstate(invalid="ignore"):
            count[key] = int(((xy > -margin) & (xy < size + margin)).all(axis=1).sum())
    most = sorted(count, key=lambda key: -count[key])[:_MOST_PARTNERS]
    return [key for key in most if count[key] >= _FEWEST_SEEN]


def _sigma_px(view: _View, away: FloatArray, prediction: _Prediction) -> FloatArray:
    """Return σ (N,) of the places of points at distances (N,) in a predicted camera."""
    sigma_rad = np.hypot(prediction.sigma_m / (prediction.geo_from_model.scale * away), prediction.sigma_rad)
    return np.asarray(view.camera.mean_focal_px * sigma_rad)


def _expected(
    features: SiftFeatures, photograph: _ModelPhotograph, other: _View, prediction: _Prediction
) -> Expected:
    """Return where the features of a photograph of the model are expected in another one."""
    view, tree = photograph.view, cKDTree(photograph.xy_px)
    distance = np.linalg.norm(photograph.point - view.center, axis=1)
    xy_px = features.xy_px.astype(np.float64)
    around = distance[tree.query(xy_px, k=_POINTS_AROUND)[1]]
    near, middle, far = np.quantile(around, [0.25, 0.5, 0.75], axis=1)

    def places(ray: FloatArray, reach: FloatArray) -> FloatArray:
        return view.center + reach[:, None] * (ray @ view.rotation)

    ray, tip_ray = (bearings(view.camera, px) for px in (xy_px, xy_px + features.axis_px))
    point = places(ray, middle)
    xy, tip = other.pixels(point), other.pixels(places(tip_ray, middle))
    away = np.linalg.norm(point - other.center, axis=1)
    by_depth = np.linalg.norm(other.pixels(places(ray, far)) - other.pixels(places(ray, near)), axis=1)
    by_pose = _sigma_px(other, away, prediction)
    radius = _SIGMAS * np.hypot(np.hypot(by_pose, by_depth), _LEAST_SIGMA_PX)
    known = np.isfinite(xy).all(axis=1) & np.isfinite(tip).all(axis=1) & np.isfinite(radius)
    place, axis = (np.where(known[:, None], each, 0.0).astype(np.float32)[:, None] for each in (xy, tip - xy))
    return Expected(place, np.where(known, radius, 0.0).astype(np.float32)[:, None], axis)
