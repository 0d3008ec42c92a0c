"""Surveyed points, measured by the solution: check points, cross-validation, and residuals of the fit.

Each is a section of the report, with errors, accuracy after ASPRS, and predicted accuracy. Cautions name predicted
σ that check points reject, and check points close to control points.
"""

from collections.abc import Container
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from pipelines.adjust.posterior import Posterior
from pipelines.core.products import Remark
from pipelines.core.progress import Progress
from pipelines.core.sentences import listed
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.evaluate.asprs import Assessment, assess
from pipelines.evaluate.blunders import blunder_caution, find_blunders
from pipelines.geometry.statistics import chi2_quantile, residual_stats
from pipelines.surface.picking import DepthMap, depth_around, points_on_surface
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey import report
from pipelines.survey.marks import MarkRays, mark_rays, triangulated_points
from pipelines.survey.solution import Solution, fix_differences
from pipelines.survey.survey import Survey, SurveyedPoint


@dataclass(frozen=True)
class RemeasuredPoints:
    """J surveyed points, measured by triangulation or on the rendered surface."""

    points: tuple[SurveyedPoint, ...]
    error_in_geo: FloatArray  # (J, 3) m, measured minus surveyed; NaN for a point that was not measured
    rays: IntArray  # (J,) number of rays: of the marks in registered images
    cov_in_geo: FloatArray | None = None  # (J, 3, 3) m², predicted of the measured positions; None: no prediction

    @property
    def is_measured(self) -> BoolArray:
        """Mask (J,) of the points that were measured."""
        return np.asarray(np.isfinite(self.error_in_geo).all(axis=1))


def check_point_errors(
    measured: RemeasuredPoints, area_km2: float | None, accused: BoolArray | None = None
) -> report.CheckPointErrors:
    """Return the report's section on check points; the area is that of the scene, None: not known.

    `accused` is the mask (J,) of the points that their predicted σ calls blunders.
    """
    assessment = _assess(measured, area_km2, accused)
    names = np.array([point.name for point in measured.points])
    return report.CheckPointErrors(
        **_figures(measured, assessment),
        refuted=() if accused is None else tuple(names[accused].tolist()),
        asprs=assessment.asprs,
    )


def _residuals(measured: RemeasuredPoints) -> tuple[report.PointResidual, ...]:
    residual = _by_axis(measured.error_in_geo)
    return tuple(
        report.PointResidual(name=point.name, rays=rays, de_m=east, dn_m=north, du_m=up)
        for point, rays, (east, north, up) in zip(measured.points, measured.rays.tolist(), residual, strict=True)
    )


def _assess(
    measured: RemeasuredPoints, area_km2: float | None = None, accused: BoolArray | None = None
) -> Assessment:
    known = measured.is_measured
    vegetated = np.array([point.land_cover == "vegetated" for point in measured.points], dtype=bool)
    cov_survey = [point.cov_in_geo for point in compress(measured.points, known)]
    return assess(
        measured.error_in_geo[known],
        cov_survey,
        vegetated[known],
        area_km2,
        accused=None if accused is None else accused[known],
    )


def _figures(measured: RemeasuredPoints, assessment: Assessment) -> dict[str, Any]:
    among_all = np.zeros(len(measured.points), dtype=bool)
    among_all[measured.is_measured] = assessment.blunder
    blunder = among_all.tolist()
    return {
        **assessment.stats.model_dump(),
        "survey": assessment.survey,
        "with_survey": assessment.with_survey,
        "without_blunders": assessment.without_blunders,
        "with_survey_without_refuted": assessment.with_survey_without_refuted,
        "blunders": tuple(point.name for point in compress(measured.points, blunder)),
        "predicted": _predicted_sigma(measured),
        "points": _rows(measured, blunder),
    }


def _rows(measured: RemeasuredPoints, blunder: list[bool]) -> report.PointRows:
    """Return one row for each point, with its predicted σ if there is a prediction."""
    rows = [
        report.PointError(**residual.model_dump(), blunder=is_blunder)
        for residual, is_blunder in zip(_residuals(measured), blunder, strict=True)
    ]
    if measured.cov_in_geo is None:
        return tuple(rows)
    sigma = _by_axis(np.sqrt(np.diagonal(measured.cov_in_geo, axis1=1, axis2=2)))
    return tuple(
        report.PredictedPointError(**row.model_dump(), sigma_e_m=east, sigma_n_m=north, sigma_u_m=up)
        for row, (east, north, up) in zip(rows, sigma, strict=True)
    )


def _by_axis(values: FloatArray) -> list[tuple[float, float, float] | tuple[None, None, None]]:
    """Return rows (J, 3) as numbers; None for a row that is not finite along every axis."""
    rows = ((float(east), float(north), float(up)) for east, north, up in values)
    return [row if np.isfinite(row).all() else (None, None, None) for row in rows]


def rms_sigma(cov: FloatArray) -> report.RmsSigma:
    """Return the root mean square of σ over the points whose covariance of (J, 3, 3) is finite."""
    known = cov[np.isfinite(cov).all(axis=(1, 2))]
    if not len(known):
        return report.RmsSigma(count=0, rms_h_m=None, rms_v_m=None)
    east, north, up = np.diagonal(known, axis1=1, axis2=2).mean(axis=0).tolist()
    return report.RmsSigma(count=len(known), rms_h_m=float(np.sqrt(east + north)), rms_v_m=float(np.sqrt(up)))


def _predicted_sigma(measured: RemeasuredPoints) -> report.PredictedSigma | None:
    """Return the predicted σ, and the mean of error² over variance, by axis.

    The variance includes the survey's. The mean is 1 on the average if both variances are true.
    """
    if measured.cov_in_geo is None:
        return None
    cov_survey = np.array([point.cov_in_geo for point in measured.points]).reshape(-1, 3, 3)
    variance = np.diagonal(measured.cov_in_geo + cov_survey, axis1=1, axis2=2)
    known = measured.is_measured & np.isfinite(variance).all(axis=1)
    normalised = report.ByAxis(e=None, n=None, u=None)
    if known.any():
        east, north, up = (measured.error_in_geo[known] ** 2 / variance[known]).mean(axis=0).tolist()
        normalised = report.ByAxis(e=east, n=north, u=up)
    sigma = rms_sigma(measured.cov_in_geo[known])
    return report.PredictedSigma(**sigma.model_dump(), normalised_error_squared=normalised)


def triangulated_check_points(
    survey: Survey, posterior: Posterior, area_km2: float | None = None
) -> report.CheckPointErrors:
    """Return the errors of the check points as intersections of their marks' rays, with their predicted σ."""
    points, rays = survey.check_points, mark_rays(survey.check_points, posterior.sparse)
    position = triangulated_points(posterior.solution, rays)
    cov = posterior.of_marked_points(position, rays) if points else None
    accused, joint = np.zeros(len(points), dtype=bool), jointly_checked(survey, posterior)
    if joint is not None:
        wrong = compress(joint.names, find_blunders(joint.error_in_geo, joint.cov).wrong)
        accused = np.isin([point.name for point in points], tuple(wrong))
    return check_point_errors(_compared(points, position, rays, cov), area_km2, accused)


@dataclass(frozen=True)
class JointErrors:
    """Errors of the triangulated check points with their joint covariance: of prediction, marks and survey."""

    names: tuple[str, ...]
    error_in_geo: FloatArray  # (J, 3) m
    cov: FloatArray  # (3 J, 3 J) m²

    def without(self, names: Container[str]) -> "JointErrors":
        """Return the errors of the other points."""
        kept = np.array([name not in names for name in self.names], dtype=bool)
        axes = np.repeat(kept, 3)
        return JointErrors(tuple(compress(self.names, kept)), self.error_in_geo[kept], self.cov[np.ix_(axes, axes)])


def jointly_checked(survey: Survey, posterior: Posterior) -> JointErrors | None:
    """Return the errors of the check points that have a predicted σ; None: there is no such point."""
    points = survey.check_points
    if not points:
        return None
    rays = mark_rays(points, posterior.sparse)
    position = triangulated_points(posterior.solution, rays)
    variance = np.diagonal(posterior.of_marked_points(position, rays), axis1=1, axis2=2)
    known = np.asarray(np.isfinite(position + variance).all(axis=1))
    if not known.any():
        return None
    chosen = tuple(compress(points, known))
    error = position[known] - np.array([point.position_in_geo for point in chosen])
    cov = posterior.jointly_of_marked_points(position[known], rays.of_points(known))
    cov = cov + block_diag(*(point.cov_in_geo for point in chosen))
    return JointErrors(tuple(point.name for point in chosen), error, cov)


def check_points_on_surface(
    points: tuple[SurveyedPoint, ...], renderer: ModelRenderer, progress: Progress, area_km2: float | None = None
) -> report.CheckPointErrors:
    """Return the errors of the check points as places of the Gaussians' surface behind their marks."""
    rays, maps = mark_rays(points, renderer.sparse), list[DepthMap]()
    with progress.task("depth at marks", len(rays.point)) as task:
        for camera, xy in zip(rays.camera, rays.xy, strict=True):
            maps.append(depth_around(renderer, int(camera), xy))
            task.advance()
    position = points_on_surface(renderer.model, rays, maps)
    return check_point_errors(_compared(points, position, rays), area_km2)


def cross_validate(survey: Survey, posterior: Posterior) -> report.CrossValidation:
    """Return the errors of the control points, each measured by a solution without that point.

    The adjustment has stored them. The covariance is that of the solution and the marks: the survey's own is
    subtracted. The error is NaN for a point that entered no solution, or if the others determine none.
    """
    points = survey.control_points
    error, cov = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    left_out = {row.name: row for row in posterior.solution.measurements if row.kind == "control point"}
    for index, point in enumerate(points):
        row = left_out.get(point.name)
        if row is not None and row.left_out_error_m is not None and row.left_out_cov_m2 is not None:
            error[index] = row.left_out_error_m
            cov[index] = np.array(row.left_out_cov_m2) - np.array(point.cov_in_geo)
    measured = RemeasuredPoints(points, error, mark_rays(points, posterior.sparse).marks_of_point, cov)
    assessment = _assess(measured)  # without a class, because control points are not check points
    impossible = "no control point can be spared, or none entered the adjustment"
    return report.CrossValidation(
        **_figures(measured, assessment), reason=None if assessment.stats.count else impossible
    )


def _compared(
    points: tuple[SurveyedPoint, ...], position_in_geo: FloatArray, rays: MarkRays, cov: FloatArray | None = None
) -> RemeasuredPoints:
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    return RemeasuredPoints(points, position_in_geo - surveyed, rays.marks_of_point, cov)


def control_residuals(survey: Survey, posterior: Posterior) -> report.ControlResiduals:
    """Return the residuals of the control points: the fit of the solution, not its accuracy."""
    points, solution = survey.control_points, posterior.solution
    rays = mark_rays(points, posterior.sparse)
    measured = _compared(points, triangulated_points(solution, rays), rays)
    rejected = np.isin([point.name for point in points], solution.control_outliers)
    stats = residual_stats(measured.error_in_geo[measured.is_measured & ~rejected])
    return report.ControlResiduals(**stats.model_dump(), outliers=int(rejected.sum()), points=_residuals(measured))


def fix_residuals(survey: Survey, solution: Solution) -> report.FixResiduals:
    """Return the residuals of the fixes without outliers: the fit of the solution, not its accuracy."""
    fixes = fix_differences(solution, survey)
    stats = residual_stats(fixes.difference_in_geo[~fixes.is_outlier])
    return report.FixResiduals(**stats.model_dump(), outliers=int(fixes.is_outlier.sum()))


def distance_errors(survey: Survey, posterior: Posterior) -> tuple[report.DistanceError, ...]:
    """Return the known distances of the survey, measured between the intersections of their ends' marks."""
    known, solution = survey.distances, posterior.solution
    rays = mark_rays([end for distance in known for end in distance.ends], posterior.sparse)
    ends_in_geo = triangulated_points(solution, rays)
    rejected = {row.name for row in solution.measurements if row.kind == "distance" and not row.used}
    length_m, sigma_m = np.linalg.norm(ends_in_geo[::2] - ends_in_geo[1::2], axis=1), np.full(len(known), np.nan)
    if (whole := np.isfinite(length_m)).any():
        ends = np.repeat(whole, 2)
        sigma_m[whole] = np.sqrt(posterior.of_distances(ends_in_geo[ends], rays.of_points(ends)))

    def stated(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return tuple(
        report.DistanceError(
            name=distance.name,
            use=distance.use,
            rejected=distance.name in rejected,
            distance_m=distance.distance_m,
            stated_sigma_m=distance.sigma_m,
            measured_m=stated(length),
            error_m=stated(length - distance.distance_m),
            sigma_m=stated(sigma),
        )
        for distance, length, sigma in zip(known, length_m, sigma_m, strict=True)
    )


_LEAST_POINTS = 3
_RANGE = (0.005, 0.995)  # probabilities of χ²: 99 % of true predictions lie within
_NEAR_M = 1.0
_SINGULAR = 1e-12  # of the largest variance: directions of smaller variance are left out


def cautions_of_prediction(
    survey: Survey, posterior: Posterior, triangulated: report.CheckPointErrors, *, of_initial: bool
) -> tuple[Remark, ...]:
    """Return the limits of the predicted accuracy; `of_initial`: the points have the initial similarity."""
    if of_initial:
        sentence = "The points are measured with the initial similarity; the predicted σ are of the adjusted one."
        return (Remark(code="prediction-of-adjusted-similarity", sentence=sentence),)
    joint = jointly_checked(survey, posterior)
    if joint is None:
        return ()
    wrong_points = find_blunders(joint.error_in_geo, joint.cov)
    named = blunder_caution(joint.names, joint.error_in_geo, wrong_points)
    others = joint.without(frozenset(compress(joint.names, wrong_points.wrong | wrong_points.doubtful)))
    blunders = frozenset(triangulated.blunders) & frozenset(others.names)
    test = chi2_caution(others.names, others.error_in_geo.ravel(), others.cov, blunders)
    return named if test is None else (*named, test)


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
            f"together are {ratio**-0.5:.1f} times the errors.",
            remedy="State smaller σ, such as --sigma-mark.",
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
