"""Surveyed points measured in the trained survey: check points, cross-validation, and residuals of the fit."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray, IntArray
from pipelines.evaluate.error_propagation import ErrorPropagation, NoErrorPropagation
from pipelines.evaluate.point_report import (
    MeasuredPoints,
    check_point_errors,
    cross_validation_errors,
    point_residuals,
)
from pipelines.evaluate.points import Sights, points_by_camera, points_by_model, sights
from pipelines.evaluate.prediction import cramer_rao, left_out
from pipelines.robust.statistics import residual_stats
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
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained import Trained

log = logging.getLogger(__name__)


def measure_check_points(
    renderer: ModelRenderer, propagation: ErrorPropagation | NoErrorPropagation, progress: Progress
) -> CheckPoints:
    """Measure the check points by camera and by model."""
    marks = sights(renderer.trained, renderer.trained.survey.check_points)
    return CheckPoints(
        camera=_by_camera(renderer.trained, marks, propagation), model=_by_model(renderer, marks, progress)
    )


def cross_validate(
    trained: Trained, propagation: ErrorPropagation | NoErrorPropagation
) -> CrossValidation | NoCrossValidation:
    """Measure each control point by a solution without it."""
    if isinstance(propagation, NoErrorPropagation):
        return NoCrossValidation(count=0, reason=propagation.reason)
    points = trained.survey.control_points
    independent = left_out(propagation.restored)
    rays = _ray_counts(sights(trained, points), points)
    return cross_validation_errors(MeasuredPoints(points, independent.error_in_geo, rays, independent.cov_in_geo))


def fit_residuals(trained: Trained) -> Fit:
    """Return the residuals of fixes and control points: how the solution fits, not how accurate it is."""
    return Fit(gnss=_fix_residuals(trained), gcp=_control_residuals(trained))


def _by_camera(
    trained: Trained, marks: Sights, propagation: ErrorPropagation | NoErrorPropagation
) -> CheckPointErrors:
    """Where the rays of the marks meet, with prediction and bound."""
    points = trained.survey.check_points
    position = points_by_camera(trained, marks, len(points))
    measured = _compared(points, position, marks)
    if isinstance(propagation, NoErrorPropagation) or not points:
        return check_point_errors(measured)
    measured = replace(measured, cov_in_geo=propagation.prediction.of_sights(position, marks))
    try:
        bound = cramer_rao(propagation.restored, marks)
    except DegenerateGeometryError as error:
        log.info("no Cramér–Rao bound: %s", error)
        bound = None
    return check_point_errors(measured, bound)


def _by_model(renderer: ModelRenderer, marks: Sights, progress: Progress) -> CheckPointErrors:
    """Where the surface of the Gaussians lies behind the marks."""
    points, depth_m = renderer.trained.survey.check_points, _depth_maps(renderer, marks, progress)
    pinholes = {index: renderer.pinhole(index) for index in depth_m}
    position = points_by_model(renderer.trained, marks, depth_m, pinholes, len(points))
    return check_point_errors(_compared(points, position, marks))


def _depth_maps(renderer: ModelRenderer, marks: Sights, progress: Progress) -> dict[int, FloatArray]:
    """Depth of the surface by camera, of those that show a mark."""
    depth_m = {}
    cameras = sorted({int(index) for index in marks.camera})
    with progress.task("depth maps", len(cameras)) as task:
        for index in cameras:
            depth_m[index] = renderer.depth_m(index)
            task.advance()
    return depth_m


def _compared(points: tuple[SurveyedPoint, ...], position_in_geo: FloatArray, marks: Sights) -> MeasuredPoints:
    """Positions (J, 3) of surveyed points against their survey."""
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    return MeasuredPoints(points, position_in_geo - surveyed, _ray_counts(marks, points))


def _ray_counts(marks: Sights, points: tuple[SurveyedPoint, ...]) -> IntArray:
    """Marks (J,) of each point in registered images."""
    return np.bincount(marks.point, minlength=len(points)).astype(np.int64)


def _control_residuals(trained: Trained) -> ControlResiduals:
    points = trained.survey.control_points
    marks = sights(trained, points)
    measured = _compared(points, points_by_camera(trained, marks, len(points)), marks)
    stats = residual_stats(measured.error_in_geo[measured.is_measured])
    return ControlResiduals(**stats.model_dump(), points=point_residuals(measured))


def _fix_residuals(trained: Trained) -> FixResiduals:
    """Of the training cameras, outliers left out."""
    center_in_geo = trained.geo_from_model.apply(trained.poses.cam_center_in_model)
    outliers = set(trained.model.gnss_outliers)
    residuals, left_out_count = [], 0
    for index in trained.indices("train"):
        image = trained.survey.image(trained.sparse.image_name[index])
        if image is None or image.fix is None:
            continue
        if image.name in outliers:
            left_out_count += 1
            continue
        residuals.append(center_in_geo[index] - np.array(image.fix.position_in_geo))
    stats = residual_stats(np.array(residuals).reshape(-1, 3))
    return FixResiduals(**stats.model_dump(), outliers=left_out_count)
