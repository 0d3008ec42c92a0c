"""Joint adjustment of similarity, constant errors and many cameras, in sparse normal equations.

`adjust.sparse_equations` has the equations. A quasi-Newton step takes the gradient at the present state and a
factor that may be older: the minimum is exact, and only few factorisations are needed. A step that raises the cost
is halved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import bsr_matrix

from pipelines.adjust.normal_equations import Residuals, robust_cost, robust_weights
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_equations import SparseEquations, followers, prior_of_border, prior_of_poses
from pipelines.adjust.sparse_observations import State, colours_of_cameras, observed, residuals_and_slope
from pipelines.core.errors import ConvergenceError
from pipelines.core.types import FloatArray
from pipelines.geometry.bundle_information import BundleInformation

_ROUNDS = 150
_STILL = 5e-6  # change of a whitened residual that ends the descent
_NOISE = 1e-10  # relative rise of the cost that rounding causes
_HALVINGS = 12  # of a step that raises the cost
_NEW_FACTOR = 0.6  # a step that leaves more of the last change of the residuals asks for a new factor


@dataclass(frozen=True)
class Unknowns:
    """Values of all unknowns.

    Attributes:
        poses: x' (6 n,).
        border: (q + 7 + L,): first q = 7 + p + 7 + L values y, v, g, ℓ, then the multipliers λ of g and ℓ.
    """

    poses: FloatArray
    border: FloatArray


@dataclass(frozen=True)
class SparseMinimum:
    """Minimum of a problem.

    Attributes:
        state: values of all unknowns.
        cost: −2 ln likelihood, with the priors.
        equations: factorised near the minimum, with robust weights.
    """

    state: State
    cost: float
    equations: SparseEquations


def minimise_sparse(
    problem: GeoProblem,
    bundle: BundleInformation,
    *,
    lens_follows: bool = True,
    equations: SparseEquations | None = None,
) -> SparseMinimum:
    """Return the minimum of a problem's whitened loss over similarity, constant errors, and all cameras with lens.

    The minimum is that of `adjust.posterior.minimise` with the basis of `geometry.correction_basis`. All unknowns
    start from the state of the problem, which is left as it is.

    Args:
        problem: the measurements.
        bundle: information of the image observations, at the uncorrected poses of the problem's cameras.
        lens_follows: whether the lens follows the cameras, as `bundle` was made with.
        equations: of a state near by, whose factor the first steps take; None: there are none.

    Raises:
        ConvergenceError: the steps do not end.
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    unknowns, prior = _start(problem, bundle), (prior_of_poses(bundle), prior_of_border(problem, bundle))
    colours, last, halved = colours_of_cameras(problem), np.inf, 0
    accepted: _Evaluated | None = None
    for _ in range(_ROUNDS):
        state = _state(problem, bundle, unknowns, lens_follows)
        residuals, slope = residuals_and_slope(problem, state, robust_weights)
        cost = _cost(prior, residuals, unknowns)
        if accepted is not None:
            change = _largest_change(accepted.residuals, residuals)
            if cost > accepted.cost + _NOISE * (1 + abs(cost)) and change >= _STILL:
                halved += 1
                if halved > _HALVINGS:
                    break
                unknowns, equations = _halfway(accepted.unknowns, unknowns), None if halved == 1 else equations
                continue
            if change < _STILL and equations is not None:
                return SparseMinimum(state, cost, equations)
            equations, last, halved = (None if change > _NEW_FACTOR * last else equations), change, 0
        if equations is None:
            rows = observed(problem, state, colours)
            equations = SparseEquations(problem, bundle, rows, robust_weights(residuals))
        by_poses, by_border = _slope_by_unknowns(prior, bundle, slope, unknowns)
        poses, border = equations.solve(-by_poses[:, None], -by_border[:, None])
        accepted = _Evaluated(unknowns, residuals, cost)
        unknowns = Unknowns(unknowns.poses + poses[:, 0], unknowns.border + border[:, 0])
    raise ConvergenceError(f"the cameras do not settle: the last step changed a residual by {last:.1e} σ")


@dataclass(frozen=True)
class _Evaluated:
    unknowns: Unknowns
    residuals: Residuals
    cost: float


def _halfway(start: Unknowns, end: Unknowns) -> Unknowns:
    """Return the middle of a step."""
    return Unknowns((start.poses + end.poses) / 2, (start.border + end.border) / 2)


def _largest_change(before: Residuals, after: Residuals) -> float:
    return max((float(np.abs(after[kind] - before[kind]).max()) for kind in after), default=0.0)


def state_of(problem: GeoProblem) -> State:
    """Return the present state of a problem."""
    cameras = problem.cameras
    with torch.no_grad():
        parts = cameras.corrections(), cameras.lens(), problem.similarity.y, problem.errors.vector()
        return State(*(part.detach().cpu().numpy().copy() for part in parts))


def _start(problem: GeoProblem, bundle: BundleInformation) -> Unknowns:
    state, follow = state_of(problem), followers(bundle)
    poses = state.correction.ravel()
    values = [state.similarity, state.errors, follow @ poses, np.zeros(len(follow))]
    return Unknowns(poses, np.concatenate(values))


def _cost(prior: tuple[bsr_matrix, FloatArray], residuals: Residuals, unknowns: Unknowns) -> float:
    of_poses, of_border = prior
    values = unknowns.border[: len(of_border)]
    from_prior = unknowns.poses @ (of_poses @ unknowns.poses) + values @ of_border @ values
    return robust_cost(residuals) + float(from_prior)


def _state(problem: GeoProblem, bundle: BundleInformation, unknowns: Unknowns, lens_follows: bool) -> State:
    """Return the state that unknowns describe: the cameras' corrections without their similarity, and the rest."""
    p, lenses = len(problem.errors), len(bundle.lens)
    y, v, g, lens, _ = np.split(unknowns.border, np.cumsum([7, p, 7, lenses]))
    correction = (unknowns.poses - bundle.similarity_modes @ g).reshape(-1, 6)
    return State(correction, lens if lens_follows else lens[:0], y, v)


def _slope_by_unknowns(
    prior: tuple[bsr_matrix, FloatArray], bundle: BundleInformation, slope: State, unknowns: Unknowns
) -> tuple[FloatArray, FloatArray]:
    """Return the gradient of half the weighted squares, prior and constraints included, by x' and the border.

    Args:
        prior: information on x', and on y, v, g and ℓ.
        bundle: information of the image observations on the cameras.
        slope: gradient of half the weighted squares of the measurements by the state.
        unknowns: where the gradient is taken.
    """
    of_poses, of_border = prior
    follow, count = followers(bundle), len(of_border)
    values, multipliers = unknowns.border[:count], unknowns.border[count:]
    by_correction, by_lens = slope.correction.ravel(), np.zeros(len(bundle.lens))
    by_lens[: len(slope.lens)] = slope.lens
    by_similarity = -(by_correction @ bundle.similarity_modes)
    by_values = of_border @ values + np.concatenate([slope.similarity, slope.errors, by_similarity, by_lens])
    by_values[-len(follow) :] += multipliers
    violated = values[-len(follow) :] - follow @ unknowns.poses
    by_poses = by_correction + of_poses @ unknowns.poses - follow.T @ multipliers
    return by_poses, np.concatenate([by_values, violated])
