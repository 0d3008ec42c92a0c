"""Terms of the adjustment, built from the survey's measurements of the registered images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipelines.adjust.observations import recorded_rotations
from pipelines.adjust.options import EstimatedErrorName
from pipelines.adjust.state import (
    SIGMA_ARM_M,
    SIGMA_BORESIGHT_RAD,
    SIGMA_LIDAR_M,
    State,
    SystematicError,
    SystematicErrors,
)
from pipelines.adjust.system import Problem
from pipelines.adjust.terms import Attitudes, ControlPoints, Fixes, Planes, Term, root_information
from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.survey.adjustment import InitialSimilarity
from pipelines.survey.marks import mark_rays
from pipelines.survey.scene import Scene
from pipelines.survey.survey import Survey

_LEAST_SIGMA_COMMON_M = 1e-4  # of an axis without a common error, where another axis has one


def problem_of(
    scene: Scene,
    survey: Survey,
    *,
    estimate: Iterable[EstimatedErrorName] = (),
    with_attitudes: bool = False,
    planes: Planes | None = None,
) -> Problem:
    """Return the problem of all cameras under the survey's measurements.

    Args:
        scene: cameras and points as SfM left them.
        survey: the measurements in use, with the variance factors in their covariances.
        estimate: further systematic errors to estimate, beside the common error of the fixes.
        with_attitudes: whether the attitudes take part, where positions leave the rotation open.
        planes: of a LiDAR whose shift is a systematic error; None: none.

    Raises:
        InputError: an error is to be estimated whose measurements were not recorded.
    """
    wanted = tuple(estimate)
    fixes, control = fixes_of(scene, survey), control_of(scene, survey)
    attitudes = attitudes_of(scene, survey) if with_attitudes or "boresight" in wanted else None
    for name, source, what in (
        ("lever-arm", fixes, "positions"),
        ("boresight", attitudes, "attitudes"),
    ):
        if name in wanted and source is None:
            raise InputError(f"{name} cannot be estimated: no {what} were recorded", field="--estimate")
    blocks = [] if fixes is None else _common_errors(survey, fixes)
    if "lever-arm" in wanted:
        blocks.append(SystematicError("lever-arm", (SIGMA_ARM_M,) * 3))
    if attitudes is not None:
        if "boresight" in wanted:
            blocks.append(SystematicError("boresight", (SIGMA_BORESIGHT_RAD,) * 3))
        sigma = float(np.median(1.0 / attitudes.root_information[:, 0, 0]))
        blocks.append(SystematicError("common", (sigma,) * 3))
    if planes is not None:
        blocks.append(SystematicError("lidar-shift", (SIGMA_LIDAR_M,) * 3))
    every: tuple[Term | None, ...] = (fixes, control, attitudes, planes)
    return Problem(
        scene.poses,
        scene.bundle,
        tuple(term for term in every if term is not None),
        SystematicErrors(tuple(blocks)),
    )


def rejected_of(scene: Scene, survey: Survey, initial: InitialSimilarity) -> Problem | None:
    """Return the problem of the measurements that `init-sim3` has rejected; None if there are none."""
    rejected = initial.rejected(survey)
    return None if rejected is None else problem_of(scene, rejected)


def fixes_of(scene: Scene, survey: Survey) -> Fixes | None:
    """Return the fixes of the registered images, or None without any."""
    by_name = {image.name: image.fix for image in survey.images}
    fixed = [
        (index, name, fix)
        for index, name in enumerate(scene.sparse.image_name)
        if (fix := by_name.get(name)) is not None
    ]
    if not fixed:
        return None
    return Fixes(
        name=tuple(name for _, name, _ in fixed),
        camera=np.array([index for index, _, _ in fixed]),
        position_in_geo=np.array([fix.position_in_geo for _, _, fix in fixed]),
        root_information=root_information(np.array([fix.cov_in_geo for _, _, fix in fixed])),
        session=np.array([fix.session for _, _, fix in fixed]),
    )


def control_of(scene: Scene, survey: Survey) -> ControlPoints | None:
    """Return the control points with marks in two or more registered images, or None if there is none."""
    rays = mark_rays(survey.control_points, scene.sparse)
    marked = rays.marks_of_point >= 2
    if not marked.any():
        return None
    rays = rays.of_points(marked)
    surveyed = [point for point, enough in zip(survey.control_points, marked, strict=True) if enough]
    position = np.array([point.position_in_geo for point in surveyed])
    control = ControlPoints(
        name=rays.point_name,
        point=rays.point,
        camera=rays.camera,
        bearing_in_cam=rays.bearing_in_cam,
        sigma_rad=rays.sigma_rad,
        bearing_by_lens=scene.sparse.lenses.bearing_jacobian(rays.camera, rays.xy_px),
        position_in_geo=position,
        root_information=np.tile(np.eye(3), (len(position), 1, 1)),
    )
    of_survey = np.array([point.cov_in_geo for point in surveyed])
    return replace(control, root_information=root_information(of_survey + _mark_covariance(scene, control)))


def attitudes_of(scene: Scene, survey: Survey) -> Attitudes | None:
    """Return the recorded rotations of the registered images that the SfM model does not contradict, or None."""
    recorded = recorded_rotations(survey, scene.sparse)
    if not len(recorded.image):
        return None
    return Attitudes(
        name=tuple(scene.sparse.image_name[image] for image in recorded.image),
        camera=recorded.image,
        geo_from_cam=recorded.geo_from_cam,
        root_information=np.eye(3) / recorded.sigma_rad[:, None, None],
    )


def start_of(scene: Scene, problem: Problem) -> State:
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
        if columns is not None:
            errors[columns] -= np.median(residual[fixes.session == session], axis=0)
    return replace(state, errors=errors)


def _common_errors(survey: Survey, fixes: Fixes) -> list[SystematicError]:
    """Return the common error of each session that has one."""
    blocks = []
    for session in np.unique(fixes.session) if survey.sessions else ():
        sigma = np.array(survey.sessions[session].sigma_common_m)
        if sigma.any():
            east, north, up = np.maximum(sigma, _LEAST_SIGMA_COMMON_M).tolist()
            blocks.append(SystematicError("bias", (east, north, up), int(session)))
    return blocks


def _mark_covariance(scene: Scene, marks: ControlPoints) -> FloatArray:
    """Return the covariance (J, 3, 3) of each intersected point that the σ of its marks causes."""
    poses, position = scene.poses, marks.position_in_geo
    center = scene.geo_from_model.apply(poses.cam_center_in_model[marks.camera])
    direction = np.einsum("kji,kj->ki", poses.cam_from_model[marks.camera], marks.bearing_in_cam)
    distance = np.linalg.norm(position[marks.point] - center, axis=1)
    weight = 1.0 / (marks.sigma_rad * distance) ** 2
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    normal = np.zeros((len(position), 3, 3))
    np.add.at(normal, marks.point, weight[:, None, None] * projector)
    return np.asarray(np.linalg.inv(normal))
