"""Variance factors of a survey's measurements: tests of the stated σ, and the survey with σ that passed them."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pipelines.core.products import Covariance3, Product
from pipelines.core.types import Matrix3
from pipelines.scene.survey import Survey, SurveyedPoint, SurveyImage

Group = Literal["fixes", "control points", "marks", "attitudes", "tie points"]
SigmaSource = Literal["stated", "default"]


class VarianceFactor(Product):
    """Test of the stated σ of one group of measurements, after a least-squares adjustment.

    Attributes:
        group: kind of measurement.
        count: number of measurements in the group.
        used: number of them in the test; the others are outliers.
        redundancy: degrees of freedom of the test.
        estimated: estimated factor of the stated variance; None without redundancy.
        probability: probability of a larger factor if the stated σ are right; 1 without redundancy.
        applied: factor by which the variance was multiplied.
        sigma_source: whether σ was stated, or is a default that nobody stated.
    """

    group: Group
    count: int
    used: int
    redundancy: float
    estimated: float | None
    probability: float
    applied: float
    sigma_source: SigmaSource


def applied_factors(factors: tuple[VarianceFactor, ...]) -> dict[Group, float]:
    """Return the applied factor by group, groups without one left out."""
    return {factor.group: factor.applied for factor in factors if factor.applied != 1.0}


def with_variance_factors(survey: Survey, applied: dict[Group, float]) -> Survey:
    """Return the survey with the covariances of each group multiplied by its factor.

    The σ of marks applies to check points too: the same person marks both. The surveyed positions of the check
    points keep their covariance.
    """
    if not applied:
        return survey
    of_marks = applied.get("marks", 1.0)
    return survey.model_copy(
        update={
            "images": tuple(_image(image, applied) for image in survey.images),
            "control_points": tuple(
                _point(point, applied.get("control points", 1.0), of_marks) for point in survey.control_points
            ),
            "check_points": tuple(_point(point, 1.0, of_marks) for point in survey.check_points),
        }
    )


def _image(image: SurveyImage, applied: dict[Group, float]) -> SurveyImage:
    fix, attitude = image.fix, image.attitude
    if fix is not None:
        fix = fix.model_copy(update={"cov_in_geo": _scaled(fix.cov_in_geo, applied.get("fixes", 1.0))})
    if attitude is not None:
        sigma_deg = attitude.sigma_deg * applied.get("attitudes", 1.0) ** 0.5
        attitude = attitude.model_copy(update={"sigma_deg": sigma_deg})
    return image.model_copy(update={"fix": fix, "attitude": attitude})


def _point(point: SurveyedPoint, of_survey: float, of_marks: float) -> SurveyedPoint:
    marks = tuple(mark.model_copy(update={"sigma_px": mark.sigma_px * of_marks**0.5}) for mark in point.marks)
    return point.model_copy(update={"cov_in_geo": _scaled(point.cov_in_geo, of_survey), "marks": marks})


def _scaled(covariance: Covariance3, factor: float) -> Matrix3:
    first, second, third = (factor * np.array(covariance)).tolist()
    return (tuple(first), tuple(second), tuple(third))
