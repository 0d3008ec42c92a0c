"""Sections of the report on surveyed points: errors, accuracy after ASPRS, and predicted accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.evaluate.asprs import Assessment, assess
from pipelines.scene.report import (
    ByAxis,
    CheckPointErrors,
    CrossValidation,
    PointError,
    PointResidual,
    PointRows,
    PredictedPointError,
    PredictedSigma,
    RmsSigma,
)
from pipelines.scene.survey import SurveyedPoint


@dataclass(frozen=True)
class MeasuredPoints:
    """J surveyed points, measured in the model.

    Attributes:
        points: positions and covariances of the survey.
        error_in_geo: (J, 3) m, measured minus surveyed; NaN for a point that was not measured.
        rays: (J,) number of marks in registered images.
        cov_in_geo: (J, 3, 3) m², predicted covariance of the measured positions; None: no prediction.
    """

    points: tuple[SurveyedPoint, ...]
    error_in_geo: FloatArray
    rays: IntArray
    cov_in_geo: FloatArray | None = None

    @property
    def is_measured(self) -> BoolArray:
        """Mask (J,) of the points that were measured."""
        return np.asarray(np.isfinite(self.error_in_geo).all(axis=1))

    @property
    def cov_survey(self) -> FloatArray:
        """Covariances (J, 3, 3) of the surveyed positions in m²."""
        return np.array([point.cov_in_geo for point in self.points]).reshape(-1, 3, 3)


def check_point_errors(measured: MeasuredPoints, area_km2: float | None) -> CheckPointErrors:
    """Return the report's section on check points.

    Args:
        measured: J check points.
        area_km2: of the scene; None: not known.
    """
    assessment = _assess(measured, area_km2)
    blunder = _among_all(assessment, measured)
    return CheckPointErrors(
        **assessment.stats.model_dump(),
        survey=assessment.survey,
        with_survey=assessment.with_survey,
        asprs=assessment.asprs,
        without_blunders=assessment.without_blunders,
        blunders=_names(measured, blunder),
        predicted=_predicted_sigma(measured),
        points=_rows(measured, blunder),
    )


def cross_validation_errors(measured: MeasuredPoints) -> CrossValidation:
    """Return the report's section on control points, each measured by a solution without that point.

    The section states no class, because control points are not check points.
    """
    assessment = _assess(measured)
    blunder = _among_all(assessment, measured)
    impossible = "no control point can be spared, or none entered the adjustment"
    return CrossValidation(
        **assessment.stats.model_dump(),
        survey=assessment.survey,
        with_survey=assessment.with_survey,
        without_blunders=assessment.without_blunders,
        blunders=_names(measured, blunder),
        predicted=_predicted_sigma(measured),
        points=_rows(measured, blunder),
        reason=None if assessment.stats.count else impossible,
    )


def point_residuals(measured: MeasuredPoints) -> tuple[PointResidual, ...]:
    """Return one row for each point: its name, marks and residual."""
    residual = _by_axis(measured.error_in_geo)
    return tuple(
        PointResidual(name=point.name, rays=rays, de_m=east, dn_m=north, du_m=up)
        for point, rays, (east, north, up) in zip(measured.points, measured.rays.tolist(), residual, strict=True)
    )


def _assess(measured: MeasuredPoints, area_km2: float | None = None) -> Assessment:
    known = measured.is_measured
    vegetated = np.array([point.land_cover == "vegetated" for point in measured.points], dtype=bool)
    return assess(measured.error_in_geo[known], measured.cov_survey[known], vegetated[known], area_km2)


def _among_all(assessment: Assessment, measured: MeasuredPoints) -> list[bool]:
    """Return for each of all J points whether it is a blunder."""
    blunder = np.zeros(len(measured.points), dtype=bool)
    blunder[measured.is_measured] = assessment.blunder
    return [bool(is_blunder) for is_blunder in blunder]


def _names(measured: MeasuredPoints, chosen: list[bool]) -> tuple[str, ...]:
    return tuple(point.name for point, is_chosen in zip(measured.points, chosen, strict=True) if is_chosen)


def _rows(measured: MeasuredPoints, blunder: list[bool]) -> PointRows:
    """Return one row for each point, with its predicted σ if there is a prediction."""
    rows = [
        PointError(**residual.model_dump(), blunder=is_blunder)
        for residual, is_blunder in zip(point_residuals(measured), blunder, strict=True)
    ]
    if measured.cov_in_geo is None:
        return tuple(rows)
    sigma = _by_axis(np.sqrt(np.diagonal(measured.cov_in_geo, axis1=1, axis2=2)))
    return tuple(
        PredictedPointError(**row.model_dump(), sigma_e_m=east, sigma_n_m=north, sigma_u_m=up)
        for row, (east, north, up) in zip(rows, sigma, strict=True)
    )


def _by_axis(values: FloatArray) -> list[tuple[float, float, float] | tuple[None, None, None]]:
    """Return rows (J, 3) as numbers; None for a row that is not finite along every axis."""
    rows = ((float(east), float(north), float(up)) for east, north, up in values)
    return [row if np.isfinite(row).all() else (None, None, None) for row in rows]


def rms_sigma(cov: FloatArray) -> RmsSigma:
    """Return the root mean square of σ over the points whose covariance of (J, 3, 3) is finite."""
    known = cov[np.isfinite(cov).all(axis=(1, 2))]
    if not len(known):
        return RmsSigma(count=0, rms_h_m=None, rms_v_m=None)
    east, north, up = np.diagonal(known, axis1=1, axis2=2).mean(axis=0).tolist()
    return RmsSigma(count=len(known), rms_h_m=float(np.sqrt(east + north)), rms_v_m=float(np.sqrt(up)))


def _predicted_sigma(measured: MeasuredPoints) -> PredictedSigma | None:
    """Return the predicted σ, and the mean of error² over variance, by axis.

    The variance includes the survey's. The mean is 1 on the average if both variances are true.
    """
    if measured.cov_in_geo is None:
        return None
    variance = np.diagonal(measured.cov_in_geo + measured.cov_survey, axis1=1, axis2=2)
    known = measured.is_measured & np.isfinite(variance).all(axis=1)
    normalised = ByAxis(e=None, n=None, u=None)
    if known.any():
        east, north, up = (measured.error_in_geo[known] ** 2 / variance[known]).mean(axis=0).tolist()
        normalised = ByAxis(e=east, n=north, u=up)
    sigma = rms_sigma(measured.cov_in_geo[known])
    return PredictedSigma(**sigma.model_dump(), normalised_error_squared=normalised)
