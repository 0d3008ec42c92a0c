"""Contradictions between sources: fixes against the SfM model, control points against the fixes.

Single outliers are rejected in the adjustment. Where more than a third of a group would have to be rejected, or σ
would have to be ten times the stated one, one side is wrong as a whole. The known mistakes are tried, and the one
that fits is named. One contradiction is everyday work: a constant shift of all fixes by up to five metres, of an
autonomous base station. There the control points decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.cautions import Caution
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.georef.terms import ControlTerm, FixTerm
from pipelines.init_sim3.hypotheses import (
    Hypothesis,
    explanations_of_fixes,
    fit,
    mirrored,
    shift_sentence,
)
from pipelines.init_sim3.joint import JointAdjustment
from pipelines.init_sim3.plausibility import hangs_upside_down, looks_at_sky
from pipelines.robust.statistics import outlier_gate
from pipelines.scene.observations import attitude_prior, fix_correspondences
from pipelines.scene.survey import Survey
from pipelines.scene.variance_factors import VarianceFactor

# A stated σ that is too small by this factor is a contradiction, if the scatter is so many metres or is explained.
_WRONG_SIGMA, _WRONG_SCATTER_M = 10.0, 0.3
_EVERYDAY_SHIFT_M = 5.0
# A variance factor up to this, of σ that are half as large again, is applied without blame.
_QUIET_FACTOR = 2.25
_LEAST_FIXES = 4
# Residuals share a shift that is so many times as large as what is left without it.
_SHIFT_SPREADS = 5.0
_ATTITUDE_SIGMAS, _ATTITUDE_RAD = 4.0, np.radians(8.0)


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


def judge(survey: Survey, model: SparseModel, joint: JointAdjustment) -> Verdict:
    """Return the contradictions and cautions of a joint adjustment.

    Args:
        survey: as stated.
        model: SfM model.
        joint: its adjustment.
    """
    contradictions: list[Caution] = []
    cautions: list[Caution] = []
    fixes = _factor(joint, "fixes")
    upside_down = _upside_down(survey, model, joint.geo_from_local)
    contradictions += upside_down
    if fixes is not None and not upside_down:
        of_fixes = _fixes_against_model(survey, model, fixes, joint)
        scatter_m = _sigma_m(fix_correspondences(survey, model).cov_in_geo) * fixes.applied**0.5
        explained = any(caution.code != "sigma-refuted" for caution in of_fixes)
        is_wrong = _is_wrong(fixes) and (explained or scatter_m > _WRONG_SCATTER_M)
        (contradictions if is_wrong else cautions).extend(of_fixes)
    control = _control_against_fixes(joint)
    contradictions += [caution for fatal, caution in control if fatal]
    cautions += [caution for fatal, caution in control if not fatal]
    if looks_at_sky(model, joint.geo_from_local) and not upside_down:
        sentence = "most cameras look up at the sky: if that is not so, the positions are wrong"
        cautions.append(Caution(code="looks-at-sky", sentence=sentence))
    cautions += _attitudes(survey, model, joint)
    cautions += [*_weak_checks(joint), *_guesses(joint)]
    return Verdict(tuple(contradictions), tuple(cautions))


def unadjustable(survey: Survey, model: SparseModel, geo_from_local: Similarity | None) -> tuple[Caution, ...]:
    """Return the contradictions of measurements that determine no adjustment.

    Args:
        survey: as stated.
        model: SfM model.
        geo_from_local: alignment of the two; None: not even that.
    """
    if geo_from_local is not None and (upside_down := _upside_down(survey, model, geo_from_local)):
        return tuple(upside_down)
    fixes = fix_correspondences(survey, model)
    if len(fixes) < _LEAST_FIXES:
        return ()
    try:
        scatter, best = fit(fixes.in_local, fixes.in_geo)[1], _explanation(survey, model)
    except DegenerateGeometryError:
        return ()
    if scatter < max(_WRONG_SIGMA * _sigma_m(fixes.cov_in_geo), _WRONG_SCATTER_M):
        return ()
    cause = "are they those of these photographs?" if best is None else best.sentence
    sentence = f"the fixes scatter by {scatter:.2f} m an axis about the SfM model, and fix no similarity: {cause}"
    return (Caution(code="sigma-refuted" if best is None else best.code, sentence=sentence),)


def _factor(joint: JointAdjustment, group: str) -> VarianceFactor | None:
    return next((factor for factor in joint.factors if factor.group == group), None)


def _is_wrong(factor: VarianceFactor) -> bool:
    """Return whether a stated σ is too small by so much that it is no optimism."""
    return factor.sigma_source == "stated" and factor.applied > _WRONG_SIGMA**2


def _upside_down(survey: Survey, model: SparseModel, geo_from_local: Similarity) -> list[Caution]:
    if not hangs_upside_down(model, geo_from_local):
        return []
    fixes = fix_correspondences(survey, model)
    sentence = "the cameras hang upside down in this solution: the positions contradict the SfM model"
    try:
        similarity, scatter = fit(fixes.in_local, mirrored(fixes.in_geo))
        fits = scatter < max(_WRONG_SIGMA * _sigma_m(fixes.cov_in_geo), _WRONG_SCATTER_M)
        if fits and not hangs_upside_down(model, similarity):
            sentence += (
                f"; the mirrored track fits upright (scatter {scatter:.2f} m): east and north, or the axes of the "
                "CRS, are exchanged"
            )
    except DegenerateGeometryError:
        pass
    return [Caution(code="upside-down", sentence=sentence)]


def _fixes_against_model(
    survey: Survey, model: SparseModel, factor: VarianceFactor, joint: JointAdjustment
) -> list[Caution]:
    """Return the contradiction of fixes and SfM model, with the mistake that explains it."""
    if factor.applied <= _QUIET_FACTOR:
        return []
    shift = _constant_shift(joint.residuals(FixTerm)[1])
    if shift is not None and joint.problem.control is not None:
        return [_apart(-shift, _height_of_control(joint))]
    correspondences = fix_correspondences(survey, model)
    sigma = _sigma_m(correspondences.cov_in_geo)
    rejected = factor.count - factor.used
    sides = (
        f"the fixes scatter by {sigma * factor.applied**0.5:.2f} m an axis about the SfM model, their σ is "
        f"{sigma:.3g} m"
    )
    if rejected:
        sides += f", and {rejected} of {factor.count} are outliers"
    best = _explanation(survey, model)
    if best is not None:
        return [
            Caution(
                code=best.code, sentence=f"{sides}; with this they fit to {best.scatter_m:.2f} m: {best.sentence}"
            )
        ]
    remedy = "σ is optimistic, or the fixes or the SfM model are bent; every σ of the result is widened"
    return [Caution(code="sigma-refuted", sentence=f"{sides}: {remedy}")]


def _control_against_fixes(joint: JointAdjustment) -> list[tuple[bool, Caution]]:
    """Return whether the control points contradict the fixes, as (ends the stage, caution)."""
    problem = joint.problem
    found: list[tuple[bool, Caution]] = []
    bias, height_m = joint.bias, _height_of_control(joint)
    within = bias is not None and _within_sigma(joint, np.array(bias.value))
    if bias is not None and not within:
        length = float(np.linalg.norm(bias.value))
        values = _with_sigma(bias.value, bias.sigma)
        sentence = (
            f"all fixes are shifted by ({values}) m east, north, up against the control points, which decide the "
            f"position. Either side may be wrong: {shift_sentence(np.array(bias.value), height_m)}"
        )
        found.append((length > _EVERYDAY_SHIFT_M, Caution(code="fixes-shifted", sentence=sentence)))
    control, factor = problem.term(ControlTerm), _factor(joint, "control points")
    if control is None or factor is None or (factor.applied <= 1.0 and factor.used == factor.count):
        return found
    residual = joint.residuals(ControlTerm)[1]
    shift = _constant_shift(residual)
    rejected = [
        f"{name} ({np.linalg.norm(miss):.2f} m)"
        for name, miss, used in zip(control.point_id, residual, joint.components[control.kind].used, strict=True)
        if not used
    ]
    scatter = float(np.sqrt((residual**2).mean()))
    if shift is not None and problem.fixes is not None:
        found.append((True, _apart(shift, height_m)))
    elif factor.applied > _QUIET_FACTOR:
        sigma = (
            _sigma_m(np.array([point.cov_in_geo for point in joint.survey.control_points])) / factor.applied**0.5
        )
        who = "which nobody stated" if factor.sigma_source == "default" else "as stated"
        sentence = (
            f"the control points miss by {scatter:.2f} m RMS an axis, their σ is {sigma:.3g} m, {who}: "
            "coordinates, marks or the SfM model are wrong; every σ of the result is widened"
        )
        found.append(
            (_is_wrong(factor) and scatter > _WRONG_SCATTER_M, Caution(code="sigma-refuted", sentence=sentence))
        )
    elif rejected:
        sentence = f"{len(rejected)} of {factor.count} control points are outliers: {', '.join(rejected[:8])}"
        found.append((False, Caution(code="control-outliers", sentence=sentence)))
    return found


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


def _explanation(survey: Survey, model: SparseModel) -> Hypothesis | None:
    """Return the known mistake that explains why the fixes do not fit the SfM model, if one does."""
    fixes = fix_correspondences(survey, model)
    times_s = _times(survey, fixes.name)
    found = explanations_of_fixes(fixes.in_local, fixes.in_geo, times_s, survey.origin)
    upright = [hypothesis for hypothesis in found if not hangs_upside_down(model, hypothesis.geo_from_local)]
    return upright[0] if upright else None


def _height_of_control(joint: JointAdjustment) -> float:
    """Return the median ellipsoidal height of the control points as stated, NaN without any."""
    heights = [point.position_in_geo[2] for point in joint.survey.control_points]
    return float(np.median(heights)) + joint.survey.origin.alt_m if heights else float("nan")


def _with_sigma(values: tuple[float, ...], sigmas: tuple[float, ...]) -> str:
    return ", ".join(f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(values, sigmas, strict=True))


def _within_sigma(joint: JointAdjustment, shift_m: FloatArray) -> bool:
    """Return whether a shift that all fixes share is no larger than the σ of one of them allows."""
    fixes = joint.problem.term(FixTerm)
    if fixes is None:
        return False
    information = (fixes.root_information.transpose(1, 2) @ fixes.root_information).mean(dim=0).cpu().numpy()
    return bool(shift_m @ information @ shift_m <= outlier_gate(3))


def _attitudes(survey: Survey, model: SparseModel, joint: JointAdjustment) -> list[Caution]:
    prior = attitude_prior(survey, model)
    if prior is None:
        return []
    turn = log_so3(prior.rotation @ joint.geo_from_local.rotation.T)
    sigma = float(np.sqrt(prior.cov_rad2[0, 0]))
    angle = float(np.linalg.norm(turn))
    if angle <= max(_ATTITUDE_SIGMAS * sigma, _ATTITUDE_RAD):
        return []
    sentence = (
        f"the recorded attitudes are turned by {np.degrees(angle):.1f}° against this solution "
        f"(σ {np.degrees(sigma):.1f}°): compass, mount, or the positions (their times, their axes) are wrong"
    )
    return [Caution(code="attitudes-contradict", sentence=sentence)]


def _weak_checks(joint: JointAdjustment) -> list[Caution]:
    """Return cautions of σ that little or nothing checks."""
    tested = [factor for factor in joint.factors if factor.group in ("fixes", "control points")]
    redundancy, cautions = sum(factor.redundancy for factor in tested), []
    if redundancy < 6.0:
        sentence = (
            f"only {redundancy:.0f} degrees of freedom check the σ of the positions: a wrong position can go "
            "unnoticed; add fixes or control points"
        )
        cautions.append(Caution(code="hardly-checked", sentence=sentence))
    fixes = joint.problem.term(FixTerm)
    if fixes is not None and not any(factor.group == "control points" for factor in tested):
        sigma = _sigma_m(np.array([image.fix.cov_in_geo for image in joint.survey.images if image.fix is not None]))
        sentence = (
            "no control point checks an error that all fixes share, of the base station or of a receiver without "
            f"corrections: σ count the fixes, of {sigma:.2g} m, as independent"
        )
        cautions.append(Caution(code="no-control-points", sentence=sentence))
    return cautions


def _guesses(joint: JointAdjustment) -> list[Caution]:
    """Return a caution of the σ that nobody stated, with the variance factors that stand in for them."""
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
    return [Caution(code="default-sigma", sentence=sentence)]


def _times(survey: Survey, names: tuple[str, ...]) -> FloatArray:
    times = {image.name: image.timestamp_s for image in survey.images}
    return np.array([np.nan if times[name] is None else times[name] for name in names], dtype=np.float64)


def _sigma_m(covariances: FloatArray) -> float:
    """Return the typical σ per axis of covariances (n, 3, 3)."""
    return float(np.sqrt(np.median(np.trace(covariances, axis1=1, axis2=2)) / 3))
