"""Errors of the measurements as the adjustment finds them: tests of their stated σ, and systematic errors."""

from typing import Literal

import numpy as np

from pipelines.core.products import Covariance3, Product
from pipelines.core.types import Matrix3, Vector3
from pipelines.survey.survey import FixSession, Survey, SurveyedPoint, SurveyImage

Group = Literal[
    "fixes",
    "horizontal drift",
    "vertical drift",
    "horizontal common error",
    "vertical common error",
    "control points",
    "marks",
    "attitudes",
    "tie points",
    "common points",
]
SigmaSource = Literal["stated", "default"]


class VarianceFactor(Product):
    """Test of the stated σ of one group of measurements, after a least-squares adjustment.

    Without redundancy, `estimated` is None and the probability is 1.
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


def factor_of_check_points(factors: tuple[VarianceFactor, ...]) -> float:
    """Return the factor of check points whose σ nobody stated: that of control points by the same assumption.

    A factor below 1 says how well the solution fits its control, and nothing of points that it does not know.
    """
    control = next((factor for factor in factors if factor.group == "control points"), None)
    return max(control.applied, 1.0) if control is not None and control.sigma_source == "default" else 1.0


def with_variance_factors(survey: Survey, applied: dict[Group, float], *, of_assumed_checks: float = 1.0) -> Survey:
    """Return the survey with the covariances of each group multiplied by its factor.

    The σ of marks applies to check points too: the same person marks both. The surveyed positions of the check
    points keep their covariance; those with the σ of the control points get the factor `of_assumed_checks`.
    """
    if not applied:
        return survey
    of_marks = applied.get("marks", 1.0)
    return survey.model_copy(
        update={
            "images": tuple(_image(image, applied) for image in survey.images),
            "sessions": tuple(_session(session, applied) for session in survey.sessions),
            "common": None if survey.common is None else survey.common.scaled(applied.get("common points", 1.0)),
            "control_points": tuple(
                _point(point, applied.get("control points", 1.0), of_marks) for point in survey.control_points
            ),
            "check_points": tuple(
                _point(point, of_assumed_checks if _has_sigma_of(point, survey.control_points) else 1.0, of_marks)
                for point in survey.check_points
            ),
        }
    )


def _image(image: SurveyImage, applied: dict[Group, float]) -> SurveyImage:
    fix, attitude = image.fix, image.attitude
    if fix is not None:
        fix = fix.scaled(applied.get("fixes", 1.0))
    if attitude is not None:
        sigma_deg = attitude.sigma_deg * applied.get("attitudes", 1.0) ** 0.5
        attitude = attitude.model_copy(update={"sigma_deg": sigma_deg})
    return image.model_copy(update={"fix": fix, "attitude": attitude})


def _session(session: FixSession, applied: dict[Group, float]) -> FixSession:
    def scaled(sigma_m: Vector3, horizontal: Group, vertical: Group) -> Vector3:
        across, up = (applied.get(group, 1.0) ** 0.5 for group in (horizontal, vertical))
        return (across * sigma_m[0], across * sigma_m[1], up * sigma_m[2])

    return session.model_copy(
        update={
            "sigma_common_m": scaled(session.sigma_common_m, "horizontal common error", "vertical common error"),
            "sigma_drift_m": scaled(session.drift_m, "horizontal drift", "vertical drift"),
        }
    )


def _point(point: SurveyedPoint, of_survey: float, of_marks: float) -> SurveyedPoint:
    marks = tuple(mark.model_copy(update={"sigma_px": mark.sigma_px * of_marks**0.5}) for mark in point.marks)
    return point.model_copy(update={"cov_in_geo": _scaled(point.cov_in_geo, of_survey), "marks": marks})


def _has_sigma_of(point: SurveyedPoint, others: tuple[SurveyedPoint, ...]) -> bool:
    """Return whether a point has the σ of one of the others, but for the turn of the vertical between them."""
    return any(np.allclose(point.cov_in_geo, other.cov_in_geo, rtol=1e-3, atol=1e-9) for other in others)


def _scaled(covariance: Covariance3, factor: float) -> Matrix3:
    first, second, third = (factor * np.array(covariance)).tolist()
    return (tuple(first), tuple(second), tuple(third))


class EstimatedError(Product):
    """Systematic error of the measurements that the adjustment estimated, with its σ, by axis.

    Attributes:
        name: `bias`: fix minus truth, east, north, up, in m. `lever-arm`: antenna seen from the camera beyond the
            arm that the survey has applied, camera axes, in m. `boresight`: rotation vector from the true to the
            nominal camera axes, in degrees. `lidar-shift`: LiDAR minus its true place, east, north, up, in m.
            `earlier-date`: truth minus the places of the earlier date, east, north, up, in m.
        observed: σ is at most half of that of the prior, and of lever arm and boresight at most a tenth.
    """

    name: Literal["bias", "lever-arm", "boresight", "lidar-shift", "earlier-date"]
    session: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    prior: Vector3
    observed: tuple[bool, bool, bool]

    @property
    def text(self) -> str:
        """Values with their σ: `(+0.251 ± 0.012, -0.098 ± 0.011, +0.150 ± 0.030) m right, down, forward`."""
        axes = "right, down, forward" if self.name in ("lever-arm", "boresight") else "east, north, up"
        values = (f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(self.value, self.sigma, strict=True))
        return f"({', '.join(values)}) {self.unit} {axes}"
