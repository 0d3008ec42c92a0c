"""The survey's measurements of the registered images: as arrays, and as terms of the adjustment."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.adjust.alignment import Correspondences, RotationPrior, mean_rotation
from pipelines.adjust.drift import drift_shapes
from pipelines.adjust.level import level_of
from pipelines.adjust.state import (
    SIGMA_ARM_M,
    SIGMA_BORESIGHT_RAD,
    SIGMA_LIDAR_M,
    State,
    SystematicError,
    SystematicErrors,
)
from pipelines.adjust.system import Problem
from pipelines.adjust.terms import (
    At,
    Attitudes,
    ControlPoints,
    Distances,
    EarlierPoints,
    Fixes,
    Level,
    LocalFrame,
    Planes,
    Term,
)
from pipelines.core.errors import InputError
from pipelines.core.sentences import listed
from pipelines.core.types import BoolArray, FloatArray, IntArray, Vector3, rows_of, vector3
from pipelines.geodesy.enu import Origin
from pipelines.geometry.cameras import bearings
from pipelines.geometry.intersection import NearestPoints
from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.marks import MarkRays, RayErrors, intersect_marks, mark_angles, mark_rays
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import EarlierDate, MeasurementVerdict
from pipelines.survey.survey import MountParameter, Survey

_INCONSISTENT_SIGMAS = 6.0
_INCONSISTENT_RAD = np.radians(15.0)  # lower limit, because the σ of attitudes are often optimistic
_WIDE_RAD = 1.0
_TINY = 1e-9  # σ of exact values, where a covariance must be regular
_LEAST_SIGMA_COMMON_M = 1e-4  # of an axis without a common error, where another axis has one


@dataclass(frozen=True)
class RecordedRotations:
    """Recorded attitudes of k registered images, without the images that disagree with the SfM model."""

    image: IntArray  # (k,) index into the model's images
    geo_from_cam: FloatArray  # (k, 3, 3)
    sigma_rad: FloatArray  # (k,) per axis
    inconsistent: tuple[str, ...]  # names of the images left out


@dataclass(frozen=True)
class UnusedControlPoint:
    """Control point that its marks do not determine."""

    name: str
    unregistered: tuple[str, ...]  # names of the images with marks that are not in the SfM model
    registered: tuple[str, ...]  # names of the images with usable marks
    # Angles between these marks and the point that most of them agree on, else their least-squares point, in
    # pixels; infinite: the rays are parallel
    residual_px: tuple[float, ...] = ()

    @property
    def sentence(self) -> str:
        """Reason for people: images that are missing, or marks that do not meet."""
        missing = f" ({listed(self.unregistered)} not registered)" if self.unregistered else ""
        if len(self.registered) < 2:
            return (
                f"Control point {self.name} is marked in fewer than two registered images{missing}; it is not used."
            )
        marks = sorted(zip(self.residual_px, self.registered, strict=True), reverse=True)
        rays = f"Control point {self.name} is not used: the rays of its {len(marks)} marks"
        if not np.isfinite(self.residual_px).all():
            return f"{rays} are parallel ({listed(self.registered)}). Check the marks."
        rms = float(np.sqrt(np.mean(np.square(self.residual_px))))
        worst = listed(tuple(f"{image} {residual:.1f} px" for residual, image in marks))
        return f"{rays} miss one point by up to {marks[0][0]:.1f} px, RMS {rms:.1f} px ({worst}). Check the marks."


def fix_correspondences(survey: Survey, model: SparseModel) -> Correspondences:
    """Return the camera centres of registered images with their fixes.

    SfM's own error of a centre is not known at this point (zero covariance). The adjustment measures it as excess
    scatter.
    """
    fixes = {image.name: image.fix for image in survey.images if image.fix is not None}
    fixed = [(index, name) for index, name in enumerate(model.image_name) if name in fixes]
    return Correspondences(
        name=tuple(name for _, name in fixed),
        control=np.zeros(len(fixed), dtype=bool),
        in_local=model.cam_center_in_local[[index for index, _ in fixed]].reshape(-1, 3),
        cov_in_local=np.zeros((len(fixed), 3, 3)),
        in_geo=np.array([fixes[name].position_in_geo for _, name in fixed]).reshape(-1, 3),
        cov_in_geo=np.array([fixes[name].cov_apart for _, name in fixed]).reshape(-1, 3, 3),
    )


def control_correspondences(
    survey: Survey, model: SparseModel
) -> tuple[Correspondences, tuple[UnusedControlPoint, ...]]:
    """Return the control points, intersected in local from their marks, with their survey; and those left out.

    A point that its marks do not determine is left out. The covariance in local is that of the marks
    alone. The model's own error is not known at this point: the adjustment measures it as excess scatter.
    """
    points = survey.control_points
    rays = mark_rays(points, model)
    marked = rays.marks_of_point >= 2
    position, cov, meets = intersect_in_local(model, rays.of_points(marked))
    used = marked.copy()
    used[marked] = meets
    meeting = [point for point, is_used in zip(points, used, strict=True) if is_used]
    return Correspondences(
        name=tuple(point.name for point in meeting),
        control=np.ones(len(meeting), dtype=bool),
        in_local=position[meets],
        cov_in_local=cov[meets],
        in_geo=np.array([point.position_in_geo for point in meeting]).reshape(-1, 3),
        cov_in_geo=np.array([point.cov_in_geo for point in meeting]).reshape(-1, 3, 3),
    ), _unused(survey, model, rays.of_points(~used))


def positions_in_use(
    survey: Survey, model: SparseModel, data: Correspondences, unused: tuple[UnusedControlPoint, ...]
) -> str:
    """Return how many fixes and control points there are, how many are used, and why the others are not."""
    fixes, control = int((~data.control).sum()), int(data.control.sum())
    counts = (
        f"{len(model.image_name)} of {len(survey.images)} images are registered. {fixes} of "
        f"{sum(image.fix is not None for image in survey.images)} fixes and {control} of "
        f"{len(survey.control_points)} control points are used."
    )
    return " ".join([counts, *(point.sentence for point in unused)])


def _unused(survey: Survey, model: SparseModel, rays: MarkRays) -> tuple[UnusedControlPoint, ...]:
    position, *_ = intersect_in_local(model, rays)
    # Where the rays disagree, none is left: within a wide σ they meet in the least-squares point.
    wide = RayErrors(_TINY, _TINY, _WIDE_RAD)
    compromise = intersect_marks(rays, model.rotation_cam_from_local, model.cam_center_in_local, wide)
    position = np.where(np.isfinite(position), position, compromise.position_in_geo)
    angle = mark_angles(rays, position, model.rotation_cam_from_local, model.cam_center_in_local)
    residual_px = np.nan_to_num(angle * rays.sigma_px / rays.sigma_rad, nan=np.inf)
    marks = {point.name: point.marks for point in survey.control_points}
    registered = model.image_index()
    return tuple(
        UnusedControlPoint(
            name=name,
            unregistered=tuple(mark.image for mark in marks[name] if mark.image not in registered),
            registered=tuple(model.image_name[camera] for camera in rays.camera[rays.point == index]),
            residual_px=tuple(residual_px[rays.point == index].tolist()),
        )
        for index, name in enumerate(rays.point_name)
    )


def intersect_in_local(model: SparseModel, rays: MarkRays) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the position (J, 3), covariance (J, 3, 3) and success (J,) of points in local from their marks."""
    # The test of the marks' agreement includes the model's own error, because no lens is modelled to 0.1 px.
    own_px = float(np.nanmedian(model.point_error_px)) if np.isfinite(model.point_error_px).any() else 0.0
    own_rad = own_px * rays.sigma_rad / rays.sigma_px
    center = model.cam_center_in_local
    errors = RayErrors(_TINY * float(np.ptp(center, axis=0).max()), _TINY, own_rad)
    solved = intersect_marks(rays, model.rotation_cam_from_local, center, errors)
    of_marks, of_all = (
        np.bincount(rays.point, squared, len(rays.point_name))
        for squared in (rays.sigma_rad**2, rays.sigma_rad**2 + own_rad**2)
    )
    return solved.position_in_geo, solved.cov_in_geo * (of_marks / of_all)[:, None, None], solved.consistent


def recorded_rotations(survey: Survey, model: SparseModel) -> RecordedRotations:
    """Return the recorded attitudes of the registered images, without those that disagree with the SfM model.

    For example, a picture that lags the gimbal in a turn, or one that was turned since. Its attitude differs from
    the others by far more than its σ.
    """
    attitudes = {image.name: image.attitude for image in survey.images if image.attitude is not None}
    image = np.array([index for index, name in enumerate(model.image_name) if name in attitudes], dtype=np.int64)
    of_images = [attitudes[model.image_name[index]] for index in image]
    rotation = matrix_from_quat_xyzw(np.array([attitude.quat_xyzw for attitude in of_images]).reshape(-1, 4))
    sigma_rad = np.radians([attitude.sigma_deg for attitude in of_images])
    agrees = np.ones(len(image), dtype=bool)
    if len(image) > 2:
        geo_from_local = rotation @ model.rotation_cam_from_local[image]
        mean = mean_rotation(geo_from_local, sigma_rad).rotation
        turn = np.linalg.norm(log_so3(geo_from_local @ mean.T), axis=1)
        agrees = turn < np.maximum(_INCONSISTENT_SIGMAS * sigma_rad, _INCONSISTENT_RAD)
    return RecordedRotations(
        image=image[agrees],
        geo_from_cam=rotation[agrees],
        sigma_rad=sigma_rad[agrees],
        inconsistent=tuple(model.image_name[index] for index in image[~agrees]),
    )


def attitude_prior(survey: Survey, model: SparseModel) -> RotationPrior | None:
    """Return the mean rotation geo ← local of the recorded attitudes, or None without any."""
    recorded = recorded_rotations(survey, model)
    if len(recorded.image) == 0:
        return None
    return mean_rotation(recorded.geo_from_cam @ model.rotation_cam_from_local[recorded.image], recorded.sigma_rad)


def problem_of(
    scene: SparseScene,
    survey: Survey,
    *,
    estimate: Iterable[MountParameter] = (),
    with_attitudes: bool = False,
    planes: Planes | None = None,
) -> Problem:
    """Return the problem of all cameras under the survey's measurements.

    Args:
        survey: the measurements in use, with the variance factors in their covariances.
        estimate: further systematic errors to estimate, beside the common error of the fixes.
        with_attitudes: whether the attitudes take part, where positions leave the rotation open.
        planes: of a LiDAR whose shift is a systematic error.

    Raises:
        InputError: an error is to be estimated whose measurements were not recorded.
    """
    wanted = tuple(estimate)
    fixes, control = fixes_of(scene, survey), control_of(scene, survey)
    attitudes = attitudes_of(scene, survey) if with_attitudes or "boresight" in wanted else None
    for name, source, what in (("lever-arm", fixes, "positions"), ("boresight", attitudes, "attitudes")):
        if name in wanted and source is None:
            raise InputError(
                f"no-{what}",
                f"{name} cannot be estimated, because no {what} were recorded.",
                field="--estimate",
            )
    blocks = [] if fixes is None else _common_errors(survey, fixes, with_datum=control is not None)
    earlier = earlier_of(scene, survey)
    if survey.common is not None and earlier is not None:
        blocks.append(SystematicError("earlier-date", _sigma_of_earlier(survey.common)))
    if "lever-arm" in wanted:
        blocks.append(SystematicError("lever-arm", (SIGMA_ARM_M,) * 3))
    if attitudes is not None:
        if "boresight" in wanted:
            blocks.append(SystematicError("boresight", (SIGMA_BORESIGHT_RAD,) * 3))
        sigma = float(np.median(np.sqrt(attitudes.cov[:, 0, 0])))
        blocks.append(SystematicError("common", (sigma,) * 3))
    if planes is not None:
        blocks.append(SystematicError("lidar-shift", (SIGMA_LIDAR_M,) * 3))
    frame = None
    if survey.origin is None:
        center = scene.poses.cam_center_in_model
        frame = LocalFrame.fixed(float(np.linalg.norm(center - center.mean(axis=0), axis=1).max()))
    has_drift = any(block.name == "drift" for block in blocks)
    level = level_term(scene, survey) if has_drift and attitudes is None else None
    distances = distances_of(scene, survey)
    every: tuple[Term | None, ...] = (fixes, control, earlier, distances, attitudes, planes, frame, level)
    measured = tuple(term for term in every if term is not None)
    datum = survey.sigma_datum_m if control is not None else _datum_of_fixes(survey, fixes)
    date = None
    if survey.common is not None and earlier is not None:  # The places are those of the earlier date.
        datum, date = (0.0, 0.0, 0.0), _earlier_date(survey.common, survey.origin_on_earth, len(earlier))
    errors = SystematicErrors(tuple(blocks))
    return Problem(scene.poses, scene.bundle, measured, errors, sigma_datum_m=datum, earlier=date)


def rejected_of(scene: SparseScene, survey: Survey, verdict: MeasurementVerdict) -> Problem | None:
    """Return the problem of the measurements that `init-sim3` has rejected; None if there are none."""
    rejected = verdict.rejected(survey)
    return None if rejected is None else problem_of(scene, rejected)


def fixes_of(scene: SparseScene, survey: Survey) -> Fixes | None:
    """Return the fixes of the registered images, or None without any."""
    fixes, index = fix_correspondences(survey, scene.sparse), scene.sparse.image_index()
    if not len(fixes):
        return None
    session = {image.name: image.fix.session for image in survey.images if image.fix is not None}
    return Fixes(
        name=fixes.name,
        camera=np.array([index[name] for name in fixes.name]),
        position_in_geo=fixes.in_geo,
        cov=fixes.cov_in_geo,
        session=np.array([session[name] for name in fixes.name]),
        drift=_drift_of(survey, fixes.name),
    )


def _drift_of(survey: Survey, names: tuple[str, ...]) -> FloatArray:
    """Return the shapes (F, K) of the drift of the fixes of these images; K = 0: no session drifts."""
    fixed = {image.name: (image.fix.session, image.timestamp_s) for image in survey.images if image.fix is not None}
    session = np.array([fixed[name][0] for name in names])
    time_s = np.array([fixed[name][1] for name in names], dtype=np.float64)
    shapes = np.zeros((len(names), 0))
    for number in np.unique(session) if survey.sessions else ():
        of_session = survey.sessions[number]
        if not any(of_session.drift_m):
            continue
        rows = np.flatnonzero(session == number)
        session_shapes = drift_shapes(time_s[rows], of_session.drift_time_s)
        shapes = np.pad(shapes, ((0, 0), (0, max(0, session_shapes.shape[1] - shapes.shape[1]))))
        shapes[rows, : session_shapes.shape[1]] = session_shapes
    return shapes


def level_term(scene: SparseScene, survey: Survey) -> Level | None:
    """Return what the photographs know of the vertical, or None if they know nothing."""
    level = level_of(survey, scene.sparse, attitude_prior(survey, scene.sparse))
    if level is None:
        return None
    turn = scene.model_from_local.rotation
    axes = np.linalg.svd(level.up_in_local[None])[2][1:]
    covariance = axes @ level.cov_rad2 @ axes.T
    return Level((turn @ level.up_in_local)[None], (axes @ turn.T)[None], covariance[None])


def control_of(scene: SparseScene, survey: Survey) -> ControlPoints | None:
    """Return the control points with marks in two or more registered images, or None if there is none."""
    rays = mark_rays(survey.control_points, scene.sparse)
    marked = rays.marks_of_point >= 2
    if not marked.any():
        return None
    rays = rays.of_points(marked)
    surveyed = [point for point, enough in zip(survey.control_points, marked, strict=True) if enough]
    position = np.array([point.position_in_geo for point in surveyed])
    of_survey = np.array([point.cov_in_geo for point in surveyed])
    return ControlPoints(
        name=rays.point_name,
        **_of_rays(scene, rays),
        position_in_geo=position,
        cov=of_survey + _mark_covariance(scene, rays, position),
    )


def earlier_of(scene: SparseScene, survey: Survey) -> EarlierPoints | None:
    """Return the points in common with an earlier date that two or more registered images see; None: there is none.

    Their marks are the observations of the tracks. With the points eliminated, the information of the bundle is
    independent of where the observations put these points: nothing is counted twice.
    """
    common, sparse = survey.common, scene.sparse
    if common is None:
        return None
    _, here, there = np.intersect1d(sparse.point_id, common.point_id, return_indices=True)
    row_of = np.full(len(sparse.point_id), -1)
    row_of[here] = there
    seen = np.flatnonzero(row_of[sparse.obs_point] >= 0)
    # An image may observe a point more than once; the first time counts.
    pairs = np.column_stack([sparse.obs_point[seen], sparse.obs_image[seen]])
    seen = seen[np.unique(pairs, axis=0, return_index=True)[1]]
    rays = _rays_of_tracks(scene, seen)
    rays = rays.of_points(rays.marks_of_point >= 2)
    if not rays.point_name:
        return None
    index = row_of[np.searchsorted(sparse.point_id, np.array(rays.point_name, dtype=np.int64))]
    position = common.position_in_geo(survey.origin_on_earth)[index]
    cov_of_marks = _mark_covariance(scene, rays, position) * float(common.factor)
    return EarlierPoints(
        name=rays.point_name,
        **_of_rays(scene, rays),
        position_in_geo=position,
        cov=common.cov_in_geo(survey.origin_on_earth)[index] + cov_of_marks,
    )


def _rays_of_tracks(scene: SparseScene, seen: IntArray) -> MarkRays:
    """Return observations (K,) of the SfM model as marks of points that are named by COLMAP's ids."""
    sparse = scene.sparse
    points, point = np.unique(sparse.obs_point[seen], return_inverse=True)
    camera, xy_px = sparse.obs_image[seen], sparse.obs_xy_px[seen]
    bearing = np.zeros((len(seen), 3))
    for image in np.unique(camera):
        bearing[camera == image] = bearings(sparse.camera_of(int(image)), xy_px[camera == image])
    sigma_px = np.full(len(seen), scene.bundle.sigma_px)
    names = tuple(str(sparse.point_id[row]) for row in points)
    rays = MarkRays(names, point, camera, xy_px, bearing, sigma_px, sigma_px / sparse.focal_px[camera])
    return rows_of(rays, np.asarray(np.isfinite(bearing).all(axis=1)))


def _earlier_date(common: CommonPoints, origin: Origin, used: int) -> EarlierDate:
    cov, pivot = common.similarity_in_geo(origin)
    rows = tuple(map(tuple, cov.tolist()))
    return EarlierDate(
        workspace=common.earlier, points=int(common.found), used=used, covariance=rows, pivot=vector3(pivot)
    )


def _sigma_of_earlier(common: CommonPoints) -> Vector3:
    return vector3(np.maximum(common.sigma_m, _LEAST_SIGMA_COMMON_M))


def _of_rays(scene: SparseScene, rays: MarkRays) -> dict[str, Any]:
    """Return the fields of a `MarkedTerm` that its marks decide."""
    return {
        "point": rays.point,
        "camera": rays.camera,
        "bearing_in_cam": rays.bearing_in_cam,
        "sigma_rad": rays.sigma_rad,
        "bearing_by_lens": scene.sparse.lenses.bearing_jacobian(rays.camera, rays.xy_px),
    }


def distances_of(scene: SparseScene, survey: Survey) -> Distances | None:
    """Return the control distances whose ends have marks in two or more registered images; None: there is none."""
    wanted = [distance for distance in survey.distances if distance.use == "control"]
    rays = mark_rays([end for distance in wanted for end in distance.ends], scene.sparse)
    whole: BoolArray = np.asarray((rays.marks_of_point.reshape(-1, 2) >= 2).all(axis=1))
    if not whole.any():
        return None
    rays = rays.of_points(np.repeat(whole, 2))
    wanted = [distance for distance, is_whole in zip(wanted, whole, strict=True) if is_whole]
    exact = Distances(
        name=tuple(distance.name for distance in wanted),
        **_of_rays(scene, rays),
        distance_m=np.array([distance.distance_m for distance in wanted]),
        cov=np.ones((len(wanted), 1, 1)),
    )
    sfm = At(
        scene.poses.cam_from_model,
        scene.poses.cam_center_in_model,
        scene.geo_from_model,
        np.zeros(exact.bearing_by_lens.shape[2]),
        SystematicErrors(),
        np.zeros(0),
        np.tile(np.eye(3), (len(scene.poses.cam_from_model), 1, 1)),
    )
    ends = exact.places(sfm)
    _, along = exact.compared(ends)
    of_marks = _mark_covariance(scene, rays, ends).reshape(-1, 2, 3, 3).sum(axis=1)
    variance = np.einsum("di,dij,dj->d", along, of_marks, along)
    variance += np.array([distance.sigma_m for distance in wanted]) ** 2
    return replace(exact, cov=variance[:, None, None])


def attitudes_of(scene: SparseScene, survey: Survey) -> Attitudes | None:
    """Return the recorded rotations of the registered images that agree with the SfM model, or None."""
    recorded = recorded_rotations(survey, scene.sparse)
    if not len(recorded.image):
        return None
    return Attitudes(
        name=tuple(scene.sparse.image_name[image] for image in recorded.image),
        camera=recorded.image,
        geo_from_cam=recorded.geo_from_cam,
        cov=np.square(recorded.sigma_rad)[:, None, None] * np.eye(3),
    )


def start_of(scene: SparseScene, problem: Problem) -> State:
    """Return the cameras as SfM left them, at the similarity of the scene, without systematic errors."""
    lenses = len(problem.bundle.sums.lens)
    cameras = np.zeros((len(scene.sparse.image_name), 6))
    return State(scene.geo_from_model, cameras, np.zeros(lenses), np.zeros(len(problem.errors)))


def onto_control(problem: Problem, state: State) -> State:
    """Return a state whose common errors take what is left of the fixes beside the control points."""
    fixes = problem.term(Fixes.kind)
    if not isinstance(fixes, Fixes):
        return state
    residual, errors = fixes.residuals(problem.at(state)), state.errors.copy()
    for session in np.unique(fixes.session):
        columns = problem.errors.columns("bias", int(session))
        if columns is None:  # Without a common error of its own, the fixes show that of an earlier date.
            columns = problem.errors.columns("earlier-date")
        if columns is not None:
            errors[columns] -= np.median(residual[fixes.session == session], axis=0)
    return replace(state, errors=errors)


def _datum_of_fixes(survey: Survey, fixes: Fixes | None) -> Vector3:
    """Return the σ east, north, up of the error of the reference system that all fixes share; zeros without any."""
    sessions = [] if fixes is None or not survey.sessions else np.unique(fixes.session).tolist()
    return vector3(
        np.max([survey.sessions[session].sigma_datum_m for session in sessions] or [np.zeros(3)], axis=0)
    )


def _common_errors(survey: Survey, fixes: Fixes, *, with_datum: bool) -> list[SystematicError]:
    """Return the common errors of the fixes by session.

    Control points reveal the error of the reference system, which is then part of these. Where nothing reveals it,
    it is no unknown (`Problem.sigma_datum_m`): a prior of hundreds of metres would drown in rounding.
    """
    blocks = []
    for session in np.unique(fixes.session) if survey.sessions else ():
        sigma = np.array(survey.sessions[session].sigma_common_m)
        if not with_datum:
            sigma = np.sqrt(np.maximum(sigma**2 - np.square(survey.sessions[session].sigma_datum_m), 0.0))
        if sigma.any():
            at_least = vector3(np.maximum(sigma, _LEAST_SIGMA_COMMON_M))
            blocks.append(SystematicError("bias", at_least, int(session)))
        drift = np.array(survey.sessions[session].drift_m)
        if drift.any():
            at_least = vector3(np.maximum(drift, _LEAST_SIGMA_COMMON_M))
            own = fixes.drift[fixes.session == session]
            modes = np.flatnonzero(np.abs(own).max(axis=0, initial=0.0) > 0)
            blocks += [SystematicError("drift", at_least, int(session), mode) for mode in map(int, modes)]
    return blocks


def _mark_covariance(scene: SparseScene, marks: MarkRays, position: FloatArray) -> FloatArray:
    """Return the covariance (J, 3, 3) of each intersected point (J, 3) in geo that the σ of its marks causes."""
    poses = scene.poses
    center = scene.geo_from_model.apply(poses.cam_center_in_model[marks.camera])
    direction = np.einsum("kji,kj->ki", poses.cam_from_model[marks.camera], marks.bearing_in_cam)
    return NearestPoints(position, marks.point, center, direction, marks.sigma_rad).cov
