"""Traffic lights of the summary: level, measured values, rule and reason of each verdict.

Every rule is stated on the page. `unknown` is the verdict where nothing was measured.
"""

import math
import statistics
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from pipelines.core.products import NOT_CHECKED, Remark
from pipelines.core.sentences import listed
from pipelines.core.types import Vector3
from pipelines.geometry.statistics import NORMAL_MAD
from pipelines.report.page import decibel, number_text, share
from pipelines.survey.measurement_errors import Group, VarianceFactor
from pipelines.survey.report import (
    CheckPointErrors,
    CheckPoints,
    DistanceError,
    EvaluationReport,
    PhotometricFigures,
    SurfaceHeight,
)
from pipelines.survey.survey import LOCAL_FRAME

Level = Literal["good", "fair", "poor", "unknown"]

# Limits of good and of fair.
REGISTERED = (0.95, 0.80)  # share of the photographs
OVERLAP = (0.90, 0.70)  # share of the ground that enough photographs see
REPROJECTION_PX = (1.0, 2.0)
FIX_OUTLIERS = (0.05, 0.20)  # share of the fixes
CONTROL_POINTS = (4, 3)
LEAST_TESTED = 3  # check points, from which `evaluate` tests the predicted σ
_LEAST_DISTANCES, _DISTANCE_SIGMAS = 3, 3.0
TEST_PSNR_DB = (22.0, 18.0)
DELIVERED = (0.9, 0.7)
_FIX_SIGMAS, _MOST_NAMED = 3.0, 4
_TOO_LARGE = 0.995  # probability from which the table shows 1.00, which its note calls a σ that is too large
_COVERAGE_DB = 2.0  # by which covered ground is better, where the lack of coverage is to blame


@dataclass(frozen=True)
class Verdict:
    """Verdict on one quality of the survey: `reading` is the measurement, `rule` the limits of good and fair."""

    subject: str
    level: Level
    reading: str
    reason: str
    rule: str


@dataclass(frozen=True)
class Measured:
    """Measurements that the verdicts need beside the report of `evaluate`."""

    photographs: int
    registered: int
    enough_share: float | None  # of the ground, that at least `enough` photographs see; None: no scene
    enough: int
    parts: int  # groups of photographs that nothing ties to each other
    rmse_px: float | None  # of the reprojection residuals; None: no observations
    fixes: int  # number, of the training photographs
    fix_outliers: int
    control_points: int  # used ones; the rejected are `control_outliers`
    control_outliers: int
    check_points: int
    stale: tuple[str, ...]  # stages whose product is not current
    outliers: tuple[str, ...] = ()  # names of the photographs whose fixes were left out
    rejected: tuple[str, ...] = ()  # names of the control points that were left out
    largest_fix: tuple[str, float] | None = None  # largest residual of a used fix along an axis, in its stated σ
    delivered: tuple[float, float] | None = None  # share of the rasters that is measured, and their hectares


# What the test of the predicted σ says of the check points' errors, by the code of its caution.
_OF_CHECK_POINTS = {"prediction-rejected": "more", "prediction-pessimistic": "less"}

_OF_FIXES: tuple[Group, ...] = ("fixes", "horizontal drift", "vertical drift")
_SCATTER = 2.25  # variance factor, of σ that are larger by one half
_HEIGHT_OFF, _LEAST_HEIGHTS = 6.0, 5  # robust σ of the heights, and points that have one
_SMALL = 0.25  # variance factor, below which residuals are less than half of σ

_Fields = tuple[Level, str, str, str]  # of a verdict without its subject, in their order


def verdicts(report: EvaluationReport, measured: Measured, cautions: Sequence[Remark]) -> tuple[Verdict, ...]:
    """Return the verdicts on a survey, in the order of the work."""
    triangulated, on_surface, test = report.checkpoints.triangulated, report.checkpoints.surface, report.test_views
    codes = {caution.code for caution in (*cautions, *report.cautions)}
    is_local = LOCAL_FRAME in codes  # without positions and ground points
    of_place = {
        "Recorded positions": _fixes(measured, report.variance_factors),
        "Control points": _control(measured),
    }
    of_points = {
        "Check points": _check_points(measured, triangulated),
        "Predicted against measured": _prediction(triangulated, codes),
        "Blunders": _blunders(triangulated),
        **({} if on_surface is None else {"Surface at the points": _surface(report.checkpoints, on_surface)}),
    }
    by_subject: dict[str, _Fields] = {
        "Registered photographs": _registered(measured),
        "Overlap": _overlap(measured),
        **({} if measured.delivered is None else {"Measured share": _delivered(*measured.delivered)}),
        "Reprojection": _reprojection(measured),
        **({"Known distances": _distances(report.distances)} if is_local else of_place),
        "σ of the measurements": _stated_sigma(report.variance_factors, codes),
        **({} if is_local else of_points),
        **({} if test is None else {"Test views": _views(test)}),
        **({"Cautions": _cautions(cautions)} if cautions else {}),
        **({"State of the products": _current(measured)} if measured.stale else {}),
    }
    return tuple(Verdict(subject, *fields) for subject, fields in by_subject.items())


def verdict_of(value: float, limits: tuple[float, float], *, more_is_better: bool) -> Level:
    """Return the verdict on a value by the limits of good and fair."""
    good, fair = limits
    if more_is_better:
        return "good" if value >= good else "fair" if value >= fair else "poor"
    return "good" if value <= good else "fair" if value <= fair else "poor"


def _registered(measured: Measured) -> _Fields:
    part = measured.registered / measured.photographs if measured.photographs else 0.0
    level = verdict_of(part, REGISTERED, more_is_better=True)
    lost = measured.photographs - measured.registered
    reason = "all photographs contribute" if not lost else f"{lost} not used: blurred, or without overlap"
    rule = f"good from {share(REGISTERED[0])}, fair from {share(REGISTERED[1])}"
    return level, f"{measured.registered} of {measured.photographs} ({share(part)})", reason, rule


def _overlap(measured: Measured) -> _Fields:
    rule = (
        f"good if {share(OVERLAP[0])} of the ground is seen by {measured.enough} photographs or more and all hang "
        f"together, fair from {share(OVERLAP[1])}"
    )
    if measured.enough_share is None:
        return "unknown", "no scene", "too few SfM points to map the ground", rule
    level = verdict_of(measured.enough_share, OVERLAP, more_is_better=True)
    reason = "enough rays everywhere" if level == "good" else "the rim of the scene is less accurate: fly beyond it"
    if measured.parts > 1:
        level = "fair" if level == "good" else level
        reason = f"{measured.parts} groups of photographs that few points tie together: add photographs"
    reading = f"{share(measured.enough_share)} of the ground in {measured.enough} photographs or more"
    return level, reading, reason, rule


def _delivered(part: float, area_ha: float) -> _Fields:
    rule = f"good from {share(DELIVERED[0])} of the delivered area, fair from {share(DELIVERED[1])}"
    level = verdict_of(part, DELIVERED, more_is_better=True)
    reason = (
        "the photographs show almost all that is delivered"
        if level == "good"
        else "the rest is interpolated or empty: few views agree there, whatever the overlap; add photographs"
    )
    return level, f"{share(part)} of {number_text(area_ha, 2)} ha measured", reason, rule


def _reprojection(measured: Measured) -> _Fields:
    rule = f"good up to {REPROJECTION_PX[0]:g} px, fair up to {REPROJECTION_PX[1]:g} px"
    if measured.rmse_px is None:
        return "unknown", "no observations", "the SfM model has none", rule
    level = verdict_of(measured.rmse_px, REPROJECTION_PX, more_is_better=False)
    reason = (
        "cameras, lens and points fit together"
        if level == "good"
        else "look at the residuals by image region: a pattern is a fault of the lens model"
    )
    return level, f"{number_text(measured.rmse_px)} px RMSE", reason, rule


def _fixes(measured: Measured, factors: tuple[VarianceFactor, ...]) -> _Fields:
    rule = f"good up to {share(FIX_OUTLIERS[0])} outliers, fair up to {share(FIX_OUTLIERS[1])}"
    if not measured.fixes:
        level: Level = "fair" if measured.control_points >= CONTROL_POINTS[1] else "unknown"
        return level, "none", "the control points alone place the survey", rule
    part = measured.fix_outliers / measured.fixes
    level = verdict_of(part, FIX_OUTLIERS, more_is_better=False)
    name, sigmas = measured.largest_fix or ("", 0.0)
    reason = "all fixes agree with each other within 3 σ"
    if measured.fix_outliers:
        reason = f"left out: {_named(measured.outliers)}"
    elif sigmas > _FIX_SIGMAS:
        reason = f"none was left out; the largest residual is {sigmas:.1f} of its stated σ ({name})"
    of_fixes = [factor for factor in factors if factor.group in _OF_FIXES and factor.applied > _SCATTER]
    if of_fixes and level != "poor":
        scatter = ", ".join(f"{factor.group} {number_text(factor.applied**0.5)} times" for factor in of_fixes)
        level, reason = "fair", f"they scatter about the SfM model beyond their σ: {scatter}"
    reading = f"{measured.fixes} used or tested, {measured.fix_outliers} outliers"
    return level, reading, reason, rule


def _control(measured: Measured) -> _Fields:
    count = measured.control_points
    level: Level = verdict_of(count, CONTROL_POINTS, more_is_better=True) if count else "fair"
    reason = (
        "a common error of the recorded positions cannot be seen without control points"
        if not count
        else "they tie the survey to the reference frame"
        if level == "good"
        else f"{CONTROL_POINTS[0]} well spread points also reveal a mistake in one of them"
    )
    rule = f"good from {CONTROL_POINTS[0]}, fair from {CONTROL_POINTS[1]} or with none (positions only)"
    reading = f"{count} used, {measured.control_outliers} rejected" if measured.control_outliers else str(count)
    if measured.rejected:
        reading += f" ({_named(measured.rejected)})"
    return level, reading, reason, rule


def _named(names: Sequence[str]) -> str:
    """Return names as a list of at most `_MOST_NAMED`, and the number of the others."""
    shown = listed(names[:_MOST_NAMED])
    return shown if len(names) <= _MOST_NAMED else f"{shown} and {len(names) - _MOST_NAMED} more"


def _distances(distances: Sequence[DistanceError]) -> _Fields:
    """Return the verdict on the distances that alone set the scale, by those that check it."""
    rule = (
        f"good from {_LEAST_DISTANCES} distances in the solution and one check within {_DISTANCE_SIGMAS:g} σ, poor "
        "if a check is not, fair otherwise"
    )
    used = sum(distance.use == "control" and not distance.rejected for distance in distances)
    ratios = [
        abs(distance.error_m) / math.hypot(distance.sigma_m, distance.stated_sigma_m)
        for distance in distances
        if distance.use == "check" and distance.error_m is not None and distance.sigma_m is not None
    ]
    reading = f"{used} set the scale, {len(ratios)} check it"
    if ratios and max(ratios) > _DISTANCE_SIGMAS:
        return "poor", reading, f"a check misses by {max(ratios):.1f} σ: check its marks and its length", rule
    if not ratios:
        return "fair", reading, "nothing tests the scale: measure a further distance, of use check", rule
    if used < _LEAST_DISTANCES:
        return "fair", reading, "few distances do not reveal a wrong one", rule
    return "good", reading, "the checks agree with the predicted σ", rule


def _stated_sigma(factors: tuple[VarianceFactor, ...], codes: Collection[str]) -> _Fields:
    """Return the outcome of the χ² tests of the residuals, together with what check points say of the σ."""
    rule = "good if the residuals and the check points agree with the σ, fair if either does not"
    tested = [factor for factor in factors if factor.estimated is not None]
    if not tested:
        return "unknown", "not tested", "there is no redundancy to test them with", rule
    changed = [factor for factor in tested if factor.applied != 1.0]
    if changed:
        reading = ", ".join(f"{factor.group}: σ × {number_text(factor.applied**0.5)}" for factor in changed)
        rejected = any(factor.sigma_source == "stated" for factor in changed)
        reason = "the χ² test rejects a stated σ" if rejected else "these σ were assumed: the data gave them"
        return "fair", reading, reason, rule
    passed = f"residuals agree: {', '.join(factor.group for factor in tested)}"
    for code, words in _OF_CHECK_POINTS.items():
        if code in codes:
            reason = f"the photographs agree with these σ, yet check points err {words} than predicted"
            return "fair", passed, reason, rule
    large = [factor for factor in tested if factor.probability >= _TOO_LARGE and factor.sigma_source == "stated"]
    if large:
        names = ", ".join(f"{factor.group} (probability {number_text(factor.probability)})" for factor in large)
        return "fair", passed, f"these stated σ are larger than the residuals: {names}", rule
    small = [factor.group for factor in tested if factor.estimated is not None and factor.estimated < _SMALL]
    if small:
        return (
            "good",
            passed,
            f"none is too small; the residuals are less than half of σ of {', '.join(small)}",
            rule,
        )
    return "good", passed, "the residuals give no reason to doubt these σ", rule


def _check_points(measured: Measured, errors: CheckPointErrors) -> _Fields:
    least = errors.asprs.least_points
    rule = f"good from {least} measured check points (ASPRS), fair from 1, poor with none"
    if not errors.count:
        reason = (
            "marked in too few registered photographs: mark each in two or more"
            if measured.check_points
            else "nothing measures the accuracy: surveyed points that enter no solution would"
        )
        return "poor", f"{errors.count} of {measured.check_points} measured", reason, rule
    enough = errors.asprs.enough_points
    reason = "an accuracy class may be stated" if enough else f"the standard demands {least} for an accuracy class"
    return "good" if enough else "fair", f"{errors.count} of {measured.check_points} measured", reason, rule


def _prediction(errors: CheckPointErrors, codes: Collection[str]) -> _Fields:
    """Return the outcome of the χ² test of `evaluate`, whose caution has the figures."""
    rule = (
        f"χ² test (99 %) of {LEAST_TESTED} check points or more: good if passed, fair if the σ are too large, poor "
        "if they are too small"
    )
    tested = errors.predicted
    if "prediction-rejected" in codes:
        return "poor", "σ too small", "control points, marks or the datum may be at fault", rule
    if "prediction-pessimistic" in codes:
        reason = "errors are smaller than predicted: the stated accuracy is on the safe side"
        return "fair", "σ too large", reason, rule
    if tested is None or tested.count < LEAST_TESTED or "prediction-of-adjusted-similarity" in codes:
        return "unknown", "not tested", f"needs {LEAST_TESTED} check points with predicted σ", rule
    return "good", f"passed at {tested.count} check points", "errors agree with the predicted σ", rule


def _blunders(errors: CheckPointErrors) -> _Fields:
    rule = "good with none, fair otherwise: beyond three times the class that the others meet"
    if not errors.count:
        return "unknown", "no check points measured", "nothing to look for", rule
    if errors.blunders:
        reason = "look at their image chips: a mark or a coordinate may be wrong"
        return "fair", listed(errors.blunders), reason, rule
    return "good", "none", "no triangulated check point stands out", rule


def _surface(points: CheckPoints, errors: CheckPointErrors) -> _Fields:
    """Return the verdict on the surface, behind the marks and from above.

    A point that surface and triangulation miss alike does not accuse it.
    """
    rule = (
        "good if no check point is a blunder on the rendered surface, nor further below or above it than "
        f"{_HEIGHT_OFF:g} robust σ of all of them, fair up to a fifth, poor beyond"
    )
    if not errors.count:
        return "unknown", "no check points", "nothing to compare with", rule
    triangulated = points.triangulated
    rays = {row.name: row.error_m for row in triangulated.points if row.name in triangulated.refuted}
    alike = {row.name for row in errors.points if _miss_alike(row.error_m, rays.get(row.name))}
    off = sorted({*errors.blunders, *_heights_off(points.heights)} - alike)
    count = len(off)
    level: Level = "good" if not count else "fair" if count <= errors.count / 5 else "poor"
    reason = (
        "the surface of the splat lies where the points are"
        if not count
        else "there the splat shows another surface: thin or moving things, or too little training"
    )
    names = f" ({listed(off)})" if off else ""
    return level, f"{count} of {errors.count} off{names}", reason, rule


def _heights_off(heights: Sequence[SurfaceHeight]) -> list[str]:
    """Return the points at which the surface, seen from above, has another height than at all the others."""
    known = {height.name: abs(height.du_m) for height in heights if height.du_m is not None}
    if len(known) < _LEAST_HEIGHTS:
        return []
    limit_m = _HEIGHT_OFF * NORMAL_MAD * statistics.median(known.values())
    return [name for name, off_m in known.items() if off_m > limit_m]


def _miss_alike(on_surface: Vector3 | None, triangulated: Vector3 | None) -> bool:
    """Return whether both errors of a point have one cause: they differ by less than half of either."""
    if on_surface is None or triangulated is None:
        return False
    return 2.0 * math.dist(on_surface, triangulated) < min(math.hypot(*on_surface), math.hypot(*triangulated))


def _views(test: PhotometricFigures) -> _Fields:
    rule = f"good from {TEST_PSNR_DB[0]:g} dB, fair from {TEST_PSNR_DB[1]:g} dB (mean PSNR)"
    psnr_db, covered_db, covered_share = test.psnr, test.psnr_covered, test.covered_share
    if psnr_db is None:
        return "unknown", "none", "no photograph was left out of the training", rule
    level = verdict_of(psnr_db, TEST_PSNR_DB, more_is_better=True)
    reason = "renders look like the photographs" if level == "good" else "train longer, or at a larger image size"
    if level != "good" and covered_db is not None and covered_share is not None:
        there = verdict_of(covered_db, TEST_PSNR_DB, more_is_better=True)
        if there != level or covered_db - psnr_db > _COVERAGE_DB:
            reason = (
                f"the training photographs show {share(covered_share)} of the test views' ground, and there "
                f"the PSNR is {decibel(covered_db)}: photographs are missing, and longer training adds none"
            )
    return level, f"{decibel(psnr_db)} over {test.views}", reason, rule


def _cautions(cautions: Sequence[Remark]) -> _Fields:
    rule = "poor if nothing checks the positions, fair otherwise"
    unchecked = any(caution.code == NOT_CHECKED for caution in cautions)
    return "poor" if unchecked else "fair", str(len(cautions)), "listed below the table", rule


def _current(measured: Measured) -> _Fields:
    reason = "the input has changed since: parts of this report do not belong together"
    return "poor", f"not current: {', '.join(measured.stale)}", reason, "poor if a product is not current"
