"""Contradictions between sources: fixes against the SfM model, control points against the fixes.

Single outliers are rejected in the adjustment. Where more than a third of a group would have to be rejected, or σ
would have to be ten times the stated one, one side is wrong as a whole. The known mistakes are tried, and the one
that fits is named. One contradiction is everyday work: a constant shift of all fixes by up to five metres, of an
autonomous base station, or by what σ of one fix allow. There the control points decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.adjust.control_mistakes import EVERYDAY_SHIFT_M, mistake_in_map, shift_sentence
from pipelines.adjust.hypotheses import (
    Hypothesis,
    clock_that_turns,
    explanation_of_fixes,
    fit,
)
from pipelines.adjust.joint import JointAdjustment
from pipelines.adjust.observations import (
    UnusedControlPoint,
    attitude_prior,
    control_correspondences,
    fix_correspondences,
)
from pipelines.adjust.plausibility import hangs_upside_down, looks_at_sky
from pipelines.adjust.terms import ControlTerm, FixTerm
from pipelines.core.cautions import Caution
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.robust.patterns import median_spacing
from pipelines.robust.statistics import outlier_gate, typical_sigma
from pipelines.scene.survey import Survey
from pipelines.scene.variance_factors import Group, VarianceFactor

_SIGMA_REFUTED = "sigma-refuted"
# A stated σ that is too small by this factor is a contradiction, if the scatter is so many metres or is explained.
_WRONG_SIGMA, _WRONG_SCATTER_M = 10.0, 0.3
# A variance factor up to this, of σ that are half as large again, is applied without blame.
_QUIET_FACTOR = 2.25
_LEAST_FIXES = 4
# Residuals share a shift that is so many times as large as what is left without it.
_SHIFT_SPREADS = 5.0
_ATTITUDE_SIGMAS, _ATTITUDE_RAD = 4.0, np.radians(8.0)
# A turn is explained by a clock if so little is left of it.
_CLOCK_SIGMAS, _EXPLAINED_SIGMAS = 3.0, 1.0
_NAMED = 5  # control points in a caution


@dataclass(frozen=True)
class Verdict:
    """Findings on a solution.

    Attributes:
        contradictions: cautions that end the stage, unless the user accepts them.
        cautions: further limits of the result.
    """

    contradictions: tuple[Caution, ...]
    cautions: tuple[Caution, ...]

    @property
    def all(self) -> tuple[Caution, ...]:
        """Contradictions, then cautions."""
        return self.contradictions + self.cautions


@dataclass(frozen=True)
class _Finding:
    """Caution, and whether it is a contradiction that ends the stage."""

    caution: Caution
    ends: bool = False


def judge(survey: Survey, model: SparseModel, joint: JointAdjustment) -> Verdict:
    """Return the contradictions and cautions of a joint adjustment.

    Args:
        survey: as stated.
        model: SfM model.
        joint: its adjustment.
    """
    fixes = _Fixes(survey, model)
    findings = _upside_down(fixes, joint.geo_from_local)
    of_map = _map_of_control(fixes)
    if not findings:
        against_model = [] if of_map else _fixes_against_model(fixes, joint)
        findings = [*against_model, *_view(model, joint.geo_from_local)]
    findings += of_map or [*_shift_of_fixes(joint), *_control_points(joint)]
    findings += [*_attitudes(fixes, joint), *_weak_checks(joint), *_guesses(joint)]
    return Verdict(
        tuple(finding.caution for finding in findings if finding.ends),
        tuple(finding.caution for finding in findings if not finding.ends),
    )


def unadjustable(survey: Survey, model: SparseModel, geo_from_local: Similarity | None) -> tuple[Caution, ...]:
    """Return the contradictions of measurements that determine no adjustment.

    Args:
        survey: as stated.
        model: SfM model.
        geo_from_local: alignment of the two; None: not even that.
    """
    fixes = _Fixes(survey, model)
    if geo_from_local is not None and (upside_down := _upside_down(fixes, geo_from_local)):
        return tuple(finding.caution for finding in upside_down)
    if len(fixes.positions) < _LEAST_FIXES:
        return ()
    try:
        scatter, best = fit(fixes.positions.in_local, fixes.positions.in_geo)[1], fixes.explanation()
    except DegenerateGeometryError:
        return ()
    if scatter < fixes.tolerance_m:
        return ()
    cause = "are they those of these photographs?" if best is None else best.sentence
    sentence = f"the fixes scatter by {scatter:.2f} m an axis about the SfM model, and fix no similarity: {cause}"
    return (Caution(code=_SIGMA_REFUTED if best is None else best.code, sentence=sentence),)


def marks_that_do_not_meet(unused: Sequence[UnusedControlPoint], mistake: str | None) -> tuple[Caution, ...]:
    """Return the caution that marks of control points do not meet in one point; none if they do.

    Args:
        unused: control points that their marks do not determine.
        mistake: without which most of them would meet; then no control point is used.
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


class _Fixes:
    """Fixes of a survey as stated, against its SfM model."""

    def __init__(self, survey: Survey, model: SparseModel) -> None:
        self.survey, self.model = survey, model
        self.positions = fix_correspondences(survey, model)

    @property
    def sigma_m(self) -> float:
        """Typical σ per axis."""
        return typical_sigma(self.positions.cov_in_geo)

    @property
    def tolerance_m(self) -> float:
        """Scatter about the SfM model beyond which the fixes contradict it."""
        return max(_WRONG_SIGMA * self.sigma_m, _WRONG_SCATTER_M)

    @property
    def times_s(self) -> FloatArray:
        """Times (n,) of the photographs of the fixes, NaN where unknown."""
        times = {image.name: image.timestamp_s for image in self.survey.images}
        return np.array([times[name] for name in self.positions.name], dtype=np.float64)

    @property
    def spacing_m(self) -> float:
        """Median distance of a fix from the nearest other one."""
        return median_spacing(self.positions.in_geo)

    def explanation(self) -> Hypothesis | None:
        """Return the known mistake that explains why the fixes do not fit the SfM model, if one does."""
        return explanation_of_fixes(
            self.positions.name,
            self.positions.in_local,
            self.positions.in_geo,
            self.times_s,
            origin=self.survey.origin,
            sigma_m=self.sigma_m,
            plausible=lambda similarity: not hangs_upside_down(self.model, similarity),
        )


def _factor(joint: JointAdjustment, group: Group) -> VarianceFactor | None:
    return next((factor for factor in joint.factors if factor.group == group), None)


def _is_wrong(factor: VarianceFactor) -> bool:
    """Return whether a stated σ is too small by so much that it is no optimism."""
    return factor.sigma_source == "stated" and factor.applied > _WRONG_SIGMA**2


def _upside_down(fixes: _Fixes, geo_from_local: Similarity) -> list[_Finding]:
    if not hangs_upside_down(fixes.model, geo_from_local):
        return []
    sentence = "the cameras hang upside down in this solution: the positions contradict the SfM model"
    best = fixes.explanation()
    if best is not None:
        sentence += f"; with this they fit upright to {best.scatter_m:.2f} m: {best.sentence}"
    return [_Finding(Caution(code="upside-down", sentence=sentence), ends=True)]


def _view(model: SparseModel, geo_from_local: Similarity) -> list[_Finding]:
    if not looks_at_sky(model, geo_from_local):
        return []
    sentence = "most cameras look up at the sky: if that is not so, the positions are wrong"
    return [_Finding(Caution(code="looks-at-sky", sentence=sentence))]


def _fixes_against_model(fixes: _Fixes, joint: JointAdjustment) -> list[_Finding]:
    """Return the finding that the fixes do not fit the SfM model, with the mistake that explains it."""
    factor = _factor(joint, "fixes")
    if factor is None or factor.applied <= _QUIET_FACTOR:
        return []
    is_wrong = _is_wrong(factor)
    shift = _constant_shift(joint.residuals(FixTerm)[1])
    if shift is not None and joint.problem.control is not None:
        return [_Finding(_apart(-shift, _height_of_control(joint)), ends=is_wrong)]
    scatter_m, rejected = fixes.sigma_m * factor.applied**0.5, factor.count - factor.used
    sides = f"the fixes scatter by {scatter_m:.2f} m an axis about the SfM model, their σ is {fixes.sigma_m:.3g} m"
    if rejected:
        sides += f", and {rejected} of {factor.count} are outliers"
    best = fixes.explanation()
    if best is not None:
        sentence = f"{sides}; with this they fit to {best.scatter_m:.2f} m: {best.sentence}"
        return [_Finding(Caution(code=best.code, sentence=sentence), ends=is_wrong)]
    if scatter_m > fixes.spacing_m / 2:
        remedy = "they are farther off than photographs are apart: are they those of these photographs?"
    else:
        remedy = (
            "no offset, time, axis or group of them explains that: it is noise, and σ is optimistic, or the SfM "
            "model is bent; every σ of the result is widened"
        )
    caution = Caution(code=_SIGMA_REFUTED, sentence=f"{sides}: {remedy}")
    return [_Finding(caution, ends=is_wrong and scatter_m > _WRONG_SCATTER_M)]


def _map_of_control(fixes: _Fixes) -> list[_Finding]:
    """Return the finding that the control points' map has another size or other axes than the fixes."""
    control = control_correspondences(fixes.survey, fixes.model)[0]
    mistake = mistake_in_map(fixes.positions, control, fixes.survey.origin.lat_deg)
    if mistake is None:
        return []
    caution = Caution(code="control-map", sentence=f"control points and fixes contradict each other: {mistake}")
    return [_Finding(caution, ends=True)]


def _shift_of_fixes(joint: JointAdjustment) -> list[_Finding]:
    """Return the finding that all fixes are shifted against the control points, beyond the σ of one fix or 5 m."""
    bias = joint.bias
    if bias is None:
        return []
    within, everyday = _within_sigma(joint, np.array(bias.value)), np.linalg.norm(bias.value) <= EVERYDAY_SHIFT_M
    if within and everyday:
        return []
    values = ", ".join(f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(bias.value, bias.sigma, strict=True))
    sentence = (
        f"all fixes are shifted by ({values}) m east, north, up against the control points, which decide the "
        f"position. Either side may be wrong: {shift_sentence(np.array(bias.value), _height_of_control(joint))}"
    )
    caution = Caution(code="fixes-shifted", sentence=sentence)
    return [_Finding(caution, ends=not (within or everyday))]


def _control_points(joint: JointAdjustment) -> list[_Finding]:
    """Return the finding that the control points contradict the fixes, or each other."""
    names, residual, used = joint.residuals(ControlTerm)
    factor = _factor(joint, "control points")
    if factor is None or (factor.applied <= 1.0 and factor.used == factor.count):
        return []
    shift = _constant_shift(residual)
    if shift is not None and joint.problem.fixes is not None:
        return [_Finding(_apart(shift, _height_of_control(joint)), ends=True)]
    if factor.applied > _QUIET_FACTOR:
        scatter_m = float(np.sqrt((residual**2).mean()))
        weighted_m = typical_sigma(np.array([point.cov_in_geo for point in joint.survey.control_points]))
        who = "which nobody stated" if factor.sigma_source == "default" else "as stated"
        sentence = (
            f"the control points miss by {scatter_m:.2f} m RMS an axis, their σ is "
            f"{weighted_m / factor.applied**0.5:.3g} m, {who}: coordinates, marks or the SfM model are wrong; "
            "every σ of the result is widened"
        )
        caution = Caution(code=_SIGMA_REFUTED, sentence=sentence)
        return [_Finding(caution, ends=_is_wrong(factor) and scatter_m > _WRONG_SCATTER_M)]
    rejected = [
        f"{name} ({np.linalg.norm(miss):.2f} m)"
        for name, miss, is_used in zip(names, residual, used, strict=True)
        if not is_used
    ]
    if not rejected:
        return []
    sentence = f"{len(rejected)} of {factor.count} control points are outliers: {listed(rejected)}"
    return [_Finding(Caution(code="control-outliers", sentence=sentence))]


def _constant_shift(residual: FloatArray) -> FloatArray | None:
    """Return the shift (3,) that residuals (M, 3) share, if they have little else in common; or None."""
    shift = np.median(residual, axis=0)
    spread = float(np.linalg.norm(residual - shift, axis=1).mean())
    return shift if len(residual) > 1 and np.linalg.norm(shift) > _SHIFT_SPREADS * spread else None


def _apart(shift_m: FloatArray, height_m: float) -> Caution:
    values = ", ".join(f"{value:+.2f}" for value in shift_m)
    sentence = (
        f"control points and fixes are apart by one constant shift of ({values}) m east, north, up: "
        f"{shift_sentence(shift_m, height_m)}"
    )
    return Caution(code="control-shifted", sentence=sentence)


def _height_of_control(joint: JointAdjustment) -> float:
    """Return the median ellipsoidal height of the control points as stated, NaN without any."""
    heights = [point.position_in_geo[2] for point in joint.survey.control_points]
    return float(np.median(heights)) + joint.survey.origin.alt_m if heights else float("nan")


def _within_sigma(joint: JointAdjustment, shift_m: FloatArray) -> bool:
    """Return whether a shift that all fixes share is no larger than the σ of one of them allows."""
    fixes = joint.problem.term(FixTerm)
    if fixes is None:
        return False
    information = (fixes.root_information.transpose(1, 2) @ fixes.root_information).mean(dim=0).cpu().numpy()
    return bool(shift_m @ information @ shift_m <= outlier_gate(3))


def _attitudes(fixes: _Fixes, joint: JointAdjustment) -> list[_Finding]:
    """Return the finding that the attitudes contradict the solution.

    A compass is often off by degrees, whatever its σ. A small turn is therefore heard only if a clock offset
    explains it: then the whole flight may lie in a wrong place.
    """
    prior = attitude_prior(fixes.survey, fixes.model)
    if prior is None:
        return []
    attitude = prior.rotation

    def turn_of(similarity: Similarity) -> float:
        return float(np.linalg.norm(log_so3(attitude @ similarity.rotation.T)))

    sigma, angle = float(np.sqrt(prior.cov_rad2[0, 0])), turn_of(joint.geo_from_local)
    if angle <= _CLOCK_SIGMAS * sigma:
        return []
    positions = fixes.positions
    clock = clock_that_turns(positions.in_local, positions.in_geo, fixes.times_s, turn_of)
    explains = clock is not None and clock[1] < _EXPLAINED_SIGMAS * sigma
    if angle <= max(_ATTITUDE_SIGMAS * sigma, _ATTITUDE_RAD) and not explains:
        return []
    sentence = (
        f"the recorded attitudes are turned by {np.degrees(angle):.1f}° against this solution "
        f"(σ {np.degrees(sigma):.1f}°): "
    )
    if explains and clock is not None:
        sentence += (
            f"a clock offset of {clock[0]:+.2f} s between positions and photographs would explain it, and the "
            "whole flight lies in a wrong place then; or the compass is off. Check the times, or add control points"
        )
    else:
        sentence += "compass, mount, or the positions (their times, their axes) are wrong"
    return [_Finding(Caution(code="attitudes-contradict", sentence=sentence))]


def _weak_checks(joint: JointAdjustment) -> list[_Finding]:
    """Return findings of σ that little or nothing checks."""
    tested = [factor for factor in joint.factors if factor.group in ("fixes", "control points")]
    redundancy, findings = sum(factor.redundancy for factor in tested), []
    if redundancy < 6.0:
        sentence = (
            f"only {redundancy:.0f} degrees of freedom check the σ of the positions: a wrong position can go "
            "unnoticed; add fixes or control points"
        )
        findings.append(_Finding(Caution(code="hardly-checked", sentence=sentence)))
    fixes = joint.problem.term(FixTerm)
    if fixes is not None and not any(factor.group == "control points" for factor in tested):
        sigma = typical_sigma(
            np.array([image.fix.cov_in_geo for image in joint.survey.images if image.fix is not None])
        )
        sentence = (
            "no control point checks an error that all fixes share, of the base station or of a receiver without "
            f"corrections: σ count the fixes, of {sigma:.2g} m, as independent"
        )
        findings.append(_Finding(Caution(code="no-control-points", sentence=sentence)))
    return findings


def _guesses(joint: JointAdjustment) -> list[_Finding]:
    """Return a finding of the σ that nobody stated, with the variance factors that stand in for them."""
    guessed = [
        f"{factor.group} ({'not checked' if factor.estimated is None else f'factor {factor.estimated:.2g}'})"
        for factor in joint.factors
        if factor.sigma_source == "default" and factor.group in ("fixes", "control points", "marks")
    ]
    if not guessed:
        return []
    sentence = (
        f"nobody stated the σ of {', '.join(guessed)}: defaults stand in, and every σ of the result hangs on them"
    )
    return [_Finding(Caution(code="default-sigma", sentence=sentence))]
