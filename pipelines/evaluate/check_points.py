"""Surveyed points, measured in the trained survey: check points, cross-validation, and residuals of the fit."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from pipelines.adjust.error_propagation import ErrorPropagation, NoErrorPropagation
from pipelines.adjust.leave_one_out import LeftOut, leave_one_out
from pipelines.adjust.solved_survey import SolvedSurvey
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray
from pipelines.evaluate.cramer_rao import cramer_rao_bound
from pipelines.evaluate.point_report import (
    MeasuredPoints,
    check_point_errors,
    cross_validation_errors,
    point_residuals,
)
from pipelines.robust.statistics import residual_stats
from pipelines.scene.fix_differences import fix_differences
from pipelines.scene.marks import MarkRays, mark_rays
from pipelines.scene.points_by_camera import points_by_camera
from pipelines.scene.points_by_model import DepthMap, depth_around, points_by_model
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.report import (
    CheckPointErrors,
    CheckPoints,
    ControlResiduals,
    CrossValidation,
    Fit,
    FixResiduals,
    NoCrossValidation,
)
from pipelines.scene.scene_extent import scene_area_km2
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained_survey import TrainedSurvey

log = logging.getLogger(__name__)


def measure_check_points(
    renderer: ModelRenderer, propagation: ErrorPropagation | NoErrorPropagation, progress: Progress
) -> CheckPoints:
    """Return the errors of the check points, triangulated and on the rendered surface.

    Args:
        renderer: of the trained model.
        propagation: gives predicted covariances and the Cramér–Rao bound.
        progress: shows the depth maps.
    """
    trained = renderer.trained
    rays, area_km2 = mark_rays(trained.survey.check_points, trained.sparse), scene_area_km2(trained)
    return CheckPoints(
        camera=_by_camera(trained, rays, propagation, area_km2), model=_by_model(renderer, rays, progress, area_km2)
    )


def cross_validate(
    trained: TrainedSurvey, propagation: ErrorPropagation | NoErrorPropagation
) -> CrossValidation | NoCrossValidation:
    """Return the errors of the control points, each measured by a solution without that point.

    Args:
        trained: the trained survey.
        propagation: its solved measurements, or the reason why there are none.

    Raises:
        DegenerateGeometryError: the measurements do not determine the similarity.
    """
    if isinstance(propagation, NoErrorPropagation):
        return NoCrossValidation(count=0, reason=propagation.reason)
    points = trained.survey.control_points
    independent = _left_out(propagation.solved)
    rays = mark_rays(points, trained.sparse).marks_of_point
    return cross_validation_errors(MeasuredPoints(points, independent.error_in_geo, rays, independent.cov_in_geo))


def fit_residuals(trained: TrainedSurvey) -> Fit:
    """Return the residuals of fixes and control points: the fit of the solution, not its accuracy."""
    return Fit(gnss=_fix_residuals(trained), gcp=_control_residuals(trained))


def _by_camera(
    trained: TrainedSurvey,
    rays: MarkRays,
    propagation: ErrorPropagation | NoErrorPropagation,
    area_km2: float | None,
) -> CheckPointErrors:
    """Return the errors of the intersections of the marks' rays, with prediction and bound."""
    points = trained.survey.check_points
    position = points_by_camera(trained, rays)
    measured = _compared(points, position, rays)
    if isinstance(propagation, NoErrorPropagation) or not points:
        return check_point_errors(measured, area_km2)
    measured = replace(measured, cov_in_geo=propagation.prediction.of_marked_points(position, rays))
    try:
        bound = cramer_rao_bound(propagation.solved, rays)
    except DegenerateGeometryError as error:
        log.info("no Cramér–Rao bound: %s", error)
        bound = None
    return check_point_errors(measured, area_km2, bound)


def _by_model(
    renderer: ModelRenderer, rays: MarkRays, progress: Progress, area_km2: float | None
) -> CheckPointErrors:
    """Return the errors of the places of the Gaussians' surface behind the marks."""
    points, maps = renderer.trained.survey.check_points, _depth_maps(renderer, rays, progress)
    position = points_by_model(renderer.trained, rays, maps)
    return check_point_errors(_compared(points, position, rays), area_km2)


def _depth_maps(renderer: ModelRenderer, rays: MarkRays, progress: Progress) -> list[DepthMap]:
    """Return the depth of the surface around each mark."""
    maps = []
    with progress.task("depth at marks", len(rays)) as task:
        for camera, xy in zip(rays.camera, rays.xy, strict=True):
            maps.append(depth_around(renderer, int(camera), xy))
            task.advance()
    return maps


def _compared(points: tuple[SurveyedPoint, ...], position_in_geo: FloatArray, rays: MarkRays) -> MeasuredPoints:
    """Return surveyed points with the errors of their measured positions (J, 3)."""
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    return MeasuredPoints(points, position_in_geo - surveyed, rays.marks_of_point)


def _left_out(solved: SolvedSurvey) -> LeftOut:
    """Return the J control points of the survey, each measured by a solution without that point.

    The covariance is that of the solution and the marks: the survey's own covariance is subtracted. A point that
    entered no solution is NaN.
    """
    points, control = solved.trained.survey.control_points, solved.problem.control
    error, cov = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    if control is None:
        return LeftOut(error, cov)
    independent = leave_one_out(solved.problem)
    used = {name: row for row, name in enumerate(control.point_id)}
    for index, point in enumerate(points):
        if (row := used.get(point.name)) is not None:
            error[index] = independent.error_in_geo[row]
            cov[index] = independent.cov_in_geo[row] - np.array(point.cov_in_geo)
    return LeftOut(error, cov)


def _control_residuals(trained: TrainedSurvey) -> ControlResiduals:
    points = trained.survey.control_points
    rays = mark_rays(points, trained.sparse)
    measured = _compared(points, points_by_camera(trained, rays), rays)
    rejected = np.isin([point.name for point in points], trained.model.control_outliers)
    stats = residual_stats(measured.error_in_geo[measured.is_measured & ~rejected])
    return ControlResiduals(**stats.model_dump(), outliers=int(rejected.sum()), points=point_residuals(measured))


def _fix_residuals(trained: TrainedSurvey) -> FixResiduals:
    """Return the residuals of the training cameras' fixes, without outliers."""
    fixes = fix_differences(trained)
    used = fixes.is_training & ~fixes.is_outlier
    stats = residual_stats(fixes.difference_in_geo[used])
    return FixResiduals(**stats.model_dump(), outliers=int((fixes.is_training & fixes.is_outlier).sum()))
