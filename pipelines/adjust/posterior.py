"""Linearised geographic half: its minimum, and the joint covariance of all unknowns.

Both come from the same normal equations (`adjust.normal_equations`). Their unknowns are the similarity's
coordinates y, the constant errors v, and the cameras' corrections z, whose prior of bundle adjustment is N(0, I).
The weights are those of Cauchy's kernel at the present state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.cameras import HeldCorrections
from pipelines.adjust.linearisation import Linearisation
from pipelines.adjust.normal_equations import (
    NormalEquations,
    Observations,
    Residuals,
    Weights,
    posterior_weights,
)
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.sparse_adjustment import minimise_sparse
from pipelines.adjust.sparse_linearisation import SparseLinearisation
from pipelines.adjust.sparse_observations import State
from pipelines.adjust.terms import ControlTerm
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import jacobian_at, second_moment_at

_STEPS = 20  # linearisations
_NEAR = 1e-4  # length of the step, in σ, that ends the descent
_CHUNK = 64
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

    def residuals(self) -> Residuals:
        """Return the whitened residuals (M, d) by kind."""
        return self.normal.residuals()

    def spread(self, weights: Weights, kind: str) -> FloatArray:
        """Return the covariances (M, d, d) that the unknowns cause in the whitened observations of a kind."""
        return self.normal.spread(weights, self.normal.observations[kind].jacobian)

    def covariance_of_known(self, weights: Weights) -> FloatArray:
        """Return the covariance (7 + p, 7 + p) of the similarity's coordinates y and the constant errors v."""
        known = 7 + self.errors
        return self.normal.inverse_times(weights, np.eye(len(self.normal.precision), known))[:known]


def linearised(problem: GeoProblem) -> Linearisation:
    """Return a problem about its present state, in the equations that it is solved with."""
    return equations_of(problem) if problem.bundle is None else SparseLinearisation(problem, problem.bundle)


def equations_of(problem: GeoProblem) -> GeoEquations:
    """Return the dense normal equations of a problem, linearised about its present state."""
    cameras, errors = problem.cameras, len(problem.errors)
    turns = 6 * len(cameras.center)

    def residuals(y: Tensor, v: Tensor, moved: Tensor) -> dict[str, Tensor]:
        return problem.whitened(problem.estimate_at(y, moved[:turns].view(-1, 6), moved[turns:], v))

    with torch.no_grad():
        basis = torch.cat([cameras.basis.flatten(0, 1), cameras.lens_basis])
        y, v, z = problem.similarity.y.detach(), problem.errors.vector(), cameras.z.detach()
        moved = torch.cat([cameras.corrections().flatten(), cameras.lens()])
        white = residuals(y, v, moved)
    by_z: dict[str, FloatArray] = {}
    by_x: dict[str, FloatArray] = {}
    if white and basis.shape[1]:
        slopes = torch.func.jacrev(residuals, argnums=(0, 1, 2), chunk_size=_CHUNK)(y, v, moved)
        for kind, (by_y, by_v, by_moved) in slopes.items():
            by_x[kind] = _numpy(torch.cat([by_y, by_v], dim=2))
            by_z[kind] = _numpy(by_moved @ basis)
    elif white:  # Derivatives by cameras that stay would take time and memory for all of them.
        forward = torch.func.jacfwd(lambda known: residuals(known[:7], known[7:], moved))(torch.cat([y, v]))
        by_x = {kind: _numpy(slope) for kind, slope in forward.items()}
        by_z = {kind: np.zeros((*slope.shape[:2], 0)) for kind, slope in by_x.items()}
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


def minimise(problem: GeoProblem) -> float:
    """Move a problem from its present state to the minimum of its whitened loss; return −2 ln likelihood there.

    A problem with the information of its bundle is solved in sparse equations (`adjust.sparse_adjustment`), others
    by Gauss–Newton in dense ones.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
        ConvergenceError: cameras still move after many steps of the sparse solver.
    """
    if problem.bundle is not None:
        sparse = minimise_sparse(problem, problem.bundle)
        place(problem, sparse.state)
        return sparse.cost
    for _ in range(_STEPS):
        equations = equations_of(problem)
        minimum = equations.normal.minimum()
        move(problem, equations, minimum.step)
        if np.linalg.norm(minimum.step) < _NEAR:
            break
    return minimum.cost


@torch.no_grad()
def place(problem: GeoProblem, state: State) -> None:
    """Set the state of a problem whose cameras no parameter moves."""
    problem.cameras.hold(HeldCorrections(state.correction, state.lens))
    problem.similarity.y.copy_(torch.from_numpy(state.similarity))
    problem.errors.set_vector(torch.from_numpy(state.errors).to(problem.errors.sigma.device))


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
    linear = linearised(problem)
    marginal = linear.covariance_of_known(posterior_weights(linear.residuals()))
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
