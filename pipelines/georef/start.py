"""Where the constant errors start, in which unit they are learned, and whether there is reason to have them."""

from __future__ import annotations

import torch
from torch import Tensor

from pipelines.georef.adjustment import OUTLIER_GATE
from pipelines.georef.linear import Linearised, Solution, posterior, solve
from pipelines.georef.losses import control_residuals, fix_residuals
from pipelines.georef.problem import GeoProblem

# What the bias of a flight must save in −2 ln likelihood: as much as the initial similarity asks of it.
_BIAS_COST = OUTLIER_GATE - 1.0
# The similarity turns, and so may a boresight: as many linearisations are enough from 20°.
_ROUNDS, _NEAR = 4, 0.1  # or until a step is a tenth of a σ


def begin(problem: GeoProblem) -> float:
    """Start the problem's constant errors at their least-squares values, and learn them in units of their σ then.

    The errors and the similarity are adjusted to all measurements, with Cauchy's weights, twice: from where the
    similarity is, and from the control points, with the fixes' offset taken for their bias. The better one counts.

    Returns:
        What the errors save in −2 ln likelihood against having none.
    """
    y, errors = problem.similarity.y, problem.errors
    before = y.detach().clone()
    for _ in range(_ROUNDS):
        model = problem.linearised()
        best = _best(problem, model, with_errors=True)
        covariance = posterior(model, best.white)
        moved = best.x - model.x
        errors.begin(best.x[7:].numpy(), torch.linalg.cholesky(covariance[7:, 7:]).numpy())
        with torch.no_grad():
            y.copy_(best.x[:7])
        if float((moved @ torch.linalg.solve(covariance, moved)).sqrt()) < _NEAR:
            break
    without = _best(problem, model, with_errors=False)
    with torch.no_grad():
        y.copy_(before)
    return without.cost - best.cost


def bias_pays(problem: GeoProblem, saved: float) -> bool:
    """Whether biases that save so much of −2 ln likelihood are to be believed.

    A bias that is not there costs accuracy, since the fixes then say nothing of the position: with RTK and a few
    control points, twice the σ and more. So it has to be evident, as for the initial similarity.
    """
    return saved > _BIAS_COST * problem.errors.flights


def _best(problem: GeoProblem, model: Linearised, with_errors: bool) -> Solution:
    free = torch.ones(len(model.x), dtype=torch.bool)
    free[7:] = with_errors
    starts = (model.x, _from_control(problem, model.x, with_errors))
    return min((solve(model, start, free) for start in starts), key=lambda solution: solution.cost)


@torch.no_grad()
def _from_control(problem: GeoProblem, x: Tensor, with_errors: bool) -> Tensor:
    """x (7 + p,) with the similarity moved onto the control points, and the biases taken from the fixes there."""
    start, at = x.clone(), problem.estimate()
    fixes, marks = problem.measured.fixes, problem.measured.marks
    if fixes is None or marks is None:
        return start
    shift = -control_residuals(at, marks).median(dim=0).values
    root = problem.similarity.root
    start[:7] += torch.linalg.solve(root, torch.cat([root.new_zeros(4), shift])).cpu()
    if with_errors and problem.errors.flights:
        missed = fix_residuals(at, fixes) + shift
        flight = torch.zeros_like(fixes.camera) if fixes.flight is None else fixes.flight
        for index in range(problem.errors.flights):
            middle = missed[flight == index].median(dim=0).values
            start[7 + 3 * index : 10 + 3 * index] -= middle.cpu()
    return start
