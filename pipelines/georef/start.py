"""Start of the constant errors: their least-squares values, the unit of their learning, and a test of biases."""

from __future__ import annotations

import numpy as np
import torch

from pipelines.core.types import BoolArray, FloatArray
from pipelines.georef.adjustment import BIAS_COST
from pipelines.georef.normal_equations import RobustMinimum, posterior_weights
from pipelines.georef.posterior import GeoEquations, equations_of
from pipelines.georef.problem import GeoProblem
from pipelines.georef.systematic import SystematicErrors

# Rotations of similarity and boresight are not linear: four linearisations are enough from 20°.
_ROUNDS, _NEAR = 4, 0.1  # a step below a tenth of a σ ends them earlier


def begin(problem: GeoProblem) -> float:
    """Set the constant errors of a problem to their least-squares values, and return the gain in likelihood.

    All unknowns are adjusted to all measurements with Cauchy's weights, from two starts: the present similarity,
    and the control points with the fixes' offset as their bias. The likelier minimum counts. The unit of the
    errors' coordinates x becomes the root of their covariance there. The similarity and the cameras stay as they
    were.

    Returns:
        Decrease of −2 ln likelihood by the errors, against a solution without them.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
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


@torch.no_grad()
def _step_to_control(problem: GeoProblem, equations: GeoEquations) -> FloatArray:
    """Return the step (P,) that shifts the similarity onto the control points, with the fixes' offset as biases."""
    step, at = np.zeros(len(equations.normal.precision)), problem.estimate()
    fixes, control, errors = problem.fixes, problem.control, problem.errors
    if fixes is None or control is None:
        return step
    shift = -control.residuals(at).median(dim=0).values
    root = problem.similarity.root
    step[equations.similarity] = torch.linalg.solve(root, torch.cat([root.new_zeros(4), shift])).cpu().numpy()
    if errors.flights:
        residual = fixes.residuals(at) + shift
        flight = torch.zeros_like(fixes.camera) if fixes.flight is None else fixes.flight
        middle = torch.stack([residual[flight == index].median(dim=0).values for index in range(errors.flights)])
        biases = equations.constant.start + np.arange(3 * errors.flights)
        step[biases] = -middle.cpu().numpy().ravel()
    return step
