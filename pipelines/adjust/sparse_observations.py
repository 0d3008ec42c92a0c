"""Measurements as linear functions of many cameras: Jacobians with entries only at the cameras that take part.

The Jacobians come from forward differentiation. Cameras of one colour have no observation in common, so that one
derivative along the same coordinate of all of them gives the entries of each (Curtis, Powell and Reid 1974, doi
10.1093/imamat/13.1.117). The number of derivatives is six times that of the colours, whatever the number of
cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from pipelines.adjust.normal_equations import Residuals, Weights
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.terms import Term
from pipelines.core.types import FloatArray, IntArray

_CHUNK = 32  # directions that are differentiated together


@dataclass(frozen=True)
class State:
    """Values of all unknowns that the measurements depend on, or a gradient by them.

    Attributes:
        correction: (n, 6) corrections (δω, δc) of the cameras, rad and m in `model`.
        lens: (L,) change of the lens parameters; L = 0: the lens stays.
        similarity: (7,) coordinates y of `LearnableSimilarity`.
        errors: (p,) constant errors, m and rad.
    """

    correction: FloatArray
    lens: FloatArray
    similarity: FloatArray
    errors: FloatArray


@dataclass(frozen=True)
class SparseObservations:
    """M whitened observations of one kind near a state.

    Attributes:
        residual: (M, d) at the state.
        by_poses: (M d, 6 n) sparse derivative by the corrections of the cameras.
        by_parameters: (M d, 7 + p) derivative by the similarity's coordinates and the constant errors.
        by_lens: (M d, L) derivative by the lens parameters.
    """

    residual: FloatArray
    by_poses: csr_matrix
    by_parameters: FloatArray
    by_lens: FloatArray


def colours_of_cameras(problem: GeoProblem) -> IntArray:
    """Return colours (n,) from 0 on, which differ between cameras that affect a common observation."""
    count = len(problem.cameras.center)
    colour = np.zeros(count, dtype=np.int64)
    incidence = [_incidence(term, count) for term in problem.terms if term.measures]
    coupled = sum((part.T @ part for part in incidence), start=csr_matrix((count, count), dtype=np.int64))
    coupled = csr_matrix(coupled)
    for camera in np.flatnonzero(np.diff(coupled.indptr) > 1):
        others = coupled.indices[coupled.indptr[camera] : coupled.indptr[camera + 1]]
        taken = np.unique(colour[others[others < camera]])
        free = np.flatnonzero(taken != np.arange(len(taken)))
        colour[camera] = free[0] if len(free) else len(taken)
    return colour


def residuals_and_slope(
    problem: GeoProblem, state: State, weigh: Callable[[Residuals], Weights]
) -> tuple[Residuals, State]:
    """Return the whitened residuals at a state, and the gradient of half of their weighted squares by the state.

    One reverse differentiation gives the gradient; the weights are held.

    Args:
        problem: the measurements. The corrections of its cameras are not used.
        state: where the residuals are taken.
        weigh: gives the weights from the residuals.
    """
    residuals, at = _function_of_state(problem, state)
    values: dict[str, Tensor]
    values, pull_back = torch.func.vjp(residuals, *at)  # type: ignore[misc]
    residual = {kind: _numpy(rows) for kind, rows in values.items()}
    weights = weigh(residual)
    pulled = {
        kind: torch.from_numpy(weights[kind]).to(rows.device)[:, None] * rows for kind, rows in values.items()
    }
    return residual, State(*(_numpy(slope) for slope in pull_back(pulled)))


def observed(problem: GeoProblem, state: State, colours: IntArray) -> dict[str, SparseObservations]:
    """Return the measurements of a problem by kind, linearised about a state.

    Args:
        problem: the measurements. The corrections of its cameras are not used.
        state: where to linearise.
        colours: (n,) of `colours_of_cameras`.
    """
    residuals, at = _function_of_state(problem, state)
    device = at[0].device

    def along(part: int, directions: Tensor) -> dict[str, FloatArray]:
        def derivative(direction: Tensor) -> dict[str, Tensor]:
            slopes: dict[str, Tensor] = torch.func.jvp(
                lambda x: residuals(*at[:part], x, *at[part + 1 :]), (at[part],), (direction,)
            )[1]
            return slopes

        if not len(directions):
            return {kind: np.zeros((0, *rows.shape)) for kind, rows in residual.items()}
        slopes = torch.func.vmap(derivative, chunk_size=_CHUNK)(directions)
        return {kind: _numpy(slope) for kind, slope in slopes.items()}

    with torch.no_grad():
        residual = {kind: _numpy(rows) for kind, rows in residuals(*at).items()}
        chosen = torch.from_numpy(colours == np.arange(colours.max(initial=-1) + 1)[:, None]).to(device)
        six = torch.eye(6, dtype=torch.float64, device=device)
        by_colour = along(0, (chosen[:, None, :, None] * six[:, None, :]).flatten(0, 1))
        lens, y, v = (
            along(part, torch.eye(len(at[part]), dtype=torch.float64, device=device)) for part in (1, 2, 3)
        )
    return {
        term.kind: SparseObservations(
            residual[term.kind],
            _scattered(term, by_colour[term.kind], colours),
            _columns(np.concatenate([y[term.kind], v[term.kind]])),
            _columns(lens[term.kind]),
        )
        for term in problem.terms
        if term.measures
    }


def _function_of_state(
    problem: GeoProblem, state: State
) -> tuple[Callable[..., dict[str, Tensor]], tuple[Tensor, ...]]:
    """Return the residuals as a function of the four parts of a state, and these parts."""
    parts = state.correction, state.lens, state.similarity, state.errors
    device = problem.similarity.y.device

    def residuals(correction: Tensor, lens: Tensor, y: Tensor, v: Tensor) -> dict[str, Tensor]:
        return problem.whitened(problem.estimate_at(y, correction, lens, v))

    return residuals, tuple(torch.from_numpy(np.ascontiguousarray(part)).to(device) for part in parts)


def _scattered(term: Term, by_colour: FloatArray, colours: IntArray) -> csr_matrix:
    """Return the sparse Jacobian (M d, 6 n) from derivatives (6 C, M, d) by the coordinates of C colours."""
    row, camera = _pairs(term)
    slopes = by_colour.reshape(-1, 6, *by_colour.shape[1:])
    blocks = slopes[colours[camera], :, row]  # (E, 6, d)
    d = blocks.shape[2]
    rows = np.broadcast_to((d * row)[:, None, None] + np.arange(d), blocks.shape)
    columns = np.broadcast_to((6 * camera)[:, None, None] + np.arange(6)[:, None], blocks.shape)
    shape = (d * len(term), 6 * len(colours))
    return csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _columns(slopes: FloatArray) -> FloatArray:
    """Return derivatives (m, M, d) as columns (M d, m)."""
    return slopes.reshape(len(slopes), slopes.shape[1] * slopes.shape[2]).T


def _incidence(term: Term, cameras: int) -> csr_matrix:
    row, camera = _pairs(term)
    return csr_matrix((np.ones(len(row), dtype=np.int64), (row, camera)), shape=(len(term), cameras))


def _pairs(term: Term) -> tuple[IntArray, IntArray]:
    """Return the distinct pairs (E,), (E,) of an observation and a camera."""
    pairs = np.unique(torch.stack(term.incidence(), dim=1).cpu().numpy(), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _numpy(tensor: Tensor) -> FloatArray:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)
