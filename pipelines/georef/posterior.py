"""Linearised geographic half: its minimum, the joint covariance of all unknowns, and leave-one-out.

All three come from the same normal equations (`georef.normal_equations`). Their unknowns are the similarity's
coordinates y, the constant errors v, and the cameras' corrections z, whose prior of bundle adjustment is N(0, I).
The weights are those of Cauchy's kernel at the present state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import jacobian_at, second_moment_at
from pipelines.georef.normal_equations import (
    NormalEquations,
    Observations,
    Weights,
    posterior_weights,
    robust_weights,
)
from pipelines.georef.problem import GeoProblem
from pipelines.georef.terms import ControlTerm

_STEPS = 20  # linearisations
_NEAR = 1e-4  # length of the step, in σ, that ends the descent
_CHUNK = 64
_OPEN = 1e-9  # redundancy below which the other observations leave a direction open
_ADVICE = "fixes and control points leave the similarity open: add control points, at least 3"


@dataclass(frozen=True)
class GeoEquations:
    """Normal equations of a problem about its present state, in the parameters (y, v, w), float64.

    w are coordinates of the camera corrections that affect a measurement: z = `seen` w. All other corrections keep
    their prior of bundle adjustment, and are not among the unknowns.

    Attributes:
        normal: the equations, of P = 7 + p + r parameters.
        errors: p, number of constant errors.
        seen: (k, r), orthonormal columns; None: all k corrections.
    """

    normal: NormalEquations
    errors: int
    seen: FloatArray | None

    @property
    def similarity(self) -> slice:
        """Columns of y."""
        return slice(0, 7)

    @property
    def constant(self) -> slice:
        """Columns of v."""
        return slice(7, 7 + self.errors)

    @property
    def cameras(self) -> slice:
        """Columns of w."""
        return slice(7 + self.errors, len(self.normal.precision))


def equations_of(problem: GeoProblem) -> GeoEquations:
    """Return the normal equations of a problem, linearised about its present state."""
    cameras, errors = problem.cameras, len(problem.errors)
    turns = 6 * len(cameras.center)

    def residuals(y: Tensor, moved: Tensor, v: Tensor) -> dict[str, Tensor]:
        return problem.whitened(problem.estimate_at(y, moved[:turns].view(-1, 6), moved[turns:], v))

    with torch.no_grad():
        basis = torch.cat([cameras.basis.flatten(0, 1), cameras.lens_basis])
        y, v, z = problem.similarity.y.detach(), problem.errors.vector(), cameras.z.detach()
        moved = torch.cat([cameras.corrections().flatten(), cameras.lens()])
        white = residuals(y, moved, v)
    by_z, by_x = {}, {}
    if white:
        slopes = torch.func.jacrev(residuals, argnums=(0, 1, 2), chunk_size=_CHUNK)(y, moved, v)
        for kind, (by_y, by_moved, by_v) in slopes.items():
            by_x[kind] = _numpy(torch.cat([by_y, by_v], dim=2))
            by_z[kind] = _numpy(by_moved @ basis)
    seen = _seen(list(by_z.values()), basis.shape[1])
    observations = {
        kind: Observations(
            _numpy(white[kind]),
            np.concatenate([by_x[kind], by_z[kind] if seen is None else by_z[kind] @ seen], axis=2),
        )
        for kind in white
    }
    held = float(problem.hold_prior) * _numpy(problem.similarity.held)
    corrections = _numpy(z) if seen is None else seen.T @ _numpy(z)
    precision = np.concatenate([held, _numpy(problem.errors.sigma) ** -2, np.ones(len(corrections))])
    offset = np.concatenate([_numpy(y), _numpy(v), corrections])
    return GeoEquations(NormalEquations(observations, precision, offset, advice=_ADVICE), errors, seen)


def minimise(problem: GeoProblem) -> None:
    """Move a problem to the minimum of its whitened loss by Gauss–Newton, from its present state.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    for _ in range(_STEPS):
        equations = equations_of(problem)
        step = equations.normal.minimum().step
        move(problem, equations, step)
        if np.linalg.norm(step) < _NEAR:
            return


@torch.no_grad()
def move(problem: GeoProblem, equations: GeoEquations, step: FloatArray) -> None:
    """Move the state of a problem by a step (P,) of its equations."""
    device = problem.similarity.y.device
    z = problem.cameras.z
    corrections = _numpy(z) if equations.seen is None else equations.seen.T @ _numpy(z)
    corrections = corrections + step[equations.cameras]
    # Corrections that affect no measurement return to zero, the mean of their prior.
    z.copy_(torch.from_numpy(corrections if equations.seen is None else equations.seen @ corrections))
    problem.similarity.y.add_(torch.from_numpy(step[equations.similarity]).to(device))
    problem.errors.set_vector(problem.errors.vector() + torch.from_numpy(step[equations.constant]).to(device))


def solution_covariances(problem: GeoProblem) -> tuple[FloatArray, FloatArray]:
    """Return the covariances of the similarity (7, 7) about its pivot, and of the constant errors (p, p).

    All other unknowns are marginalised out. The first covariance has the form of
    `geometry.similarity.SimilarityRecord`, the second is in m and rad.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    equations = equations_of(problem)
    normal, known = equations.normal, 7 + equations.errors
    columns = np.eye(len(normal.precision), known)
    marginal = normal.inverse_times(posterior_weights(normal.residuals()), columns)[:known]
    root = _numpy(problem.similarity.root)
    return root @ marginal[:7, :7] @ root.T, marginal[7:, 7:]


@dataclass(frozen=True)
class FreeLens:
    """Part of the L lens parameters that stays unknown after the lens has followed the cameras.

    Attributes:
        cov: (L, L), `CorrectionBasis.lens_cov`.
        by_control: (J, 3, L) derivative of the intersected control points in geo by the lens parameters, metres.
    """

    cov: FloatArray
    by_control: FloatArray


@dataclass(frozen=True)
class Posterior:
    """Joint covariance of the similarity, of k camera corrections, and of the rest of the L lens parameters.

    Attributes:
        covariance: (7 + k + L, 7 + k + L) of (δ ln s, δω, δt) about `pivot`, as in `SimilarityRecord`; of
            `CameraCorrections.z`; and of the lens parameters beyond the part that follows z. All other unknowns
            are marginalised out.
        pivot: (3,) in geo.
    """

    covariance: FloatArray
    pivot: FloatArray

    def at(self, point_in_geo: FloatArray, by_cameras: FloatArray, by_lens: FloatArray) -> FloatArray:
        """Return the covariance (J, 3, 3) in m² of points (J, 3).

        Args:
            point_in_geo: (J, 3) metres.
            by_cameras: (J, 3, k) derivative of the points in geo by the corrections z, and the lens that follows
                z.
            by_lens: (J, 3, L) derivative of the points in geo by the rest of the lens.
        """
        jacobian = self._jacobian(point_in_geo, by_cameras, by_lens)
        return np.asarray(jacobian @ self.covariance @ np.swapaxes(jacobian, 1, 2))

    def jointly_at(self, point_in_geo: FloatArray, by_cameras: FloatArray, by_lens: FloatArray) -> FloatArray:
        """Return the joint covariance (3 J, 3 J) in m² of points (J, 3); the arguments are those of `at`.

        The second-order error of the similarity is included. Relative positions are known far better than the
        similarity, so that the square of a rotation can exceed their σ.
        """
        jacobian = np.concatenate(self._jacobian(point_in_geo, by_cameras, by_lens))
        of_similarity = second_moment_at(point_in_geo, self.covariance[:7, :7], self.pivot)
        return np.asarray(jacobian @ self.covariance @ jacobian.T) + of_similarity

    def _jacobian(self, point_in_geo: FloatArray, by_cameras: FloatArray, by_lens: FloatArray) -> FloatArray:
        return np.concatenate([jacobian_at(point_in_geo, self.pivot), by_cameras, by_lens], axis=2)


def posterior(problem: GeoProblem, lens: FreeLens | None = None) -> Posterior:
    """Return the joint covariance of all unknowns at the present state.

    1. Only the part of the lens that follows the cameras is estimated.
    2. The rest d is independent of the estimate's own error e₁.
    3. d shifts the intersections of the control points. With G the response of the estimate to the control points,
       d therefore moves the estimate by −G d: the total error is e = e₁ − G d.

    Args:
        problem: at its minimum.
        lens: the rest of the lens; None: there is no rest.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    equations = equations_of(problem)
    normal = equations.normal
    weights = posterior_weights(normal.residuals())
    covariance = normal.covariance(weights)
    cov_lens = np.zeros((0, 0)) if lens is None else lens.cov
    shared = np.zeros((len(covariance), len(cov_lens)))
    if lens is not None and problem.control is not None:
        pulled = _pull_of_lens(problem.control, lens, normal, weights)
        shared = -pulled @ cov_lens
        covariance = covariance - shared @ pulled.T
    turn = _joint_from_parameters(problem, equations)
    of_all, with_lens = turn @ covariance @ turn.T, turn @ shared
    if equations.seen is not None:  # corrections that no measurement sees keep the σ = 1 of bundle adjustment
        of_all[7:, 7:] += np.eye(len(equations.seen)) - equations.seen @ equations.seen.T
    joint = np.block([[of_all, with_lens], [with_lens.T, cov_lens]])
    return Posterior(joint, problem.similarity.pivot_in_geo)


def _pull_of_lens(control: ControlTerm, lens: FreeLens, normal: NormalEquations, weights: Weights) -> FloatArray:
    """Return G (P, L): the response of the parameters to intersections with another lens."""
    moved = weights[control.kind][:, None, None] * (_numpy(control.root_information) @ lens.by_control)
    jacobian = normal.observations[control.kind].jacobian
    return normal.inverse_times(weights, np.einsum("jdp,jdl->pl", jacobian, moved))


def _joint_from_parameters(problem: GeoProblem, equations: GeoEquations) -> FloatArray:
    """Return the derivative (7 + k, P) of similarity and corrections z by the parameters (y, v, w)."""
    count = len(equations.normal.precision)
    corrections = np.eye(count - 7 - equations.errors) if equations.seen is None else equations.seen
    turn = np.zeros((7 + len(corrections), count))
    turn[:7, equations.similarity] = _numpy(problem.similarity.root)
    turn[7:, equations.cameras] = corrections
    return turn


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
    normal = equations_of(problem).normal
    residuals = normal.residuals()
    points, white = normal.observations[control.kind], residuals[control.kind]
    weights, expected_weights = robust_weights(residuals), posterior_weights(residuals)
    leverage = normal.spread(weights, points.jacobian) * weights[control.kind][:, None, None]
    spread = normal.spread(expected_weights, points.jacobian)
    expected = spread * expected_weights[control.kind][:, None, None]
    error, cov = np.full((len(white), 3), np.nan), np.full((len(white), 3, 3), np.nan)
    free = np.eye(3) - leverage
    known = np.linalg.eigvalsh(free)[:, 0] > _OPEN
    unwhiten = np.linalg.inv(_numpy(control.root_information)[known])
    error[known] = (unwhiten @ np.linalg.solve(free[known], white[known][..., None]))[..., 0]
    others = np.linalg.solve(np.eye(3) - expected[known], spread[known])
    cov[known] = unwhiten @ (np.eye(3) + (others + np.swapaxes(others, 1, 2)) / 2) @ np.swapaxes(unwhiten, 1, 2)
    return LeftOut(error, cov)


def _seen(by_z: list[FloatArray], count: int) -> FloatArray | None:
    """Return orthonormal directions (k, r) of the corrections that change the residuals.

    None: there are at least as many residuals as corrections, and the directions would save nothing.
    """
    if sum(rows.shape[0] * rows.shape[1] for rows in by_z) >= count:
        return None
    stacked = np.concatenate([np.zeros((0, count)), *(rows.reshape(-1, count) for rows in by_z)])
    return np.asarray(np.linalg.qr(stacked.T)[0])


def _numpy(tensor: Tensor) -> FloatArray:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)
