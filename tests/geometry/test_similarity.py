"""Uncertainty of a similarity beyond first order."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import jacobian_at, second_moment_at


def test_second_moment_is_that_of_drawn_similarities() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7)) * np.array([0.01, *[0.02] * 3, *[0.5] * 3])[:, None]
    pivot = np.array([30.0, -20.0, 5.0])
    points = pivot + rng.normal(size=(3, 3)) * 40
    drawn = rng.normal(size=(20_000, 7)) @ root.T
    moved = np.einsum("d,dij,nj->dni", np.exp(drawn[:, 0]), exp_so3(drawn[:, 1:4]), points - pivot)
    moved = moved + drawn[:, None, 4:] + pivot
    beyond = (moved - points - np.einsum("nij,dj->dni", jacobian_at(points, pivot), drawn)).reshape(len(drawn), -1)
    expected = second_moment_at(points, root @ root.T, pivot)
    # Fourth moments of 20 000 draws are known to some per cent, and third-order errors are a twentieth.
    np.testing.assert_allclose(beyond.T @ beyond / len(drawn), expected, atol=0.08 * expected.max())
