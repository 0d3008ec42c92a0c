"""Inconsistencies between sources: fixes against the SfM model, control points against the fixes.

Single outliers are rejected in the adjustment. Where more than a third of a group would have to be rejected, or σ
would have to be ten times the stated one, one side is wrong as a whole. The known mistakes are tried, and the one
that fits is named. One inconsistency is everyday work: a constant shift of all fixes by up to five metres, of an
autonomous base station, or by what σ of one fix allow. There the control points decide.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.adjust.control_mistakes import EVERYDAY_SHIFT_M, mistake_in_map, shift_sentence
from pipelines.adjust.hypotheses import (
    StatedFixes,
    clock_that_turns,
    explanation_of,
    fit,
    hangs_upside_down,
)
from pipelines.adjust.joint import JointAdjustment
from pipelines.adjust.observations import UnusedControlPoint, attitude_prior
from pipelines.adjust.terms import ControlPoints, Fixes
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Caution
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.robust.patterns import median_spacing
from pipelines.robust.statistics import outlier_gate, typical_sigma
from pipelines.survey.report_parts import Group, VarianceFactor
from pipelines.survey.survey import Survey

_SIGMA_REFUTED = "sigma-refuted"
# A stated σ that is too small by this factor is an inconsistency, if the scatter is so many metres or is explained.
_WRONG_SIGMA, _WRONG_SCATTER_M = 10.0, 0.3
# A variance factor up to this, of σ that are half as large again, is applied without blame.
_QUIET_FACTOR = 2.25
_LEAST_FIXES = 4
_AT_SKY = 0.3  # median up component of the views
# Residuals share a shift that is so many times as large as what is left without it.
_SHIFT_SPREADS = 5.0
_ATTITUDE_SIGMAS, _ATTITUDE_RAD = 4.0, np.radians(8.0)
# A turn is explained by a clock if so little is left of it.
_CLOCK_SIGMAS, _EXPLAINED_SIGMAS = 3.0, 1.0
_NAMED = 5  # control points in a caution


@dataclass(frozen=True)
class Findings:
    """Findings on a solution.

    Attributes:
        contradictions: inconsistencies that end the stage, unless the user accepts them.
        cautions: further limits of the result.
    """

    contradictions: tuple[Caution, ...]
    cautions: tuple[Caution, ...]


@dataclass(frozen=True)
class _Finding:
    """Caution, and whether it is an inconsistency that ends the stage."""

    code: str
    sentence: str
    ends: bool = False


def judge(survey: Survey, model: SparseModel, joint: JointAdjustment) -> Findings:
    """Return the inconsistencies and cautions of the joint adjustment of a survey and its SfM model."""
    fixes = StatedFixes(survey, model)
    findings, of_map = list(_upside_down(fixes, joint.geo_from_local)), list(_map_of_control(survey, model))
    if not findings:
        findings += [] if of_map else _fixes_against_model(fixes, joint)
        findings += _view(model, joint.geo_from_local)
    findings += of_map or [*_shift_of_fixes(joint), *_control_points(joint)]
    findings += [*_attitudes(survey, fixes, joint), *_weak_checks(joint), *_guesses(joint)]
    ending, others = ([found for found in findings if found.ends == ends] for ends in (True, False))
    return Findings(_cautions(ending), _cautions(others))


def _cautions(findings: Iterable[_Finding]) -> tuple[Caution, ...]:
    return tuple(Caution(code=found.code, sentence=found.sentence) for found in findings)


def unadjustable(survey: Survey, model: SparseModel, geo_from_local: Similarity | None) -> tuple[Caution, ...]:
    """Return the inconsistencies of measurements that determine no adjustment, and perhaps no alignment (None)."""
    fixes = StatedFixes(survey, model)
    if geo_from_local is not None and hangs_upside_down(model, geo_from_local):
        return _cautions(_upside_down(fixes, geo_from_local))
    if len(fixes.name) < _LEAST_FIXES:
        return ()
    try:
        scatter, best = fit(fixes.center_in_local, fixes.position_in_geo)[1], explanation_of(fixes)
    except DegenerateGeometryError:
        return ()
    if scatter < max(_WRONG_SIGMA * fixes.sigma_m, _WRONG_SCATTER_M):
        return ()
    cause = "are they those of these photographs?" if best is None else best.sentence
    sentence = f"the fixes scatter by {scatter:.2f} m an axis about the SfM model, and fix no similarity: {cause}"
    return (Caution(code=_SIGMA_REFUTED if best is None else best.code, sentence=sentence),)


def marks_that_do_not_meet(unused: Sequence[UnusedControlPoint], mistake: str | None) -> tuple[Caution, ...]:
    """Return the caution that marks of control points do not meet in one point; none if they do.

    `mistake` is that without which most of them would meet; then no control point is used.
    """
    missed = [point for point in unused if len(point.residual_px) >= 2]
    if not missed:
        return ()
    worst = sorted(missed, key=lambda point: -max(point.residual_px))[:_NAMED]
    named = listed([f"{point.name} ({max(point.residual_px):.0f} px)" for point in worst])
    more = "" if len(missed) <= _NAMED else f" and {len(missed) - _NAMED} more"
    sentence = f"the marks of {len(missed)} control points do not meet in one point: {named}{more}; "
    sentence += "these are not used" if mistake is None else f"no control point is used. Probably {mistake}"
    return (Caution(code="control-marks", sentence=sentence),)


def _factor(joint: JointAdjustment, group: Group) -> VarianceFactor | None:
    return next((factor for factor in joint.factors if factor.group == group), None)


def _is_wrong(factor: VarianceFactor) -> bool:
    """Return whether a stated σ is too small by so much that it is no optimism."""
    return factor.sigma_source == "stated" and factor.applied > _WRONG_SIGMA**2


def _upside_down(fixes: StatedFixes, geo_from_local: Similarity) -> Iterator[_Finding]:
    if not hangs_upside_down(fixes.model, geo_from_local):
        return
    sentence = "the cameras hang upside down in this solution: the positions contradict the SfM model"
    best = explanation_of(fixes)
    if best is not None:
        sentence += f"; with this they fit upright to {best.scatter_m:.2f} m: {best.sentence}"
    yield _Finding("upside-down", sentence, ends=True)


def _view(model: SparseModel, geo_from_local: Similarity) -> Iterator[_Finding]:
    up_of_views = model.rotation_cam_from_local[:, 2] @ geo_from_local.rotation[2]
    if np.median(up_of_views) > _AT_SKY:
        sentence = "most cameras look up at the sky: if that is not so, the positions are wrong"
        yield _Finding("looks-at-sky", sentence)


def _fixes_against_model(fixes: StatedFixes, joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield the finding that the fixes do not fit the SfM model, with the mistake that explains it."""
    factor = _factor(joint, "fixes")
    if factor is None or factor.applied <= _QUIET_FACTOR:
        return
    is_wrong = _is_wrong(factor)
    shift = _constant_shift(joint.residuals(Fixes.kind)[1])
    if shift is not None and joint.problem.term(ControlPoints.kind) is not None:
        yield _apart(-shift, joint.survey, ends=is_wrong)
        return
    scatter_m, rejected = fixes.sigma_m * factor.applied**0.5, factor.count - factor.used
    sides = f"the fixes scatter by {scatter_m:.2f} m an axis about the SfM model, their σ is {fixes.sigma_m:.3g} m"
    if rejected:
        sides += f", and {rejected} of {factor.count} are outliers"
    best = explanation_of(fixes)
    if best is not None:
        sentence = f"{sides}; with this they fit to {best.scatter_m:.2f} m: {best.sentence}"
        yield _Finding(best.code, sentence, ends=is_wrong)
        return
    if scatter_m > median_spacing(fixes.position_in_geo) / 2:
        remedy = "they are farther off than photographs are apart: are they those of these photographs?"
    else:
        remedy = (
            "no offset, time, axis or group of them explains that: it is noise, and σ is optimistic, or the SfM "
            "model is bent; every σ of the result is widened"
        )
    yield _Finding(_SIGMA_REFUTED, f"{sides}: {remedy}", ends=is_wrong and scatter_m > _WRONG_SCATTER_M)


def _map_of_control(survey: Survey, model: SparseModel) -> Iterator[_Finding]:
    """Yield the finding that the control points' map has another size or other axes than the fixes."""
    mistake = mistake_in_map(survey, model)
    if mistake is not None:
        yield _Finding("control-map", f"control points and fixes contradict each other: {mistake}", ends=True)


def _shift_of_fixes(joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield the finding that the fixes of a session are shifted against the control points, beyond their σ."""
    fixes = joint.problem.term(Fixes.kind)
    if fixes is None:
        return
    for bias in joint.biases:
        information = (np.swapaxes(fixes.root_information, 1, 2) @ fixes.root_information).mean(axis=0)
        # An estimate under a prior scatters by what the measurements have taken off the prior's variance.
        shift_m, learned = np.array(bias.value), np.square(bias.prior) - np.square(bias.sigma)
        if (shift_m**2 / np.maximum(learned, 1e-9)).sum() <= outlier_gate(3):
            continue
        values = ", ".join(
            f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(bias.value, bias.sigma, strict=True)
        )
        stated = ", ".join(f"{sigma:.3g}" for sigma in bias.prior)
        sentence = (
            f"all fixes are shifted by ({values}) m east, north, up against the control points, which decide the "
            f"position; the σ of their common error is ({stated}) m. Either side may be wrong: "
            f"{shift_sentence(shift_m, joint.survey)}"
        )
        within_one_fix = bool(shift_m @ information @ shift_m <= outlier_gate(3))
        is_everyday = bool(np.linalg.norm(shift_m) <= EVERYDAY_SHIFT_M)
        yield _Finding("fixes-shifted", sentence, ends=not (within_one_fix or is_everyday))


def _control_points(joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield the finding that the control points contradict the fixes, or each other."""
    names, residual, used = joint.residuals(ControlPoints.kind)
    factor = _factor(joint, "control points")
    if factor is None:
        return
    shift = _constant_shift(residual)
    if (
        shift is not None
        and joint.problem.term(Fixes.kind) is not None
        and (factor.applied > 1.0 or not used.all())
    ):
        yield _apart(shift, joint.survey, ends=True)
    elif factor.applied > _QUIET_FACTOR:
        scatter_m = float(np.sqrt((residual**2).mean()))
        weighted_m = typical_sigma(np.array([point.cov_in_geo for point in joint.survey.control_points]))
        who = "which nobody stated" if factor.sigma_source == "default" else "as stated"
        sentence = (
            f"the control points miss by {scatter_m:.2f} m RMS an axis, their σ is "
            f"{weighted_m / factor.applied**0.5:.3g} m, {who}: coordinates, marks or the SfM model are wrong; "
            "every σ of the result is widened"
        )
        yield _Finding(_SIGMA_REFUTED, sentence, ends=_is_wrong(factor) and scatter_m > _WRONG_SCATTER_M)
    elif not used.all():
        missed_m = np.linalg.norm(residual, axis=1)
        rejected = [f"{names[row]} ({missed_m[row]:.2f} m)" for row in np.flatnonzero(~used)]
        sentence = f"{len(rejected)} of {factor.count} control points are outliers: {listed(rejected)}"
        yield _Finding("control-outliers", sentence)


def _constant_shift(residual: FloatArray) -> FloatArray | None:
    """Return the shift (3,) that residuals (M, 3) share, if they have little else in common; or None."""
    shift = np.median(residual, axis=0)
    spread = float(np.linalg.norm(residual - shift, axis=1).mean())
    return shift if len(residual) > 1 and np.linalg.norm(shift) > _SHIFT_SPREADS * spread else None


def _apart(shift_m: FloatArray, survey: Survey, *, ends: bool) -> _Finding:
    values = ", ".join(f"{value:+.2f}" for value in shift_m)
    sentence = (
        f"control points and fixes are apart by one constant shift of ({values}) m east, north, up: "
        f"{shift_sentence(shift_m, survey)}"
    )
    return _Finding("control-shifted", sentence, ends)


def _attitudes(survey: Survey, fixes: StatedFixes, joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield the finding that the attitudes contradict the solution.

    A compass is often off by degrees, whatever its σ. A small turn is therefore heard only if a clock offset
    explains it: then the whole flight may lie in a wrong place.
    """
    prior = attitude_prior(survey, fixes.model)
    if prior is None:
        return
    attitude = prior.rotation

    def turn_of(similarity: Similarity) -> float:
        return float(np.linalg.norm(log_so3(attitude @ similarity.rotation.T)))

    sigma, angle = float(np.sqrt(prior.cov_rad2[0, 0])), turn_of(joint.geo_from_local)
    if angle <= _CLOCK_SIGMAS * sigma:
        return
    clock = clock_that_turns(fixes, turn_of)
    if clock is not None and clock[1] < _EXPLAINED_SIGMAS * sigma:
        cause = (
            f"a clock offset of {clock[0]:+.2f} s between positions and photographs would explain it, and the "
            "whole flight lies in a wrong place then; or the compass is off. Check the times, or add control points"
        )
    elif angle > max(_ATTITUDE_SIGMAS * sigma, _ATTITUDE_RAD):
        cause = "compass, mount, or the positions (their times, their axes) are wrong"
    else:
        return
    sentence = (
        f"the recorded attitudes are turned by {np.degrees(angle):.1f}° against this solution "
        f"(σ {np.degrees(sigma):.1f}°): {cause}"
    )
    yield _Finding("attitudes-contradict", sentence)


def _weak_checks(joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield findings of σ that little or nothing checks."""
    tested = [factor for factor in joint.factors if factor.group in ("fixes", "control points")]
    redundancy = sum(factor.redundancy for factor in tested)
    if redundancy < 6.0:
        sentence = (
            f"only {redundancy:.0f} degrees of freedom check the σ of the positions: a wrong position can go "
            "unnoticed; add fixes or control points"
        )
        yield _Finding("hardly-checked", sentence)
    if joint.problem.term(Fixes.kind) is not None and _factor(joint, "control points") is None:
        fixes = [image.fix for image in joint.survey.images if image.fix is not None]
        sigma = typical_sigma(np.array([fix.cov_in_geo for fix in fixes]))
        sentence = (
            "no control point checks an error that all fixes share, of the base station or of a receiver without "
            f"corrections: σ count the fixes, of {sigma:.2g} m, as independent"
        )
        yield _Finding("no-control-points", sentence)


def _guesses(joint: JointAdjustment) -> Iterator[_Finding]:
    """Yield a finding of the σ that nobody stated, with the variance factors that stand in for them."""
    guessed = [
        f"{factor.group} ({'not checked' if factor.estimated is None else f'factor {factor.estimated:.2g}'})"
        for factor in joint.factors
        if factor.sigma_source == "default" and factor.group in ("fixes", "control points", "marks")
    ]
    if guessed:
        sentence = (
            f"nobody stated the σ of {', '.join(guessed)}: defaults stand in, and every σ of the result hangs on "
            "them"
        )
        yield _Finding("default-sigma", sentence)
