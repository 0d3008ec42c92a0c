"""Cautions of an evaluation: predicted σ that check points reject, and check points close to control points."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from pipelines.adjust.posterior import Posterior
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.robust.statistics import chi2_quantile
from pipelines.survey.marks import mark_rays
from pipelines.survey.report import CheckPointErrors
from pipelines.survey.survey import Survey
from pipelines.survey.trained_survey import SolvedSurvey, triangulated_points

_LEAST_POINTS = 3
_RANGE = (0.005, 0.995)  # probabilities of χ²: 99 % of true predictions lie within
_NEAR_M = 1.0
_SINGULAR = 1e-12  # of the largest variance: directions of smaller variance are left out


def cautions_of_prediction(
    solved: SolvedSurvey, posterior: Posterior, triangulated: CheckPointErrors, *, of_initial: bool
) -> tuple[Remark, ...]:
    """Return the limits of the predicted accuracy; `of_initial`: the points have the initial similarity."""
    if of_initial:
        sentence = "The points are measured with the initial similarity; the predicted σ are of the adjusted one."
        return (Remark(code="prediction-of-adjusted-similarity", sentence=sentence),)
    points = solved.survey.check_points
    if len(points) < _LEAST_POINTS:
        return ()
    rays = mark_rays(points, solved.sparse)
    position = triangulated_points(solved, rays)
    variance = np.diagonal(posterior.of_marked_points(position, rays), axis1=1, axis2=2)
    known = np.asarray(np.isfinite(position + variance).all(axis=1))
    if known.sum() < _LEAST_POINTS:
        return ()
    chosen = [point for point, is_known in zip(points, known, strict=True) if is_known]
    error = position[known] - np.array([point.position_in_geo for point in chosen])
    cov = posterior.jointly_of_marked_points(position[known], rays.of_points(known))
    cov = cov + block_diag(*(point.cov_in_geo for point in chosen))
    names = tuple(point.name for point in chosen)
    test = chi2_caution(names, error.ravel(), cov, frozenset(triangulated.blunders))
    return () if test is None else (test,)


def chi2_caution(
    names: tuple[str, ...], error: FloatArray, cov: FloatArray, blunders: frozenset[str] = frozenset()
) -> Remark | None:
    """Return a caution if errors (3 J,) are outside the 99 % range that their covariance (3 J, 3 J) allows.

    The points share errors, so the test takes their joint covariance, of prediction and survey: eᵀ C⁻¹ e is χ² with
    3 J degrees of freedom.
    """
    if len(names) < _LEAST_POINTS:
        return None
    variance, axis = np.linalg.eigh((cov + cov.T) / 2)
    regular = variance > _SINGULAR * variance[-1]
    white = (axis.T @ error)[regular] / np.sqrt(variance[regular])
    squared, freedom = float(white @ white), int(regular.sum())
    least, most = (float(chi2_quantile(quantile, freedom)) for quantile in _RANGE)
    if least <= squared <= most:
        return None
    ratio = squared / freedom
    figures = (
        f"the mean squared normalised error of {len(names)} triangulated check points is {ratio:.2g}, and 99 % of "
        f"right predictions give {least / freedom:.2g} to {most / freedom:.2g}"
    )
    if squared < least:
        return Remark(
            code="prediction-pessimistic",
            sentence=f"The predicted σ are too large: {figures}. The σ of prediction, marks and check points "
            f"together are {ratio**-0.5:.1f} times the errors. State smaller σ, such as --sigma-mark.",
        )
    others = tuple(name for name in names if name not in blunders)
    good = np.repeat([name not in blunders for name in names], 3)
    alone = ""
    if _LEAST_POINTS <= len(others) < len(names) and not chi2_caution(others, error[good], cov[np.ix_(good, good)]):
        left_out = tuple(name for name in names if name in blunders)
        alone = f" Without the blunders ({listed(left_out)}) the errors agree with the prediction."
    return Remark(
        code="prediction-rejected",
        sentence=f"The predicted σ are too small: {figures}. The errors are {ratio**0.5:.1f} times the σ of "
        f"prediction, marks and check points together.{alone}",
    )


def dependent_check_points(survey: Survey) -> tuple[Remark, ...]:
    """Return a caution that names the check points within 1 m of a control point, horizontally and vertically."""
    control = np.array([point.position_in_geo for point in survey.control_points]).reshape(-1, 3)
    pairs = []
    for point in survey.check_points if len(control) else ():
        away = np.array(point.position_in_geo) - control
        distance = np.linalg.norm(away, axis=1)
        near = (np.hypot(away[:, 0], away[:, 1]) <= _NEAR_M) & (np.abs(away[:, 2]) <= _NEAR_M)
        if near.any():
            index = int(np.argmin(np.where(near, distance, np.inf)))
            pairs.append(f"{point.name} ({distance[index]:.2f} m from {survey.control_points[index].name})")
    if not pairs:
        return ()
    sentence = (
        f"{len(pairs)} of {len(survey.check_points)} check points may be the same feature as a control point, and "
        f"then measure no accuracy: {listed(tuple(pairs))}."
    )
    return (Remark(code="check-point-not-independent", sentence=sentence),)
