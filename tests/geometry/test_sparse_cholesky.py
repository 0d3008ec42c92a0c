"""Nested dissection against the dense inverse, on random couplings of places."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import bsr_matrix, csc_matrix

from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.sparse_cholesky import SparseCholesky
from tests.refusals import refused

WIDTH = 3


def coupled(position: np.ndarray, reach: float, extra: int, rng: np.random.Generator) -> bsr_matrix:
    """Return a positive definite matrix that couples places within a distance, and `extra` other pairs."""
    count = len(position)
    near = np.linalg.norm(position[:, None] - position, axis=2) < reach
    first, second = rng.integers(count, size=(2, extra))
    near[first, second] = near[second, first] = True
    np.fill_diagonal(near, True)
    factor = rng.normal(size=(count, WIDTH, count, WIDTH)) * near[:, None, :, None]
    dense = factor.reshape(count * WIDTH, -1)
    dense = dense + dense.T
    return bsr_matrix(
        dense + (np.abs(dense).sum(axis=1).max() + 1.0) * np.eye(len(dense)), blocksize=(WIDTH, WIDTH)
    )


@settings(max_examples=8, deadline=None)
@given(
    count=st.integers(1, 80),
    reach=st.floats(0.0, 0.4),
    extra=st.integers(0, 30),
    stretch=st.sampled_from([1.0, 0.0]),  # along a line, too
    seed=st.integers(0, 2**16),
)
def test_parts_of_the_inverse_are_those_of_the_dense_inverse(
    count: int, reach: float, extra: int, stretch: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    position = rng.random((count, 3)) * [1.0, stretch, 0.0]
    matrix = coupled(position, reach, extra, rng)
    inverse = np.linalg.inv(matrix.toarray())
    factor, scale = SparseCholesky(matrix, position), np.abs(inverse).max()
    right = rng.normal(size=(count * WIDTH, 4)) * (rng.random((count * WIDTH, 1)) < 0.2)
    # The matrices are well conditioned: rounding leaves 1e-13 of the largest entry.
    exact = {"rtol": 0, "atol": 1e-11 * scale}
    np.testing.assert_allclose(factor.solve(right), inverse @ right, **exact)
    np.testing.assert_allclose(factor.inverse_form(csc_matrix(right)), right.T @ inverse @ right, atol=1e-9 * scale)
    blocks = inverse.reshape(count, WIDTH, count, WIDTH)[np.arange(count), :, np.arange(count)]
    np.testing.assert_allclose(factor.inverse_diagonal, blocks, **exact)
    root = factor.coloured(np.eye(count * WIDTH))
    np.testing.assert_allclose(root @ root.T, inverse, **exact)


def test_factor_of_a_plane_grows_little_faster_than_its_places() -> None:
    def entries(side: int) -> int:
        position = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2).astype(float)
        factor = SparseCholesky(coupled(position, 1.5, 0, np.random.default_rng(0)), position)
        return sum(pivot.diagonal.size + pivot.below.size for pivot in factor.pivots)

    # O(n log n): 4 times the places take 4 · log 576 / log 144 = 5 times the memory, the dense factor 16 times.
    assert entries(24) < 6.5 * entries(12)


def test_indefinite_matrix_is_refused() -> None:
    matrix = bsr_matrix(np.diag([1.0, 1.0, -1.0]), blocksize=(3, 3))
    with refused("network-undetermined", DegenerateGeometryError):
        SparseCholesky(matrix, np.zeros((1, 3)))
