"""Root of the information of an adjustment: coordinates of its unknowns in which their χ² is a sum of squares.

About the solution ξ̂ all measurements cost χ²(ξ) = χ²(ξ̂) + (ξ − ξ̂)ᵀ N (ξ − ξ̂), with the normal matrix N of
cameras, lens and systematic errors. With N = L Lᵀ, the coordinates w = Lᵀ (ξ − ξ̂) have χ² = |w|², and a step of one
in any direction is one of one σ. L is that of the sparse factor: a camera depends on the coordinates of its own
front and of those above it, a path that grows with the root of the number of cameras.

Terms that depend on the mean of the SfM points (LiDAR, level, local frame) add a matrix of low rank to N. It
changes the coordinates in a few directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.system import NormalMatrix
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.bundle import similarity_modes
from pipelines.geometry.sparse_cholesky import Pivot, SparseCholesky

_LEAST = 1e-13  # information on a direction of the border over the largest, equilibrated: less counts as so much


@dataclass(frozen=True)
class InformationRoot:
    """Unknowns as functions of coordinates w (6 n + b,), all zero at the solution.

    Let v = w + turned (turned_by (turnedᵀ w)) = (v_x, v_b). Lens and systematic errors, the border, move by
    border v_b. The cameras move by L⁻ᵀ v_x − response (border v_b). Of this, `similarity` v is the mean similarity
    of the SfM points, which moves the similarity and not the cameras.
    """

    factor: SparseCholesky
    response: FloatArray  # (6 n, b)
    border: FloatArray  # (b, b)
    similarity: FloatArray  # (7, 6 n + b) mean similarity (ln s, rotation, shift) in `model`, about `pivot`
    modes: FloatArray  # (n, 6, 7) corrections that are a similarity of the whole
    pivot: FloatArray  # (3,) in `model`
    turned: FloatArray  # (6 n + b, m) orthonormal
    turned_by: FloatArray  # (m, m)

    @property
    def pivots(self) -> list[Pivot]:
        return self.factor.pivots

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return int(self.similarity.shape[1])

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        arrays = [array for pivot in self.pivots for array in vars(pivot).values()]
        arrays += [self.response, self.border, self.similarity, self.modes, self.turned, self.turned_by]
        return sum(int(array.nbytes) for array in arrays)


def information_root(
    normal: NormalMatrix, followed: FloatArray, lens: IntArray, errors: int, *, frozen_border: bool = False
) -> InformationRoot:
    """Return the root of a normal matrix.

    Args:
        followed: (7, 6 n + L) mean similarity of the SfM points by corrections of cameras and lens.
        lens: (ℓ,) lens parameters among the unknowns; they are the first of the border, `errors` (p) follow.
        frozen_border: lens and systematic errors are no unknowns (b = 0); else b = ℓ + p.

    Raises:
        DegenerateGeometryError: the matrix is singular.
    """
    count, n = len(lens) + errors, normal.poses.shape[0]
    by_poses, by_border = followed[:, :n], np.zeros((7, count))
    by_border[:, : len(lens)] = followed[:, n + lens]
    more = normal.corner[: count + 7, : count + 7].copy() if len(normal.corner) > count else None
    response = normal.factor.solve(np.ascontiguousarray(normal.border[:count].T)) if count else np.zeros((n, 0))
    border = _root_of_inverse(normal.corner[:count, :count] - normal.border[:count] @ response)
    if frozen_border:
        response, border, by_border = response[:, :0], border[:0, :0], by_border[:, :0]
        more = None if more is None else more[count:, count:]
    of_poses = normal.factor.whitened(by_poses.T).T
    similarity = np.hstack([of_poses, (by_border - by_poses @ response) @ border])
    turned, turned_by = np.zeros((similarity.shape[1], 0)), np.zeros((0, 0))
    if more is not None:
        b = len(border)
        more[:b, :b] = 0.0  # already in the coordinates
        turned, turned_by = _low_rank(np.vstack([np.hstack([np.zeros((b, n)), border]), similarity]), more)
    modes = similarity_modes(normal.position)
    pivot = normal.position.mean(axis=0)
    return InformationRoot(normal.factor, response, border, similarity, modes, pivot, turned, turned_by)


def _root_of_inverse(schur: FloatArray) -> FloatArray:
    """Return C (b, b) with C Cᵀ = S⁻¹ of a positive definite matrix S."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(schur), np.finfo(float).tiny))
    value, vector = np.linalg.eigh(schur * scale[:, None] * scale)
    return np.asarray(scale[:, None] * vector / np.sqrt(np.maximum(value, _LEAST * value.max(initial=0.0))))


def _low_rank(quantities: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Q (k, m) and D (m, m) such that v = w + Q D Qᵀ w has |v|² + (P v)ᵀ K (P v) = |w|².

    The quantities P (m, k) have the information K (m, m) beside what the coordinates say of them.
    """
    scale = 1.0 / np.maximum(np.linalg.norm(quantities, axis=1), np.finfo(float).tiny)
    basis, triangle = np.linalg.qr((scale[:, None] * quantities).T)
    among = triangle @ (information / scale[:, None] / scale) @ triangle.T
    value, vector = np.linalg.eigh((among + among.T) / 2)
    return basis, (vector * (np.maximum(1.0 + value, _LEAST) ** -0.5 - 1.0)) @ vector.T
