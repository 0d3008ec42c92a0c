"""Joint adjustment of similarity, cameras, lens and systematic errors, with an estimate of the variance factors.

The lens and SfM's own errors have their part in the result and in its covariance, and the factors are those with
which training and evaluation go on.

At the minimum, each kind of observation has a sum of whitened squares q and a redundancy r: the number of its
observations less the part that the unknowns absorb. q/r estimates the factor between true and stated variance, and
q is χ² with r degrees of freedom where the stated σ are right (Förstner 1979; Niemeier, Ausgleichungsrechnung,
2008, section 9.4). Outliers take no part if most observations agree with each other, at whatever σ. Where they do
not agree, nothing shows which of them are wrong, and all of them count.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipelines.adjust.alignment import mean_rotation
from pipelines.adjust.measurements import onto_control, problem_of, recorded_rotations, start_of
from pipelines.adjust.state import State
from pipelines.adjust.system import Linearised, NormalMatrix, Problem, linearised, minimise, posterior_weights
from pipelines.adjust.terms import CommonErrors, ControlPoints, Distances, EarlierPoints, Fixes
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import chi2_probability_above, median_chi2, outlier_gate
from pipelines.survey.marks import RayErrors, intersect_marks, mark_angles, mark_rays
from pipelines.survey.measurement_errors import (
    EstimatedError,
    Group,
    SigmaSource,
    VarianceFactor,
    applied_factors,
    with_variance_factors,
)
from pipelines.survey.scene import SparseScene, initial_scene
from pipelines.survey.solution import SimilarityEstimate
from pipelines.survey.survey import MountParameter, Survey

_ROUNDS, _SETTLED = 8, 0.02  # of the factors, and their relative change at which they are final
_NEAR = 0.5  # relative change up to which the equations before it serve the first steps
# Level of the test below which a σ is rejected: a stated one, and one that nobody stated.
_LEVEL: dict[SigmaSource, float] = {"stated": 0.001, "default": 0.01}
_TESTED: tuple[Group, ...] = ("fixes", "horizontal drift", "vertical drift", "control points", "common points")
# Nobody states their σ.
_NEVER_STATED: tuple[Group, ...] = ("horizontal drift", "vertical drift", "common points")
# Axes of the drift, and the group whose σ holds the mean of the drift.
_DRIFTS: dict[Group, tuple[list[int], Group]] = {
    "horizontal drift": ([0, 1], "horizontal common error"),
    "vertical drift": ([2], "vertical common error"),
}
_EXACT = 1e-9
_FEW_OUTLIERS = 0.02  # of the fixes: noise alone puts one in a thousand beyond the gate
# Observations agree if so large a part of them is within the gate, and so many degrees of freedom check them.
_CONSENSUS, _LEAST_REDUNDANCY = 2 / 3, 3.0
_NO_REDUNDANCY = 0.5


@dataclass(frozen=True)
class Consistency:
    """Consistency of the measurements of an adjustment with each other, at its minimum."""

    used: dict[str, BoolArray]  # by kind of observation: mask (M,) of those that agree
    factors: dict[Group, VarianceFactor]
    estimates: tuple[EstimatedError, ...]  # of the systematic errors

    @property
    def biases(self) -> tuple[EstimatedError, ...]:
        """Common errors of the fixes, by session."""
        return tuple(estimate for estimate in self.estimates if estimate.name == "bias")

    def weighted(self, survey: Survey) -> Survey:
        """Return a survey with the variance factors in its covariances."""
        return with_variance_factors(survey, applied_factors(tuple(self.factors.values())))

    def missed(self, near: Linearised, kind: str) -> tuple[tuple[str, ...], FloatArray, BoolArray]:
        """Return names, residuals (M, d) in metres, measured minus predicted, and the mask (M,) of the inliers."""
        term = near.problem.term(kind)
        if not isinstance(term, (Fixes, ControlPoints, Distances, EarlierPoints)):
            return (), np.empty((0, 3)), np.empty(0, dtype=bool)
        return term.name, -term.residuals(near.problem.at(near.state)), self.used[kind]


@dataclass(frozen=True)
class Start:
    """Similarity to start from, and whether the control points set it, so that common errors take the rest."""

    initial: SimilarityEstimate
    at_control: bool = False


def adjust_jointly(
    survey: Survey, model: SparseModel, starts: Iterable[Start], *, estimate: tuple[MountParameter, ...] = ()
) -> tuple[SparseScene, Linearised, Consistency]:
    """Return the minimum from the first start, or the likeliest of several where the first finds disagreement.

    The scene is that of the start. The problem at its minimum has all measurements, with the variance factors. A
    layout on a line takes the attitudes into the adjustment.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open, from every start.
        InputError: an error is to be estimated whose measurements were not recorded.
    """
    attempts: list[_Found] = []
    refusal = DegenerateGeometryError("no-start", "The joint adjustment has no start.")
    frame: SparseScene | None = None
    for start in starts:
        try:
            frame = initial_scene(model, survey, start.initial) if frame is None else frame
            attempts.append(_adjust(survey, frame, start, estimate))
            if attempts[0].consistent:
                break
        except (DegenerateGeometryError, ConvergenceError) as error:
            refusal = DegenerateGeometryError(error.code, error.fault, remedy=error.remedy)
    if frame is None or not attempts:
        raise refusal
    best = min(attempts, key=lambda one: one.cost)
    return frame, best.near, best.consistency


def in_own_frame(
    before: SparseScene, state: State, survey: Survey, initial: SimilarityEstimate
) -> tuple[SparseScene, State]:
    """Return scene and state in the frame `model` of the solution: axes and metre of geo, as training takes them.

    The state was solved in the scene of its start; `survey` has the split into training and test images.
    """
    scene = initial_scene(before.sparse, survey, initial)
    new_from_old = scene.model_from_local @ before.model_from_local.inverse()
    turn = new_from_old.rotation
    corrections = np.concatenate(
        [state.correction[:, :3] @ turn.T, new_from_old.scale * state.correction[:, 3:] @ turn.T], axis=1
    )
    scene = replace(scene, known_bundle=before.bundle.turned(new_from_old, scene.poses.cam_center_in_model))
    return scene, State(scene.geo_from_model, corrections, state.lens, state.errors)


class _Found(NamedTuple):
    """Minimum from one start."""

    near: Linearised
    consistency: Consistency
    consistent: bool  # but for a few outlying fixes, at the stated σ
    cost: float  # −2 ln likelihood at the stated σ; compares solutions from different starts


def _adjust(survey: Survey, scene: SparseScene, start: Start, estimate: tuple[MountParameter, ...]) -> _Found:
    """Alternate between the solution and the variance factors, from the stated σ."""
    fixed = {
        factor.group: factor for factor in (*_marks(survey, scene), *_attitudes(survey, scene.sparse), _ties(scene))
    }
    applied = applied_factors(tuple(fixed.values()))

    def problem_at(factors: dict[Group, float]) -> Problem:
        weighted = with_variance_factors(survey, factors)
        with_attitudes = start.initial.layout == "line"
        return problem_of(scene, weighted, estimate=estimate, with_attitudes=with_attitudes)

    problem = problem_at(applied)
    if not problem.measured:
        raise DegenerateGeometryError("no-positions", "The adjustment has no fix and no control point.")
    geo_from_local = Similarity.from_record(start.initial.geo_from_local)
    geo_from_model = geo_from_local @ scene.model_from_local.inverse()
    state = replace(start_of(scene, problem), geo_from_model=geo_from_model)
    if start.at_control:
        state = onto_control(problem, state)
    minimum = minimise(problem, state)
    cost = minimum.cost
    near = linearised(problem, minimum.state)
    components, normal = variance_components(near)
    consistent = _agree(components)
    for _ in range(_ROUNDS):
        before, applied = applied, applied | _next_factors(survey, components, applied)
        applied |= _of_common_errors(survey, problem, minimum.state, applied)
        changes = [abs(applied.get(group, 1.0) / before.get(group, 1.0) - 1) for group in _TESTED]
        if all(change < _SETTLED for change in changes):
            break
        problem = problem_at(applied)
        minimum = minimise(problem, minimum.state, None if max(changes) > _NEAR else normal)
        near = linearised(problem, minimum.state)
        components, normal = variance_components(near)
    factors = (
        {
            group: _factor(survey, group, components[group], applied.get(group, 1.0))
            for group in _TESTED
            if group in components
        }
        | fixed
        | _stated_common_errors(survey, applied)
    )
    errors = problem.errors
    estimates = errors.estimates(minimum.state.errors, normal.of_errors(len(problem.lens), len(errors)))
    used = {kind: component.used for kind, component in components.items()}
    return _Found(near, Consistency(used, factors, estimates), consistent, cost)


def _agree(components: dict[str, VarianceComponent]) -> bool:
    """Return whether fixes and control points agree with each other, but for a few outlying fixes."""
    fixes, control = (components.get(kind) for kind in (Fixes.kind, ControlPoints.kind))
    of_fixes = fixes is None or (fixes.agree and float(fixes.used.mean()) >= 1.0 - _FEW_OUTLIERS)
    return of_fixes and (control is None or (control.agree and bool(control.used.all())))


def _next_factors(
    survey: Survey, components: dict[str, VarianceComponent], applied: dict[Group, float]
) -> dict[Group, float]:
    """Return the factors that the present residuals ask for, where the χ² test rejects the stated σ; never below 1.

    The scatter within a survey does not show an error that all its members share. σ that look too large are
    therefore left as they are.
    """
    factors = {}
    for group in _TESTED:
        component, present = components.get(group), applied.get(group, 1.0)
        if component is None:
            continue
        rejected = component.probability(present) < _LEVEL[_source(survey, group)]
        estimated = component.factor if group in _DRIFTS else component.cautious_factor
        factors[group] = max(present * (estimated or 1.0), 1.0) if rejected else 1.0
    return factors


def _of_common_errors(
    survey: Survey, problem: Problem, state: State, applied: dict[Group, float]
) -> dict[Group, float]:
    """Return the factors of the common errors of sessions that drift more than stated.

    The adjustment does not see the mean of a drift. It is taken to be as large as what the drift does within the
    session.
    """
    fixes, factors = problem.term(Fixes.kind), {}
    if not isinstance(fixes, Fixes):
        return {}
    blocks = problem.errors.blocks
    drifting = np.array([block.name == "drift" for block in blocks], dtype=bool)
    if not drifting.any():
        return {}
    drift = fixes.shares(problem.errors)[:, drifting] @ state.errors.reshape(-1, 3)[drifting]
    stated = np.array([session.sigma_common_m for session in survey.sessions])[fixes.session]
    for group, (axes, common) in _DRIFTS.items():
        variance = float(np.square(stated[:, axes]).mean())
        if variance > 0:
            grown = applied.get(group, 1.0) > 1.0
            factors[common] = 1.0 + float(np.square(drift[:, axes]).mean()) / variance if grown else 1.0
    return factors


def _stated_common_errors(survey: Survey, applied: dict[Group, float]) -> dict[Group, VarianceFactor]:
    count = len(survey.sessions)
    return {
        group: VarianceFactor(
            group=group,
            count=count,
            used=count,
            redundancy=0.0,
            estimated=None,
            probability=1.0,
            applied=applied[group],
            sigma_source="default",
        )
        for _, group in _DRIFTS.values()
        if applied.get(group, 1.0) > 1.0
    }


def _source(survey: Survey, group: Group) -> SigmaSource:
    return "default" if group in survey.default_sigmas or group in _NEVER_STATED else "stated"


def _factor(survey: Survey, group: Group, component: VarianceComponent, applied: float) -> VarianceFactor:
    estimated = component.factor
    return VarianceFactor(
        group=group,
        count=len(component.used),
        used=int(component.used.sum()),
        redundancy=component.redundancy,
        estimated=None if estimated is None else applied * estimated,
        probability=component.probability(applied),
        applied=applied,
        sigma_source=_source(survey, group),
    )


def _marks(survey: Survey, scene: SparseScene) -> list[VarianceFactor]:
    """Test the σ of the control points' marks: how well their rays meet in the SfM model."""
    rays = mark_rays(survey.control_points, scene.sparse)
    rays = rays.of_points(rays.marks_of_point >= 2)
    if not len(rays.point):
        return []
    poses = scene.poses
    solved = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, RayErrors(_EXACT, _EXACT))
    angle = mark_angles(rays, solved.position_in_geo, poses.cam_from_model, poses.cam_center_in_model)
    squared = (angle / rays.sigma_rad) ** 2
    free = 2.0 - 3.0 / rays.marks_of_point[rays.point]
    good = np.isfinite(squared)
    return [_independent(survey, "marks", component_of(squared[good], free[good], 2))]


def _attitudes(survey: Survey, model: SparseModel) -> list[VarianceFactor]:
    """Test the σ of the attitudes: their scatter about the rotation that all of them share."""
    recorded = recorded_rotations(survey, model)
    count = len(recorded.image)
    if count < 2:
        return []
    geo_from_local = recorded.geo_from_cam @ model.rotation_cam_from_local[recorded.image]
    mean = mean_rotation(geo_from_local, recorded.sigma_rad).rotation
    squared = (log_so3(geo_from_local @ mean.T) ** 2).sum(axis=1) / recorded.sigma_rad**2
    component = component_of(squared, np.full(count, 3.0 * (count - 1) / count), 3)
    factor = _independent(survey, "attitudes", component)
    return [factor.model_copy(update={"applied": max(factor.applied, 1.0)})]


def _independent(survey: Survey, group: Group, component: VarianceComponent) -> VarianceFactor:
    """Return the test of errors that members do not share, whose σ is therefore lowered too if nobody stated it."""
    level = _LEVEL[_source(survey, group)]
    probability = component.probability()
    small = probability > 1 - level and _source(survey, group) == "default"
    applied = component.cautious_factor if probability < level or small else 1.0
    return _factor(survey, group, component, 1.0).model_copy(update={"applied": max(applied, 0.01)})


def _ties(scene: SparseScene) -> VarianceFactor:
    """State the variance of the image observations of tie points, in square pixels: SfM knows no σ beforehand."""
    network = scene.network
    rows = len(network.obs_point)
    free = 2 * rows - 6 * len(network.camera_id) - 3 * len(network.point_in_world)
    return VarianceFactor(
        group="tie points",
        count=rows,
        used=rows,
        redundancy=free,
        estimated=scene.bundle.sigma_px**2,
        probability=1.0,
        applied=1.0,
        sigma_source="default",
    )


@dataclass(frozen=True)
class VarianceComponent:
    """Test of the σ of M observations of one kind."""

    used: BoolArray  # (M,) mask of the observations that count
    agree: bool  # whether most agree with each other, so that the others are outliers
    squares: float  # q of those that count
    redundancy: float  # r of those that count

    @property
    def factor(self) -> float | None:
        return self.squares / self.redundancy if self.redundancy > _NO_REDUNDANCY else None

    @property
    def cautious_factor(self) -> float:
        """Mean q/(r − 2) of the factor given q: larger where few degrees of freedom show little."""
        return self.squares / max(self.redundancy - 2.0, 1.0)

    def probability(self, scale: float = 1.0) -> float:
        """Return the probability that right σ, `scale` times smaller in variance, give a larger q.

        Without redundancy, the probability is 1.
        """
        if self.redundancy <= _NO_REDUNDANCY:
            return 1.0
        return chi2_probability_above(scale * self.squares, self.redundancy)


def component_of(squared: FloatArray, free: FloatArray, dimension: int) -> VarianceComponent:
    """Return the test of M observations, from squared whitened residuals (M,) and the redundancy (M,) of each."""
    free = np.clip(free, 1e-6, dimension)
    # The σ at which half of the observations agree; never smaller than the stated one.
    scale = max(float(np.median(squared / free)) * dimension / median_chi2(dimension), 1.0) if len(squared) else 1.0
    used = squared <= outlier_gate(dimension) * scale
    agree = len(used) > 0 and bool(used.mean() >= _CONSENSUS) and float(free[used].sum()) >= _LEAST_REDUNDANCY
    if not agree:
        used = np.ones(len(squared), dtype=bool)
    return VarianceComponent(used, agree, float(squared[used].sum()), float(free[used].sum()))


def variance_components(linear: Linearised) -> tuple[dict[str, VarianceComponent], NormalMatrix]:
    """Return the test of each kind of observation of a problem at its minimum, and the posterior's equations."""
    residuals = linear.residuals
    weights = posterior_weights(residuals)
    normal, components = linear.normal(weights), {}
    for kind, rows in residuals.items():
        dimension = rows.shape[1]
        absorbed = np.trace(linear.spread(weights, kind, normal), axis1=1, axis2=2) * weights[kind]
        components[kind] = component_of((rows**2).sum(axis=1), dimension - absorbed, dimension)
    blocks = linear.problem.errors.blocks
    drifting = np.array([block.name == "drift" for block in blocks], dtype=bool)
    if drifting.any():
        kind = CommonErrors.kind
        spread = np.diagonal(linear.spread(weights, kind, normal), axis1=1, axis2=2) * weights[kind][:, None]
        for group, (axes, _) in _DRIFTS.items():
            squares = float((residuals[kind][drifting][:, axes] ** 2).sum())
            free = float(np.clip(1.0 - spread[drifting][:, axes], 0.0, 1.0).sum())
            components[group] = VarianceComponent(np.ones(int(drifting.sum()), dtype=bool), True, squares, free)
    return components, normal
