"""Start of the constant errors: their least-squares values, the unit of their learning, and a test of biases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pipelines.adjust.normal_equations import RobustMinimum, posterior_weights
from pipelines.adjust.posterior import GeoEquations, equations_of, linearised, place
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity_fit import BIAS_COST
from pipelines.adjust.sparse_adjustment import SparseMinimum, minimise_sparse, state_of
from pipelines.adjust.sparse_observations import State
from pipelines.adjust.systematic import SystematicErrors
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, GeorefError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.bundle_information import BundleInformation

# Rotations of similarity and boresight are not linear: four linearisations are enough from 20°.
_ROUNDS, _NEAR = 4, 0.1  # a step below a tenth of a σ ends them earlier


def begin(problem: GeoProblem) -> float:
    """Set the constant errors of a problem to their least-squares values, and return the gain in likelihood.

    All unknowns are adjusted to all measurements with Cauchy's weights, from two starts: the present similarity,
    and the control points with the fixes' offset as their bias. The likelier minimum counts. The unit of the
    errors' coordinates x becomes the root of their covariance there. The similarity and the cameras stay as they
    were, unless sparse equations solve the problem: it is left at the likelier minimum, to continue from.

    Returns:
        Decrease of −2 ln likelihood by the errors, against a solution without them.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
        ConvergenceError: sparse equations do not settle, from either start.
    """
    if problem.bundle is not None:
        return _begin_sparse(problem, problem.bundle)
    y, errors = problem.similarity.y, problem.errors
    before = y.detach().clone()
    for _ in range(_ROUNDS):
        equations = equations_of(problem)
        with_errors = _best(problem, equations, with_errors=True)
        covariance = equations.normal.covariance(posterior_weights(with_errors.residuals))
        solved = slice(0, equations.constant.stop)
        constant = equations.constant
        values = equations.normal.offset[constant] + with_errors.step[constant]
        errors.begin(values, np.asarray(np.linalg.cholesky(covariance[constant, constant])))
        with torch.no_grad():
            y.add_(torch.from_numpy(with_errors.step[equations.similarity]).to(y.device))
        step = with_errors.step[solved]
        if step @ np.linalg.solve(covariance[solved, solved], step) < _NEAR**2:
            break
    without = _best(problem, equations, with_errors=False)
    with torch.no_grad():
        y.copy_(before)
    return without.cost - with_errors.cost


def _begin_sparse(problem: GeoProblem, bundle: BundleInformation) -> float:
    """Move a problem to the likelier of the minima from both starts, and return the gain in likelihood.

    The gain is that of the quadratic form of the errors about the minimum, vᵀ Σ⁻¹ v with their covariance Σ. A
    second solution without errors would cost as much as the first.
    """
    errors, here = problem.errors, state_of(problem)
    minimum: SparseMinimum | None = None
    refusal: GeorefError | None = None
    for start in (here, _at_control(problem, here)):
        place(problem, start)
        try:
            found = minimise_sparse(problem, bundle, equations=None if minimum is None else minimum.equations)
        except (ConvergenceError, DegenerateGeometryError) as error:
            refusal = error
        else:
            minimum = found if minimum is None or found.cost < minimum.cost else minimum
    if minimum is None:
        assert refusal is not None
        raise refusal
    place(problem, minimum.state)
    linear = linearised(problem)
    constant = slice(7, 7 + len(errors))
    covariance = linear.covariance_of_known(posterior_weights(linear.residuals()))[constant, constant]
    values = minimum.state.errors
    errors.begin(values, np.asarray(np.linalg.cholesky(covariance)))
    return float(values @ np.linalg.solve(covariance, values))


def _at_control(problem: GeoProblem, here: State) -> State:
    """Return a state whose similarity fits the control points, with the fixes' offset as biases."""
    similarity, constant = _steps_to_control(problem)
    return replace(here, similarity=here.similarity + similarity, errors=here.errors + constant)


def bias_pays(errors: SystematicErrors, saved: float) -> bool:
    """Return whether biases are accepted that lower −2 ln likelihood by `saved`.

    A bias that does not exist costs accuracy, since the fixes then have no information on the position: with RTK
    and a few control points, σ doubles at least. The bias has to be evident, as for the initial similarity.
    """
    return saved > BIAS_COST * errors.flights


def _best(problem: GeoProblem, equations: GeoEquations, *, with_errors: bool) -> RobustMinimum:
    """Return the likelier of the minima from two starts, with the constant errors free or held at zero."""
    free: BoolArray = np.ones(len(equations.normal.precision), dtype=bool)
    free[equations.constant] = with_errors
    no_step = np.zeros(len(free))
    starts = [no_step, _step_to_control(problem, equations)]
    if not with_errors:
        for start in starts:
            start[equations.constant] = -equations.normal.offset[equations.constant]
    return min((equations.normal.minimum(start, free) for start in starts), key=lambda solution: solution.cost)


def _step_to_control(problem: GeoProblem, equations: GeoEquations) -> FloatArray:
    """Return the step (P,) that shifts the similarity onto the control points, with the fixes' offset as biases."""
    step = np.zeros(len(equations.normal.precision))
    step[equations.similarity], step[equations.constant] = _steps_to_control(problem)
    return step


@torch.no_grad()
def _steps_to_control(problem: GeoProblem) -> tuple[FloatArray, FloatArray]:
    """Return the same step of the similarity's coordinates (7,) and of the constant errors (p,)."""
    fixes, control, errors, at = problem.fixes, problem.control, problem.errors, problem.estimate()
    similarity, constant = np.zeros(7), np.zeros(len(errors))
    if fixes is None or control is None:
        return similarity, constant
    shift = -control.residuals(at).median(dim=0).values
    root = problem.similarity.root
    similarity = torch.linalg.solve(root, torch.cat([root.new_zeros(4), shift])).cpu().numpy()
    if errors.flights:
        residual = fixes.residuals(at) + shift
        flight = torch.zeros_like(fixes.camera) if fixes.flight is None else fixes.flight
        middle = torch.stack([residual[flight == index].median(dim=0).values for index in range(errors.flights)])
        constant[: 3 * errors.flights] = -middle.cpu().numpy().ravel()
    return similarity, constant
