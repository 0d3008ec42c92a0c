"""Surveyed points, measured in the solved survey: check points, cross-validation, and residuals of the fit."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray
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
    ControlResiduals,
    CrossValidation,
    Fit,
    FixResiduals,
)
from pipelines.scene.scene_extent import scene_area_km2
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained_survey import SolvedSurvey


def triangulated_check_points(solved: SolvedSurvey, posterior: Posterior) -> CheckPointErrors:
    """Return the errors of the check points as intersections of their marks' rays, with their predicted σ."""
    points, rays = solved.survey.check_points, mark_rays(solved.survey.check_points, solved.sparse)
    position = points_by_camera(solved, rays)
    cov = posterior.of_marked_points(position, rays) if points else None
    return check_point_errors(_compared(points, position, rays, cov), scene_area_km2(solved))


def check_points_on_surface(renderer: ModelRenderer, progress: Progress) -> CheckPointErrors:
    """Return the errors of the check points as places of the Gaussians' surface behind their marks.

    Args:
        renderer: of the trained model.
        progress: shows the depth maps.
    """
    trained = renderer.trained
    points, rays = trained.survey.check_points, mark_rays(trained.survey.check_points, trained.sparse)
    position = points_by_model(trained, rays, _depth_maps(renderer, rays, progress))
    return check_point_errors(_compared(points, position, rays), scene_area_km2(trained))


def cross_validate(solved: SolvedSurvey) -> CrossValidation:
    """Return the errors of the control points, each measured by a solution without that point.

    The adjustment has stored them. The covariance is that of the solution and the marks: the survey's own is
    subtracted. A point that entered no solution, or that the others leave open, is NaN.
    """
    points = solved.survey.control_points
    error, cov = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    left_out = {row.name: row for row in solved.model.measurements if row.kind == "control point"}
    for index, point in enumerate(points):
        row = left_out.get(point.name)
        if row is not None and row.left_out_error_m is not None and row.left_out_cov_m2 is not None:
            error[index] = row.left_out_error_m
            cov[index] = np.array(row.left_out_cov_m2) - np.array(point.cov_in_geo)
    rays = mark_rays(points, solved.sparse).marks_of_point
    return cross_validation_errors(MeasuredPoints(points, error, rays, cov))


def fit_residuals(solved: SolvedSurvey) -> Fit:
    """Return the residuals of fixes and control points: the fit of the solution, not its accuracy."""
    return Fit(gnss=_fix_residuals(solved), gcp=_control_residuals(solved))


def _depth_maps(renderer: ModelRenderer, rays: MarkRays, progress: Progress) -> list[DepthMap]:
    """Return the depth of the surface around each mark."""
    maps = []
    with progress.task("depth at marks", len(rays)) as task:
        for camera, xy in zip(rays.camera, rays.xy, strict=True):
            maps.append(depth_around(renderer, int(camera), xy))
            task.advance()
    return maps


def _compared(
    points: tuple[SurveyedPoint, ...], position_in_geo: FloatArray, rays: MarkRays, cov: FloatArray | None = None
) -> MeasuredPoints:
    """Return surveyed points with the errors of their measured positions (J, 3)."""
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    return MeasuredPoints(points, position_in_geo - surveyed, rays.marks_of_point, cov)


def _control_residuals(solved: SolvedSurvey) -> ControlResiduals:
    points = solved.survey.control_points
    rays = mark_rays(points, solved.sparse)
    measured = _compared(points, points_by_camera(solved, rays), rays)
    rejected = np.isin([point.name for point in points], solved.model.control_outliers)
    stats = residual_stats(measured.error_in_geo[measured.is_measured & ~rejected])
    return ControlResiduals(**stats.model_dump(), outliers=int(rejected.sum()), points=point_residuals(measured))


def _fix_residuals(solved: SolvedSurvey) -> FixResiduals:
    """Return the residuals of the fixes, without outliers."""
    fixes = fix_differences(solved)
    stats = residual_stats(fixes.difference_in_geo[~fixes.is_outlier])
    return FixResiduals(**stats.model_dump(), outliers=int(fixes.is_outlier.sum()))
