"""Joint adjustment of similarity, cameras and lens to all measurements, with an estimate of their variance factors.

The problem is that of the training, without photographs. So the lens and SfM's own errors have their part in the
result and in its covariance, and the factors are those with which training and evaluation go on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from pipelines.adjust.alignment import mean_rotation
from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.observations import recorded_rotations
from pipelines.adjust.posterior import linearised, minimise, solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity_fit import BIAS_COST
from pipelines.adjust.terms import ControlTerm, FixTerm, Term
from pipelines.adjust.variance_components import VarianceComponent, component_of, variance_components
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.estimated_error import EstimatedError
from pipelines.scene.geographic_options import GeographicOptions, Solve
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.marks import RayErrors, intersect_marks, mark_angles, mark_rays
from pipelines.scene.scene import Scene, initial_scene
from pipelines.scene.survey import Survey
from pipelines.scene.variance_factors import (
    Group,
    SigmaSource,
    VarianceFactor,
    applied_factors,
    with_variance_factors,
)

_ROUNDS, _SETTLED = 8, 0.02  # of the factors, and their relative change at which they are final
# Level of the test below which a σ is refuted: a stated one, and one that nobody stated.
_LEVEL: dict[SigmaSource, float] = {"stated": 0.001, "default": 0.01}
_KIND: dict[Group, str] = {"fixes": FixTerm.kind, "control points": ControlTerm.kind}
_EXACT = 1e-9


@dataclass(frozen=True)
class JointAdjustment:
    """Solution, and what the measurements say of each other.

    Attributes:
        survey: with the variance factors in its covariances; all images are training images.
        scene: of the adjustment.
        problem: at its minimum.
        at_stated: tests of fixes and control points by kind, under the stated σ.
        components: the same under the applied factors.
        factors: tests of all groups.
        cost: −2 ln likelihood at the stated σ; compares solutions from different starts.
    """

    survey: Survey
    scene: Scene
    problem: GeoProblem
    at_stated: dict[str, VarianceComponent]
    components: dict[str, VarianceComponent]
    factors: tuple[VarianceFactor, ...]
    cost: float

    @property
    def is_consistent(self) -> bool:
        """Whether fixes and control points agree with each other at the stated σ."""
        return all(component.agree and component.used.all() for component in self.at_stated.values())

    @property
    def geo_from_local(self) -> Similarity:
        """The similarity."""
        return self.problem.similarity.current() @ self.scene.model_from_local

    def residuals(self, kind: type[Term]) -> tuple[tuple[str, ...], FloatArray, BoolArray]:
        """Return names, residuals (M, 3) in metres, measured minus predicted, and the mask (M,) of the inliers."""
        term = self.problem.term(kind)
        if term is None:
            return (), np.empty((0, 3)), np.empty(0, dtype=bool)
        with torch.no_grad():
            missed = -term.residuals(self.problem.estimate()).cpu().numpy()
        if isinstance(term, ControlTerm):
            names = term.point_id
        else:
            assert isinstance(term, FixTerm)
            names = tuple(self.scene.sparse.image_name[int(index)] for index in term.camera)
        return names, missed, self.components[term.kind].used

    @property
    def bias(self) -> EstimatedError | None:
        """Shift of all fixes against the control points, if there is evidence of one."""
        if not len(self.problem.errors):
            return None
        of_errors = solution_covariances(self.problem)[1]
        return self.problem.errors.estimates(of_errors)[0]


def adjust_jointly(
    survey: Survey, model: SparseModel, starts: Iterable[InitialSimilarity], *, solve: Solve = "auto"
) -> JointAdjustment:
    """Return the adjustment from the first start, or the likeliest of several where the first finds disagreement.

    Args:
        survey: the measurements with their stated σ.
        model: the SfM model.
        starts: similarities to start from.
        solve: equations of the cameras, as in `GeographicOptions`; "auto": those that are faster.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open, from every start.
    """
    everything = survey.model_copy(
        update={"images": tuple(image.model_copy(update={"split": "train"}) for image in survey.images)}
    )
    solutions, refusal = [], DegenerateGeometryError("no start for the joint adjustment")
    for start in starts:
        try:
            solutions.append(_adjust(everything, model, start, solve))
            if solutions[0].is_consistent:
                break
        except (DegenerateGeometryError, ConvergenceError) as error:
            refusal = DegenerateGeometryError(str(error))
    if not solutions:
        raise refusal
    return min(solutions, key=lambda solution: solution.cost)


def _adjust(survey: Survey, model: SparseModel, start: InitialSimilarity, solve: Solve) -> JointAdjustment:
    """Alternate between the solution and the variance factors, from the stated σ."""
    scene = initial_scene(model, survey, start)
    fixed = {factor.group: factor for factor in (*_marks(survey, scene), *_attitudes(survey, model), *_ties(scene))}
    applied = applied_factors(tuple(fixed.values()))
    problem, cost = _solved(scene, with_variance_factors(survey, applied), start, solve)
    cost += BIAS_COST * problem.errors.flights
    at_stated = components = variance_components(linearised(problem))
    for _ in range(_ROUNDS):
        before, applied = applied, applied | _next_factors(survey, components, applied)
        if all(abs(applied.get(group, 1.0) / before.get(group, 1.0) - 1) < _SETTLED for group in _KIND):
            break
        problem, _ = _solved(scene, with_variance_factors(survey, applied), start, solve)
        components = variance_components(linearised(problem))
    factors = [
        _factor(survey, group, components[kind], applied.get(group, 1.0))
        for group, kind in _KIND.items()
        if kind in components
    ]
    weighted = with_variance_factors(survey, applied)
    return JointAdjustment(weighted, scene, problem, at_stated, components, (*factors, *fixed.values()), cost)


def _solved(scene: Scene, survey: Survey, start: InitialSimilarity, solve: Solve) -> tuple[GeoProblem, float]:
    """Return the problem at its minimum, and −2 ln likelihood there."""
    options = GeographicOptions(rel_loss=False, solve=solve)
    problem = geo_problem(scene, survey, start, options.without_photographs(len(scene.sparse.image_name)))
    if not problem.terms:
        raise DegenerateGeometryError("fewer than three positions of one kind take part in a joint adjustment")
    return problem, minimise(problem)


def _next_factors(
    survey: Survey, components: dict[str, VarianceComponent], applied: dict[Group, float]
) -> dict[Group, float]:
    """Return the factors that the present residuals ask for, where the stated σ are refuted; never below 1.

    The scatter within a survey does not show an error that all its members share. σ that look too large are
    therefore left as they are.
    """
    factors = {}
    for group, kind in _KIND.items():
        component, present = components.get(kind), applied.get(group, 1.0)
        if component is None:
            continue
        refuted = component.probability(present) < _LEVEL[_source(survey, group)]
        factors[group] = max(present * component.cautious_factor, 1.0) if refuted else 1.0
    return factors


def _source(survey: Survey, group: Group) -> SigmaSource:
    return "default" if group in survey.default_sigmas else "stated"


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


def _marks(survey: Survey, scene: Scene) -> list[VarianceFactor]:
    """Test the σ of the control points' marks: how well their rays meet in the SfM model."""
    rays = mark_rays(survey.control_points, scene.sparse)
    rays = rays.of_points(rays.marks_of_point >= 2)
    if not len(rays):
        return []
    poses = scene.poses
    solved = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, RayErrors(_EXACT, _EXACT))
    angle = mark_angles(rays, solved.position_in_geo, poses.cam_from_model, poses.cam_center_in_model)
    squared = (angle / rays.sigma_rad) ** 2
    free = 2.0 - 3.0 / rays.marks_of_point[rays.point]
    good = np.isfinite(squared)
    component = component_of(squared[good], free[good], 2)
    return [_independent(survey, "marks", component)]


def _attitudes(survey: Survey, model: SparseModel) -> list[VarianceFactor]:
    """Test the σ of the attitudes: their scatter about the rotation that all of them share."""
    recorded = recorded_rotations(survey, model)
    count = len(recorded.image)
    if count < 2:
        return []
    geo_from_local = recorded.geo_from_local(model)
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


def _ties(scene: Scene) -> list[VarianceFactor]:
    """State the variance of the image observations of tie points, in square pixels: SfM knows no σ beforehand."""
    network = scene.network
    rows = len(network.obs_point)
    free = 2 * rows - 6 * len(network.camera_id) - 3 * len(network.point_in_world)
    return [
        VarianceFactor(
            group="tie points",
            count=rows,
            used=rows,
            redundancy=free,
            estimated=scene.bundle.sigma_px**2,
            probability=1.0,
            applied=1.0,
            sigma_source="default",
        )
    ]
