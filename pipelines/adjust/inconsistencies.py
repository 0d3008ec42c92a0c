"""Inconsistencies between sources: fixes against the SfM model, control points against the fixes.

Single outliers are rejected in the adjustment. Where more than a third of a group would have to be rejected, or σ
would have to be ten times the stated one, one side is wrong as a whole. The known mistakes are tried, and the one
that fits is named. One inconsistency is everyday work: a constant shift of all fixes, within the σ of one fix or by
up to five metres, as an autonomous base station causes. Then the control points decide the position.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.adjust.alignment import Correspondences, turn_against
from pipelines.adjust.fix_patterns import FixPattern
from pipelines.adjust.hypotheses import (
    Hypothesis,
    StatedFixes,
    clock_that_turns,
    explanation_of,
    fit,
    hangs_upside_down,
    mirrored,
    vector_text,
)
from pipelines.adjust.joint import Consistency
from pipelines.adjust.level import SIGMA_SLOPE, ground_normal
from pipelines.adjust.measurements import (
    UnusedControlPoint,
    attitude_prior,
    control_correspondences,
    fix_correspondences,
)
from pipelines.adjust.system import Linearised, Problem
from pipelines.adjust.terms import ControlPoints, Fixes, Level
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.geodesy.vertical import FOOT_M, MOST_GEOID_M
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import median_spacing, outlier_gate, typical_sigma
from pipelines.survey.measurement_errors import EstimatedError, Group, VarianceFactor
from pipelines.survey.scene import SparseScene
from pipelines.survey.survey import Survey

Factors = Mapping[Group, VarianceFactor]
_SIGMA_REJECTED = "sigma-rejected"
_OTHER_PHOTOGRAPHS = "other-photographs"
_SIGMA_OPTIONS: dict[Group, str] = {
    "fixes": "--sigma-h and --sigma-v",
    "control points": "--sigma-gcp-h and --sigma-gcp-v",
    "marks": "--sigma-mark",
}
# A stated σ that is too small by this factor is an inconsistency, if the scatter is so many metres or is explained.
_BETTER = 0.7  # part of the scatter under a lag that another explanation has to leave
_WRONG_SIGMA, _WRONG_SCATTER_M = 10.0, 0.3
# A variance factor up to this, of σ that are larger by one half, is applied without a caution.
_QUIET_FACTOR = 2.25
_LEAST_FIXES = 4
# A drift of the fixes is said if its σ is three times the assumed one; ground is steep beyond so many σ of slopes.
_DRIFT_FACTOR, _STEEP_SIGMAS, _WALL_RAD = 9.0, 3.0, np.radians(60.0)
_IN_TIME, _FITS = (
    {"drift", "step"},
    2.0,
)  # explanations that a drift contains; scatter of others over what it leaves
_TILTED_RAD = np.radians(10.0)  # of an explanation against the level of the photographs
_AT_SKY = 0.3  # median up component of the views
# Residuals share a constant shift if it is so many times as large as their mean distance from it.
_SHIFT_SPREADS = 5.0
_ATTITUDE_SIGMAS, _ATTITUDE_RAD = 4.0, np.radians(8.0)
# A turn beyond the first is tested for a clock offset, which explains it if less than the second remains.
_CLOCK_SIGMAS, _EXPLAINED_SIGMAS = 3.0, 1.0
_NAMED = 5  # control points in a caution
# A shift of all fixes up to this is everyday work with an autonomous base station.
_EVERYDAY_SHIFT_M = 5.0
_LEAST_FEET_M = 50.0  # vertical shift, below which feet are not suspected
_FEET_PART = 0.05  # of a height, by which cameras are higher than control points
# Size of the photographs in which marks were measured, and the factor of their pixels.
_SCALES = {"1/2": 2.0, "1/3": 3.0, "1/4": 4.0, "2 times": 0.5, "3 times": 1 / 3, "4 times": 0.25}
_MIRRORED_M = 0.3  # scatter about the SfM model, below which control points fit as they are
_LEAST_POINTS, _SCALE_SIGMAS, _CAUSE_SIGMAS, _LEAST_SCALE = 5, 5.0, 2.0, 0.01  # of two maps that differ in scale
# From x, y and the height of the photograph to the pixels x, y without a mistake.
_AS_STATED = np.eye(2, 3)
_FROM_BELOW = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]])
_EXCHANGED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class _Finding:
    """Remark, and whether it is an inconsistency that ends the stage."""

    code: str
    sentence: str
    ends: bool = False
    remedy: str = ""

    @property
    def remark(self) -> Remark:
        return Remark(code=self.code, sentence=self.sentence, remedy=self.remedy)


def cautions_of(
    survey: Survey,
    scene: SparseScene,
    near: Linearised,
    consistency: Consistency,
    pattern: FixPattern | None = None,
    *,
    bent: bool = False,
) -> tuple[tuple[Remark, ...], tuple[Remark, ...]]:
    """Return the inconsistencies, which end the stage unless the user accepts them, and further limits.

    `near` is the minimum in the scene; it has estimated the lever arm that the fixes' `pattern` shows, if any. Of a
    model that is known to be `bent` fixes are not taken for those of other photographs.
    """
    model, geo_from_local = scene.sparse, scene.geo_from_local(near.state.geo_from_model)
    fixes, weighted, factors = StatedFixes(survey, model), consistency.weighted(survey), consistency.factors
    findings, mistake = list(_upside_down(fixes, geo_from_local)), _mistake_in_map(survey, model)
    of_map = []
    if mistake is not None:
        sentence = f"Control points and fixes disagree: {mistake}"
        of_map.append(_Finding("control-map", sentence, ends=True))
    if not findings:
        of_lag = list(_lag_of_fixes(fixes, factors.get("fixes"), pattern))
        up = geo_from_local.rotation[2]
        findings += of_lag or (
            [] if of_map else _fixes_against_model(fixes, weighted, near, consistency, up=up, bent=bent)
        )
        findings += _view(model, geo_from_local)
    findings += of_map or [
        *_shift_of_fixes(weighted, near.problem, consistency.biases),
        *_control_points(weighted, near, consistency),
    ]
    findings += _steep_ground(survey, model, near.problem, geo_from_local)
    findings += [
        *_attitudes(survey, fixes, geo_from_local),
        *_weak_checks(weighted, near.problem, factors),
        *_assumed_sigmas(weighted, factors),
    ]
    ending, others = (
        tuple(finding.remark for finding in findings if finding.ends == ends) for ends in (True, False)
    )
    return ending, others


def unadjustable(
    survey: Survey, model: SparseModel, geo_from_local: Similarity | None, pattern: FixPattern | None = None
) -> tuple[Remark, ...]:
    """Return the inconsistencies of measurements that determine no adjustment, and perhaps no alignment (None)."""
    fixes = StatedFixes(survey, model)
    if geo_from_local is not None and hangs_upside_down(model, geo_from_local):
        return tuple(one.remark for one in _upside_down(fixes, geo_from_local))
    if len(fixes.name) < _LEAST_FIXES:
        return ()
    try:
        scatter, best = fit(fixes.center_in_local, fixes.position_in_geo)[1], explanation_of(fixes)
    except DegenerateGeometryError:
        return ()
    if scatter < max(_WRONG_SIGMA * fixes.sigma_m, _WRONG_SCATTER_M):
        return ()
    if (
        pattern is not None
        and pattern.has_lag
        and (best is None or best.scatter_m >= _BETTER * pattern.scatter_m[1])
    ):
        return (_lag(pattern, ends=True).remark,)
    cause = "Check that they belong to these photographs." if best is None else best.sentence
    sentence = f"The fixes scatter by {scatter:.2f} m along each axis about the SfM model: no similarity fits them."
    code, remedy = (_OTHER_PHOTOGRAPHS, "") if best is None else (best.code, best.remedy)
    return (Remark(code=code, sentence=f"{sentence} {cause}", remedy=remedy),)


def marks_that_do_not_meet(unused: Sequence[UnusedControlPoint], mistake: str | None) -> tuple[Remark, ...]:
    """Return the caution that rays of marks of control points do not meet in one point; none if they do.

    `mistake` is the cause that explains most of them, if one is known; then no control point is used.
    """
    missed = [point for point in unused if len(point.residual_px) >= 2]
    if not missed:
        return ()
    worst = sorted(missed, key=lambda point: -max(point.residual_px))[:_NAMED]
    named = listed([f"{point.name} ({max(point.residual_px):.0f} px)" for point in worst])
    more = "" if len(missed) <= _NAMED else f" and {len(missed) - _NAMED} more"
    sentence = f"The rays of the marks of {len(missed)} control points do not meet: {named}{more}. "
    sentence += "These points are not used." if mistake is None else f"No control point is used. {mistake}"
    return (Remark(code="control-marks", sentence=sentence),)


def _is_wrong(factor: VarianceFactor) -> bool:
    """Return whether a stated σ is too small by more than the factor of an inconsistency."""
    return factor.sigma_source == "stated" and factor.applied > _WRONG_SIGMA**2


def _upside_down(fixes: StatedFixes, geo_from_local: Similarity) -> Iterator[_Finding]:
    if not hangs_upside_down(fixes.model, geo_from_local):
        return
    sentence = "The cameras hang upside down in this solution: the positions disagree with the SfM model."
    best = explanation_of(fixes)
    if best is None:
        yield _Finding("upside-down", sentence, ends=True)
    else:
        yield _Finding("upside-down", f"{sentence} {_explained(best)}", ends=True, remedy=best.remedy)


def _view(model: SparseModel, geo_from_local: Similarity) -> Iterator[_Finding]:
    up_of_views = model.rotation_cam_from_local[:, 2] @ geo_from_local.rotation[2]
    if np.median(up_of_views) > _AT_SKY:
        sentence = "Most cameras look up at the sky in this solution. If they did not, the positions are wrong."
        yield _Finding("looks-at-sky", sentence)


def _fixes_against_model(
    fixes: StatedFixes, survey: Survey, near: Linearised, consistency: Consistency, *, up: FloatArray, bent: bool
) -> Iterator[_Finding]:
    """Yield the finding that the fixes scatter more than stated, in a solution with an upward direction (3,)."""
    factor, drifts = consistency.factors.get("fixes"), _drifts(consistency.factors)
    if factor is None or (factor.applied <= _QUIET_FACTOR and not drifts):
        return
    is_wrong = _is_wrong(factor)
    shift = _constant_shift(consistency.missed(near, Fixes.kind)[1])
    if shift is not None and near.problem.term(ControlPoints.kind) is not None:
        yield _apart(-shift, survey, ends=is_wrong)
        return
    scatter_m, rejected = fixes.sigma_m * factor.applied**0.5, factor.count - factor.used
    if drifts:  # it has taken a part of the scatter, and explains more than any cause that leaves some
        scatter_m = max(scatter_m, _plain_scatter(fixes))
        is_wrong |= factor.sigma_source == "stated" and scatter_m > _WRONG_SIGMA * fixes.sigma_m
    sides = (
        f"The fixes scatter by {scatter_m:.2f} m along each axis about the SfM model; their {_source(factor)} σ is "
        f"{fixes.sigma_m:.3g} m"
    )
    sides += f", and {rejected} of {factor.count} are outliers." if rejected else "."
    best = explanation_of(fixes)
    if best is not None and drifts:
        _, missed, used = consistency.missed(near, Fixes.kind)
        left_m = float(np.sqrt((missed[used] ** 2).mean()))
        tilt = up @ best.geo_from_local.rotation[2]
        if best.code in _IN_TIME or best.scatter_m > _FITS * left_m or tilt < np.cos(_TILTED_RAD):
            best = None
    if best is not None:
        yield _Finding(best.code, f"{sides} {_explained(best)}", ends=is_wrong, remedy=best.remedy)
        return
    if drifts:
        yield _drifting(drifts, near)
        return
    if scatter_m > median_spacing(fixes.position_in_geo) / 2 and not bent:
        code, remedy = _OTHER_PHOTOGRAPHS, ""
        cause = "They are farther off than photographs are apart. Check that they belong to these photographs."
    else:
        code, remedy = _SIGMA_REJECTED, f"State the σ with {_SIGMA_OPTIONS['fixes']}."
        cause = (
            "No offset, time, axis or group of fixes explains the scatter: the fixes are noisier than their σ, or "
            "the SfM model is bent. Every σ of the result is enlarged."
        )
    ends = is_wrong and scatter_m > _WRONG_SCATTER_M
    yield _Finding(code, f"{sides} {cause}", ends=ends, remedy=remedy)


def _lag_of_fixes(
    fixes: StatedFixes, factor: VarianceFactor | None, pattern: FixPattern | None
) -> Iterator[_Finding]:
    """Yield the finding that residuals have the pattern of fixes at other times than those of the photographs."""
    if pattern is None or not pattern.has_lag:
        return
    other = explanation_of(fixes)
    if other is not None and other.scatter_m < _BETTER * pattern.scatter_m[1]:
        return
    yield _lag(pattern, ends=factor is not None and _is_wrong(factor))


def _lag(pattern: FixPattern, *, ends: bool) -> _Finding:
    """Return the finding of a lag of the fixes."""
    along_m = abs(pattern.lag_s) * float(np.median(np.linalg.norm(pattern.velocity_in_geo, axis=1)))
    sentence = (
        f"The navigation clock differs by {pattern.lag_s:+.2f} ± {pattern.sigma_lag_s:.2f} s from the camera's: "
        f"the fixes {'lag' if pattern.lag_s > 0 else 'lead'} the exposures by {along_m:.2f} m along the motion. "
        f"Without that they scatter by {pattern.scatter_m[1]:.2f} m about the SfM model along an axis, with it by "
        f"{pattern.scatter_m[0]:.2f} m."
    )
    remedy = (
        "Correct the times, let `georef ingest --time-offset auto` estimate the offset, or, for positions by "
        "photograph, `georef calibrate`."
    )
    return _Finding("clock", sentence, ends=ends, remedy=remedy)


def arm_caution(pattern: FixPattern) -> Remark:
    """Return the caution that a lever arm is estimated, whose pattern the residuals have."""
    (forward, right), (sigma_forward, sigma_right) = pattern.arm_m, pattern.sigma_arm_m
    sentence = (
        f"The fixes have the pattern of a lever arm: the antenna is {forward:+.2f} ± {sigma_forward:.2f} m forward "
        f"and {right:+.2f} ± {sigma_right:.2f} m right of the camera. Without it they scatter by "
        f"{pattern.scatter_m[1]:.3f} m about the SfM model along an axis, with it by {pattern.scatter_m[0]:.3f} m. "
        "It is estimated with the adjustment."
    )
    remedy = "State it with `georef ingest --lever-arm` and --camera-mount."
    return Remark(code="lever-arm", sentence=sentence, remedy=remedy)


def _drifts(tested: Factors) -> list[VarianceFactor]:
    """Return the tests of the drift of the fixes that find it far larger than assumed."""
    groups: tuple[Group, ...] = ("horizontal drift", "vertical drift")
    factors = [tested[group] for group in groups if group in tested]
    return [factor for factor in factors if factor.applied > _DRIFT_FACTOR]


def _plain_scatter(fixes: StatedFixes) -> float:
    """Return the scatter per axis in metres of the fixes about the SfM model, without any drift."""
    try:
        return fit(fixes.center_in_local, fixes.position_in_geo)[1]
    except DegenerateGeometryError:
        return 0.0


def _drifting(drifts: Sequence[VarianceFactor], near: Linearised) -> _Finding:
    fixes, errors = near.problem.term(Fixes.kind), near.problem.errors
    assert isinstance(fixes, Fixes)
    drifting = np.array([block.name == "drift" for block in errors.blocks])
    drift = fixes.shares(errors)[:, drifting] @ near.state.errors.reshape(-1, 3)[drifting]
    groups, spread = {factor.group for factor in drifts}, np.ptp(drift, axis=0)
    parts = []
    if "horizontal drift" in groups:
        parts.append(f"{float(spread[:2].max()):.0f} m horizontally")
    if "vertical drift" in groups:
        parts.append(f"{float(spread[2]):.0f} m in height")
    level = near.problem.term(Level.kind)
    by = (
        "Control points or nothing level the survey"
        if not isinstance(level, Level)
        else "What the photographs know of the vertical levels the survey, with a σ of "
        f"{np.degrees(np.sqrt(level.cov[0].diagonal().max())):.1f}°"
    )
    sentence = (
        f"The recorded positions drift within the flight: against the photographs they change by {listed(parts)}, "
        f"far more than a receiver without corrections does. {by}; neither heights nor terrain are known better "
        "than the σ of the result, which the drift enlarges."
    )
    return _Finding("position-drift", sentence, remedy="Give control points with --gcp, or other positions.")


def _steep_ground(
    survey: Survey, model: SparseModel, problem: Problem, geo_from_local: Similarity
) -> Iterator[_Finding]:
    """Yield the finding that the ground is steeper than sites are, where the fixes may drift in height."""
    if problem.term(ControlPoints.kind) is not None or not survey.drifts:
        return
    up = geo_from_local.rotation[2]
    normal = ground_normal(model, up)
    if normal is None:
        return
    slope = float(np.arccos(np.clip(normal @ up, -1.0, 1.0)))
    if _STEEP_SIGMAS * SIGMA_SLOPE < slope < _WALL_RAD:
        sentence = (
            f"The ground as a whole is inclined by {np.degrees(slope):.0f}° in this solution. If the site is not, "
            "recorded heights that drift within the flight have tilted the survey."
        )
        yield _Finding("ground-steep", sentence, remedy="Check them, or give control points with --gcp.")


def _shift_of_fixes(survey: Survey, problem: Problem, biases: Sequence[EstimatedError]) -> Iterator[_Finding]:
    """Yield the finding that the fixes of a session are shifted against the control points, beyond their σ."""
    fixes = problem.term(Fixes.kind)
    if fixes is None:
        return
    for bias in biases:
        information = (np.swapaxes(fixes.root_information, 1, 2) @ fixes.root_information).mean(axis=0)
        # The variance of an estimate under a prior is the prior's variance less the estimate's own (posterior).
        shift_m, variance = np.array(bias.value), np.square(bias.prior) - np.square(bias.sigma)
        # A datum that was only assumed explains no shift: the receiver's own common error is the measure. Of a zero
        # that is known to be doubtful, nothing else was expected.
        of_datum = np.zeros(3) if bias.session is None else np.array(survey.sessions[bias.session].sigma_datum_m)
        if problem.term(ControlPoints.kind) is None:
            of_datum = np.zeros(3)
        elif any(image.fix is not None and image.fix.sigma_zero_m for image in survey.images):
            of_datum[2] = 0.0
        variance = np.maximum(variance, 1e-9) * _without_datum(bias, np.square(of_datum))
        if (shift_m**2 / np.maximum(variance, 1e-9)).sum() <= outlier_gate(3):
            continue
        values = ", ".join(
            f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(bias.value, bias.sigma, strict=True)
        )
        of_receiver = np.sqrt(np.maximum(np.square(bias.prior) - np.square(of_datum), 0.0))
        stated = ", ".join(f"{sigma:.3g}" for sigma in of_receiver)
        sentence = (
            f"All fixes are shifted by ({values}) m east, north, up against the control points, which determine "
            f"the position; the σ of the fixes' common error is ({stated}) m. Either side may be wrong. Check "
            f"{_cause_of_shift(shift_m, survey)}."
        )
        within_one_fix = bool(shift_m @ information @ shift_m <= outlier_gate(3))
        is_everyday = bool(np.linalg.norm(shift_m) <= _EVERYDAY_SHIFT_M)
        yield _Finding("fixes-shifted", sentence, ends=not (within_one_fix or is_everyday))


def _without_datum(bias: EstimatedError, of_datum: FloatArray) -> FloatArray:
    """Return by which factor (3,) the variance of an estimate shrinks under a prior without the part of the datum.

    With the prior's variance p, that of the estimate s and of the observations alone L = p s / (p − s), the square
    of the estimate has the expectation (p − s)² / (p² (r + L)) under a prior r.
    """
    prior, sigma = np.square(bias.prior), np.square(bias.sigma)
    gained = np.maximum(prior - sigma, 1e-12)
    observed = prior * sigma / gained
    of_receiver = np.maximum(prior - of_datum, 1e-9)
    return np.asarray((of_receiver + observed) / (prior + observed))


def _control_points(survey: Survey, near: Linearised, consistency: Consistency) -> Iterator[_Finding]:
    names, residual, used = consistency.missed(near, ControlPoints.kind)
    factor = consistency.factors.get("control points")
    if factor is None:
        return
    shift = _constant_shift(residual)
    if shift is not None and near.problem.term(Fixes.kind) is not None and (factor.applied > 1.0 or not used.all()):
        yield _apart(shift, survey, ends=True)
    elif factor.applied > _QUIET_FACTOR:
        scatter_m = float(np.sqrt((residual**2).mean()))
        sentence = (
            f"The residuals of the control points are {scatter_m:.2f} m RMS along each axis; their "
            f"{_source(factor)} σ is {_before_adjustment(factor, survey)}. Check coordinates, marks and the "
            f"SfM model, or state the σ with {_SIGMA_OPTIONS['control points']}. Every σ of the result is enlarged."
        )
        remedy = (
            f"Check coordinates, marks and the SfM model, or state the σ with {_SIGMA_OPTIONS['control points']}."
        )
        ends = _is_wrong(factor) and scatter_m > _WRONG_SCATTER_M
        yield _Finding(_SIGMA_REJECTED, sentence, ends=ends, remedy=remedy)
    elif not used.all():
        missed_m = np.linalg.norm(residual, axis=1)
        rejected = [f"{names[row]} ({missed_m[row]:.2f} m)" for row in np.flatnonzero(~used)]
        sentence = (
            f"{len(rejected)} of {factor.count} control points are outliers, and are not used: {listed(rejected)}."
        )
        yield _Finding("control-outliers", sentence)


def _constant_shift(residual: FloatArray) -> FloatArray | None:
    """Return the shift (3,) that residuals (M, 3) share, if they have little else in common; or None."""
    shift = np.median(residual, axis=0)
    spread = float(np.linalg.norm(residual - shift, axis=1).mean())
    return shift if len(residual) > 1 and np.linalg.norm(shift) > _SHIFT_SPREADS * spread else None


def _apart(shift_m: FloatArray, survey: Survey, *, ends: bool) -> _Finding:
    sentence = (
        f"Control points and fixes are apart by a constant shift of {vector_text(shift_m)} m east, north, up. "
        f"Check {_cause_of_shift(shift_m, survey)}."
    )
    return _Finding("control-shifted", sentence, ends)


def _attitudes(survey: Survey, fixes: StatedFixes, geo_from_local: Similarity) -> Iterator[_Finding]:
    """Yield the finding that the attitudes disagree with the solution.

    A compass is often off by degrees, whatever its σ. A small turn is therefore reported only if a clock offset
    explains it: then the whole flight may lie in a wrong place.
    """
    prior = attitude_prior(survey, fixes.model)
    if prior is None:
        return
    sigma, angle = float(np.sqrt(prior.cov_rad2[0, 0])), turn_against(prior, geo_from_local)
    if angle <= _CLOCK_SIGMAS * sigma:
        return
    clock = clock_that_turns(fixes, prior)
    if clock is not None and clock[1] < _EXPLAINED_SIGMAS * sigma:
        cause = (
            f"A clock offset of {clock[0]:+.2f} s between positions and photographs would explain the turn, and "
            "would put the whole flight in a wrong place; an error of the compass would explain it too. Check the "
            "times, or add control points."
        )
    elif angle > max(_ATTITUDE_SIGMAS * sigma, _ATTITUDE_RAD):
        cause = "Check compass, mount, and times and axes of the positions."
    else:
        return
    sentence = (
        f"The recorded attitudes are turned by {np.degrees(angle):.1f}° against this solution, with a σ of "
        f"{np.degrees(sigma):.1f}°. {cause}"
    )
    yield _Finding("attitudes-inconsistent", sentence)


def _weak_checks(survey: Survey, problem: Problem, factors: Factors) -> Iterator[_Finding]:
    tested = [factor for factor in factors.values() if factor.group in ("fixes", "control points")]
    redundancy = sum(factor.redundancy for factor in tested)
    if redundancy < 6.0:
        sentence = (
            f"Only {redundancy:.0f} degrees of freedom check the σ of the positions, so that a wrong position can "
            "go unnoticed. Add fixes or control points."
        )
        yield _Finding("hardly-checked", sentence)
    if problem.term(Fixes.kind) is not None and factors.get("control points") is None:
        fixes = [image.fix for image in survey.images if image.fix is not None]
        sigma = typical_sigma(np.array([fix.cov_apart for fix in fixes]))
        drift_m = max((max(session.drift_m) for session in survey.sessions), default=0.0)
        beside = f" but for a drift of σ {drift_m:.2g} m" if drift_m else ""
        sentence = (
            "No control point checks an error that all fixes share, such as that of the base station. The "
            f"predicted σ take the errors of the fixes, σ {sigma:.2g} m, as independent{beside}."
        )
        yield _Finding("no-control-points", sentence, remedy="Add control points with --gcp.")


def _assumed_sigmas(survey: Survey, factors: Factors) -> Iterator[_Finding]:
    """Yield the finding that σ are assumed; a group whose σ another finding rejects is left out."""
    sentences, remedies = [], []
    for group, options in _SIGMA_OPTIONS.items():
        factor = factors.get(group)
        if factor is None or factor.sigma_source != "default":
            continue
        assumed = _before_adjustment(factor, survey)
        if factor.estimated is None:
            sentences.append(f"Nothing checks the assumed σ of the {group}, {assumed}.")
        elif group == "marks" or factor.applied <= _QUIET_FACTOR:
            variance = factor.estimated if factor.applied == 1.0 else factor.applied
            ratio = f"{variance**0.5:.2g}"
            sentences.append(f"The {group} scatter {ratio} times their assumed σ of {assumed}.")
        else:
            continue
        remedies.append(f"State that of the {group} with {options}.")
    if sentences:
        sentence = " ".join((*sentences, "Every σ of the result depends on these."))
        yield _Finding("default-sigma", sentence, remedy=" ".join(remedies))


def _before_adjustment(factor: VarianceFactor, survey: Survey) -> str:
    """Return the σ of a group as stated or assumed, with its unit; `survey` has the variance factor in it."""
    if factor.group == "marks":
        sigma, unit = np.median([mark.sigma_px for point in survey.control_points for mark in point.marks]), "px"
    else:
        fixes = [image.fix for image in survey.images if image.fix is not None]
        of_control = [point.cov_in_geo for point in survey.control_points]
        covariances = of_control if factor.group == "control points" else [fix.cov_apart for fix in fixes]
        sigma, unit = typical_sigma(np.array(covariances)), "m"
    return f"{float(sigma) / factor.applied**0.5:.3g} {unit}"


def _source(factor: VarianceFactor) -> str:
    return "assumed" if factor.sigma_source == "default" else "stated"


def _explained(best: Hypothesis) -> str:
    return f"{best.sentence} With this correction the fixes fit to {best.scatter_m:.2f} m."


def mistake_in_marks(survey: Survey, model: SparseModel) -> str | None:
    """Return the mistake without which the marks of most control points would meet.

    None: more than half of the points meet as they are, or no known mistake explains the others.
    """
    points = survey.control_points
    height_px = {name: model.camera_of(index).height for index, name in enumerate(model.image_name)}

    def meeting(change: FloatArray) -> int:
        """Return how many points meet after a change (2, 3) of x, y, height; a missing image has no height."""
        changed = []
        for point in points:
            marks = []
            for mark in point.marks:
                x_px, y_px = (change @ [mark.x_px, mark.y_px, height_px.get(mark.image, 0)]).tolist()
                marks.append(mark.model_copy(update={"x_px": x_px, "y_px": y_px}))
            changed.append(point.model_copy(update={"marks": tuple(marks)}))
        return len(control_correspondences(survey.model_copy(update={"control_points": tuple(changed)}), model)[0])

    changes = {
        "Their y counts from the lower edge of the photograph: count it from the upper edge": _FROM_BELOW,
        "Their x and y are exchanged": _EXCHANGED,
    }
    for size, scale in _SCALES.items():
        sentence = f"They were measured in photographs of {size} the size: measure in these, or scale the marks"
        changes[sentence] = scale * _AS_STATED
    stated = meeting(_AS_STATED)
    most, sentence = max(((meeting(change), name) for name, change in changes.items()), key=lambda one: one[0])
    explains = most >= max(2, 2 * stated) and most > len(points) / 2
    return f"{sentence}. Then the rays of {most} of {len(points)} points meet." if explains else None


def _mistake_in_map(survey: Survey, model: SparseModel) -> str | None:
    """Return the mistake of a map of control points that has another size or other axes than the fixes, or None.

    At least five fixes and five control points are needed: the scatter of fewer shows too little.
    """
    fixes, control = fix_correspondences(survey, model), control_correspondences(survey, model)[0]
    if min(len(fixes), len(control)) < _LEAST_POINTS:
        return None
    try:
        (by_fixes, fix_m), (by_control, control_m) = (fit(one.in_local, one.in_geo) for one in (fixes, control))
        mirrored_m = fit(control.in_local, mirrored(control.in_geo))[1]
    except DegenerateGeometryError:
        return None
    if control_m > _MIRRORED_M and mirrored_m < control_m / 10.0:
        return "the map of the control points is mirrored. Check the order of the columns and the CRS."
    ratio = by_control.scale / by_fixes.scale
    sigma = float(np.hypot(_sigma_of_scale(fixes, fix_m), _sigma_of_scale(control, control_m)))
    mercator = 1.0 / np.cos(np.radians(survey.origin_on_earth.lat_deg))
    causes = {
        mercator: "Web Mercator (EPSG:3857) has this scale at this latitude",
        FOOT_M: "The coordinates are in metres, although their CRS has feet",
        1.0 / FOOT_M: "The coordinates are in feet, although their CRS has metres",
    }
    near = min(causes, key=lambda scale: abs(np.log(ratio / scale)))
    is_known = abs(np.log(ratio / near)) < _CAUSE_SIGMAS * sigma + _LEAST_SCALE
    # Poor coordinates have any scale: one without a known cause has to be twice as evident.
    if abs(np.log(ratio)) < (_SCALE_SIGMAS if is_known else 2.0 * _SCALE_SIGMAS) * sigma + _LEAST_SCALE:
        return None
    cause = causes[near] if is_known else "Check unit and map projection"
    return f"the map of the control points is {ratio:.4g} times as large as that of the fixes. {cause}."


def _sigma_of_scale(positions: Correspondences, scatter_m: float) -> float:
    """Return the σ of ln(scale): of the scatter, or of errors as large as stated that drift over the flight."""
    size_m = float(np.sqrt(((positions.in_geo - positions.in_geo.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return float(max(scatter_m / len(positions) ** 0.5, typical_sigma(positions.cov_in_geo)) / size_m)


def _cause_of_shift(shift_m: FloatArray, survey: Survey) -> str:
    """Return what to check where fixes and control points are apart by a constant shift (3,), east, north, up.

    The sign of the shift does not matter. The survey has control points.
    """
    height_m = survey.origin_on_earth.alt_m + np.median(
        [point.position_in_geo[2] for point in survey.control_points]
    )
    horizontal, vertical = float(np.hypot(shift_m[0], shift_m[1])), abs(float(shift_m[2]))
    for sign in (-1.0, 1.0):
        other_m = height_m + sign * float(shift_m[2])
        for high, low, side in ((height_m, other_m, "control points"), (other_m, height_m, "fixes")):
            if vertical > _LEAST_FEET_M and abs(high * FOOT_M - low) < _FEET_PART * abs(low):
                return f"the unit of the heights of the {side}: they fit as feet"
    if horizontal < 0.2 * vertical and 5.0 < vertical < MOST_GEOID_M:
        return f"the vertical datum: the heights are {vertical:.1f} m apart, as of ellipsoid and geoid or take-off"
    if horizontal < 0.2 * vertical and vertical >= MOST_GEOID_M:
        return "the zero of the heights, which may be the take-off, and their unit"
    if horizontal > 100_000.0:
        return "the zone and the order of the axes"
    if horizontal > 20.0:
        return "the datum and its realisation"
    if horizontal > _EVERYDAY_SHIFT_M:
        return (
            "the position of the base station, the datum, and the unit: US survey feet taken for international "
            "feet shift by 10 m in 5 000 km"
        )
    return "the position of the base station, the datum and the antenna offset"
