"""Crossings of cells by beams of known course."""

from __future__ import annotations

import numpy as np

from pipelines.surface.crossings import count_beams


def test_upright_beams_cross_the_cells_above_their_ends() -> None:
    end = np.array([[0.5, 0.5, 0.5], [0.6, 0.4, 2.5], [2.5, 2.5, 3.9]])
    count = count_beams(end, end + np.array([0.0, 0.0, 30.0]), np.zeros(3), 1.0, np.array([3, 3, 5]))
    np.testing.assert_array_equal(count[0, 0], [1, 1, 2, 2, 2])
    np.testing.assert_array_equal(count[2, 2], [0, 0, 0, 1, 1])
    assert count.sum() == 10


def test_slanted_beams_cross_the_cells_of_their_samples() -> None:
    rng = np.random.default_rng(0)
    end, start = rng.uniform(0, 8, (40, 3)), rng.uniform((-20, -20, 20), (20, 20, 60), (40, 3))
    shape = np.array([8, 8, 8])
    expected = np.zeros(shape)
    for a, b in zip(end, start, strict=True):
        path = a + np.linspace(0, 1, 4001)[:, None] * (b - a)
        cells = np.unique(np.floor(path[(path >= 0).all(axis=1) & (path < 8).all(axis=1)]).astype(int), axis=0)
        expected[tuple(cells.T)] += 1
    count = count_beams(end, start, np.zeros(3), 1.0, shape)
    assert (count <= expected).all()
    # Samples a quarter of a cell apart miss only cells of which a beam cuts a corner.
    assert count.sum() > 0.85 * expected.sum()


def test_no_more_than_255_beams_are_counted() -> None:
    end = np.full((300, 3), 0.5)
    assert count_beams(end, end + np.array([0.0, 0.0, 9.0]), np.zeros(3), 1.0, np.array([1, 1, 1])).item() == 255
