"""What the measurements say of similarity and cameras together: their minimum, joint covariance, and leave-one-out.

All from the Gauss–Newton normal matrix of the whitened residuals of `GeoProblem.forward`, over all its parameters,
constant errors among them, with the weights that the Cauchy kernel gives at the state at hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import block_diag, cho_factor, cho_solve
from torch import Tensor

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import jacobian_at
from pipelines.georef.linear import WEIGHT_OF_NOISE
from pipelines.georef.losses import CAUCHY_SCALE2
from pipelines.georef.problem import GeoProblem
from pipelines.robust.kernels import cauchy_weight

_SIMILARITY, _CAMERAS, _ERRORS = "similarity.y", "cameras.z", "errors.x"
_STEPS = 10  # new derivatives
_ROUNDS = 20  # new weights with the same derivatives
_TOLERANCE = 1e-4  # of a σ
_OPEN = 1e-9  # redundancy below which the other observations leave a direction open


@dataclass(frozen=True)
class _Linear:
    """The problem near its present state, in P parameters, R residuals of three components."""

    jacobian: FloatArray  # (3 R, P), whitened
    prior: FloatArray  # (P, P) information
    place: dict[str, slice]

    def factor(self, weight: FloatArray) -> tuple[FloatArray, bool]:
        """Cholesky factor of the normal matrix with weights (R,)."""
        weighted = self.jacobian * np.repeat(weight, 3)[:, None]
        try:
            factor: tuple[FloatArray, bool] = cho_factor(weighted.T @ self.jacobian + self.prior)
        except np.linalg.LinAlgError as error:
            raise DegenerateGeometryError(
                "fixes and control points leave the similarity open: add control points, at least 3"
            ) from error
        return factor


@dataclass(frozen=True)
class LensDoubt:
    """What is not known of the L parameters of the lens when it has followed the cameras.

    Attributes:
        cov: (L, L), `CorrectionBasis.lens_cov`.
        by_control: (J, 3, L) metres by which each control point in geo is found elsewhere with another lens.
    """

    cov: FloatArray
    by_control: FloatArray


@dataclass(frozen=True)
class Posterior:
    """Joint covariance of the errors of the similarity, of k camera corrections, and of the lens beyond these.

    Attributes:
        covariance: (7 + k + L, 7 + k + L) of (δ ln s, δω, δt) about `pivot`, as in `SimilarityRecord`, of
            `CameraCorrections.z`, and of what the lens parameters differ by from those that follow z; whatever else
            was estimated is marginalised out.
        pivot: (3,) in geo.
    """

    covariance: FloatArray
    pivot: FloatArray

    def at(self, point_in_geo: FloatArray, by_cameras: FloatArray, by_lens: FloatArray) -> FloatArray:
        """Covariance (J, 3, 3) in m² of points (J, 3).

        Args:
            point_in_geo: (J, 3).
            by_cameras: (J, 3, k) metres in geo by which they follow the corrections, and the lens that goes with
                these.
            by_lens: (J, 3, L) likewise the rest of the lens.
        """
        jacobian = np.concatenate([jacobian_at(point_in_geo, self.pivot), by_cameras, by_lens], axis=2)
        return np.asarray(jacobian @ self.covariance @ np.swapaxes(jacobian, 1, 2))


@dataclass(frozen=True)
class LeftOut:
    """J control points, each measured by a solution that does not know it.

    Attributes:
        error_in_geo: (J, 3) found by camera minus surveyed, metres; NaN where the others leave it open.
        cov_in_geo: (J, 3, 3) m² that is expected of it: solution, marks and survey; NaN likewise.
    """

    error_in_geo: FloatArray
    cov_in_geo: FloatArray


def minimise(problem: GeoProblem) -> None:
    """Bring the whitened loss of the geographic half to its minimum, from where it is.

    Iteratively reweighted Gauss–Newton. Near the solution the problem is almost linear: the derivatives are
    renewed only when the weights have settled.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    for _ in range(_STEPS):
        linear, moved = _linearised(problem), 0.0
        for _ in range(_ROUNDS):
            white = _white(problem)
            factor = linear.factor(_weights(white))
            pull = linear.jacobian.T @ (white * _weights(white)[:, None]).ravel() + _prior_pull(problem)
            step = -cho_solve(factor, pull)
            _move(problem, linear, step)
            moved = max(moved, float(np.linalg.norm(step)))
            if np.linalg.norm(step) < _TOLERANCE:
                break
        if moved < 100 * _TOLERANCE:  # what a change of the derivatives by so small a step does is nothing
            return


def posterior(problem: GeoProblem, lens: LensDoubt | None = None) -> Posterior:
    """The joint covariance at the present state.

    Of the lens, only what follows the cameras is estimated here. The rest d, which is independent of the estimate's
    own error e₁, shifts the intersections of the control points, and so pulls the estimate by −G d, with G the
    response to the control points: e = e₁ − G d.

    Args:
        lens: None where there is no such rest.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    linear, white = _linearised(problem), _white(problem)
    weight = _weights(white) / WEIGHT_OF_NOISE
    factor = linear.factor(weight)
    covariance = cho_solve(factor, np.eye(len(linear.prior)))
    similarity, cameras = linear.place[_SIMILARITY], linear.place[_CAMERAS]
    kept = np.r_[similarity, cameras]
    of_lens = np.zeros((0, 0)) if lens is None else lens.cov
    shared = np.zeros((len(covariance), len(of_lens)))
    if lens is not None and problem.marks is not None:
        rows = _control_rows(problem)
        root = problem.marks.root_information.cpu().numpy()
        moved = (weight[rows, None, None] * (root @ lens.by_control)).reshape(-1, len(of_lens))
        pulled = cho_solve(
            factor, linear.jacobian.reshape(len(white), 3, -1)[rows].reshape(len(moved), -1).T @ moved
        )
        shared = -pulled @ of_lens
        covariance = covariance - shared @ pulled.T
    joint = np.block([[covariance[np.ix_(kept, kept)], shared[kept]], [shared[kept].T, of_lens]])
    unit = np.eye(len(joint))
    unit[:7, :7] = problem.similarity.root.cpu().numpy()
    return Posterior(unit @ joint @ unit.T, problem.similarity.pivot_in_geo)


def leave_one_out(problem: GeoProblem) -> LeftOut:
    """Each control point against the solution of all other observations, at a minimum of the problem.

    Linear and without a second solution: of the normal matrix N of all observations, a point with Jacobian A and
    weight w has the leverage H = w A N⁻¹ Aᵀ, and its residual without it is (I − H)⁻¹ r (Cook and Weisberg 1982,
    section 2.2). The weights of the others are held.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    if problem.marks is None:
        return LeftOut(np.empty((0, 3)), np.empty((0, 3, 3)))
    linear, white = _linearised(problem), _white(problem)
    weight, rows = _weights(white), _control_rows(problem)
    jacobian = linear.jacobian.reshape(len(white), 3, -1)[rows]
    leverage = _spread(linear, weight, jacobian) * weight[rows, None, None]
    spread = _spread(linear, weight / WEIGHT_OF_NOISE, jacobian)
    expected = spread * weight[rows, None, None] / WEIGHT_OF_NOISE
    count = len(jacobian)
    error, cov = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    free = np.eye(3) - leverage
    known = np.linalg.eigvalsh(free)[:, 0] > _OPEN
    unwhiten = np.linalg.inv(problem.marks.root_information.cpu().numpy()[known])
    error[known] = (unwhiten @ np.linalg.solve(free[known], white[rows][known][..., None]))[..., 0]
    others = np.linalg.solve(np.eye(3) - expected[known], spread[known])
    cov[known] = unwhiten @ (np.eye(3) + (others + np.swapaxes(others, 1, 2)) / 2) @ np.swapaxes(unwhiten, 1, 2)
    return LeftOut(error, cov)


def _spread(linear: _Linear, weight: FloatArray, jacobian: FloatArray) -> FloatArray:
    """A N⁻¹ Aᵀ (J, 3, 3) of Jacobians (J, 3, P), N with weights (R,)."""
    flat = jacobian.reshape(-1, jacobian.shape[2])
    solved = cho_solve(linear.factor(weight), flat.T).T.reshape(jacobian.shape)
    return np.asarray(solved @ np.swapaxes(jacobian, 1, 2))


def _control_rows(problem: GeoProblem) -> slice:
    assert problem.marks is not None
    first = 0 if problem.fixes is None else len(problem.fixes.camera)
    return slice(first, first + len(problem.marks.position_in_geo))


def _parameters(problem: GeoProblem) -> dict[str, torch.nn.Parameter]:
    """What is estimated: the learned weights of the terms stay as they are."""
    return {name: problem.get_parameter(name) for name in (_SIMILARITY, _CAMERAS, _ERRORS)}


def _linearised(problem: GeoProblem) -> _Linear:
    state = {name: parameter.detach() for name, parameter in _parameters(problem).items()}
    sizes = [len(value) for value in state.values()]
    ends = np.cumsum(sizes)
    place = {name: slice(end - size, end) for name, end, size in zip(state, ends, sizes, strict=True)}
    if problem.fixes is None and problem.marks is None:
        return _Linear(np.empty((0, int(ends[-1]))), _prior_information(problem), place)

    def residuals(state: dict[str, Tensor]) -> Tensor:
        found: Tensor = torch.func.functional_call(problem, state, ())
        return found

    derivatives = torch.func.jacrev(residuals, chunk_size=64)(state)
    jacobian = torch.cat([derivatives[name] for name in state], dim=2).flatten(0, 1)
    return _Linear(jacobian.cpu().numpy(), _prior_information(problem), place)


def _prior_information(problem: GeoProblem) -> FloatArray:
    """Half the second derivative (P, P) of what is known beforehand."""
    errors = problem.errors
    root = (errors.unit / errors.sigma[:, None]).cpu().numpy()
    held = float(problem.hold_prior) * problem.similarity.held.cpu().numpy()
    return np.asarray(block_diag(np.diag(held), np.eye(len(problem.cameras.z)), root.T @ root))


def _prior_pull(problem: GeoProblem) -> FloatArray:
    """Half its first derivative (P,) at the present state."""
    errors, similarity = problem.errors, problem.similarity
    with torch.no_grad():
        held = float(problem.hold_prior) * similarity.held * similarity.y
        known = errors.unit.T @ (errors.vector() / errors.sigma**2)
        return np.asarray(torch.cat([held, problem.cameras.z, known]).cpu().numpy())


def _white(problem: GeoProblem) -> FloatArray:
    """Whitened residuals (R, 3)."""
    if problem.fixes is None and problem.marks is None:
        return np.empty((0, 3))
    with torch.no_grad():
        return np.asarray(problem().cpu().numpy())


def _weights(white: FloatArray) -> FloatArray:
    return cauchy_weight((white**2).sum(axis=1), CAUCHY_SCALE2**0.5)


def _move(problem: GeoProblem, linear: _Linear, step: FloatArray) -> None:
    with torch.no_grad():
        for name, parameter in _parameters(problem).items():
            parameter.add_(torch.from_numpy(step[linear.place[name]]).to(parameter.device))
