"""Control points, each compared with the solution that does not use it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.normal_equations import posterior_weights, robust_weights
from pipelines.adjust.posterior import linearised
from pipelines.adjust.problem import GeoProblem
from pipelines.core.types import FloatArray

_OPEN = 1e-9  # redundancy below which the other observations leave a direction open


@dataclass(frozen=True)
class LeftOut:
    """J control points, each compared with the solution that does not use it.

    Attributes:
        error_in_geo: (J, 3) intersected minus surveyed, metres; NaN if the other observations leave it open.
        cov_in_geo: (J, 3, 3) m², expected covariance of that error: solution, marks and survey; NaN likewise.
    """

    error_in_geo: FloatArray
    cov_in_geo: FloatArray


def leave_one_out(problem: GeoProblem) -> LeftOut:
    """Return the error of each control point against the solution of all other observations, at a minimum.

    The computation is linear and needs no second solution. With the normal matrix N of all observations, a point
    with Jacobian A and weight w has the leverage H = w A N⁻¹ Aᵀ. Its residual without it is (I − H)⁻¹ r (Cook and
    Weisberg 1982, section 2.2). The weights of the other observations are held.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    control = problem.control
    if control is None:
        return LeftOut(np.empty((0, 3)), np.empty((0, 3, 3)))
    linear = linearised(problem)
    residuals = linear.residuals()
    white, weights, expected_weights = (
        residuals[control.kind],
        robust_weights(residuals),
        posterior_weights(residuals),
    )
    leverage = linear.spread(weights, control.kind) * weights[control.kind][:, None, None]
    spread = linear.spread(expected_weights, control.kind)
    expected = spread * expected_weights[control.kind][:, None, None]
    error, cov = np.full((len(white), 3), np.nan), np.full((len(white), 3, 3), np.nan)
    free = np.eye(3) - leverage
    known = np.linalg.eigvalsh(free)[:, 0] > _OPEN
    unwhiten = np.linalg.inv(control.root_information.cpu().numpy()[known])
    error[known] = (unwhiten @ np.linalg.solve(free[known], white[known][..., None]))[..., 0]
    others = np.linalg.solve(np.eye(3) - expected[known], spread[known])
    cov[known] = unwhiten @ (np.eye(3) + (others + np.swapaxes(others, 1, 2)) / 2) @ np.swapaxes(unwhiten, 1, 2)
    return LeftOut(error, cov)
