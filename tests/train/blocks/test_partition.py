"""Cells of a survey: they share the plane out, and their loads are as equal as the points allow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.survey.block_plan import BlockCell
from pipelines.train.blocks.plan import cells_of_number, cells_that_fit

# Many equal coordinates: cuts then run through points.
COORDINATES = st.integers(-4, 4).map(float) | st.floats(-1e3, 1e3, width=32)


@settings(max_examples=60, deadline=None)
@given(
    points=arrays.arrays(np.float64, st.tuples(st.integers(12, 60), st.just(2)), elements=COORDINATES),
    count=st.integers(1, 7),
    seed=st.integers(0, 99),
)
def test_each_place_is_in_exactly_one_cell(points: FloatArray, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    try:
        cells = cells_of_number(points, rng.uniform(0.1, 1.0, len(points)), count)
    except DegenerateGeometryError:
        assert len(np.unique(points, axis=0)) < 60  # points at few places only
        return
    assert len(cells) == count
    cuts = [value for cell in cells for bound in (cell.low, cell.high) for value in bound if value is not None]
    corners = rng.choice(cuts, (40, 2)) if cuts else np.zeros((1, 2))
    places = np.concatenate([points, corners, rng.uniform(-2e3, 2e3, (40, 2))])
    inside = np.array([cell.contains(places) for cell in cells])
    np.testing.assert_array_equal(inside.sum(axis=0), 1)
    assert all(cell.contains(points).any() for cell in cells)


@pytest.mark.parametrize("count", [2, 3, 4, 6, 16])
def test_loads_are_equal(count: int) -> None:
    rng = np.random.default_rng(0)
    # A dense village in the corner of wide fields.
    points = np.concatenate([rng.normal([200, 300], 40, (6000, 2)), rng.uniform(-1000, 1000, (6000, 2))])
    load = rng.uniform(0.5, 1.5, len(points))
    cells = cells_of_number(points, load, count)
    shares = [load[cell.contains(points)].sum() / load.sum() for cell in cells]
    # A cut misses the wanted share by the load of one point at most, 1/8000, and five cuts follow one another.
    np.testing.assert_allclose(shares, 1 / count, atol=5 / 8000)


def test_cells_are_cut_across_their_longer_side() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0], [1000, 100], (4000, 2))
    for cell in cells_of_number(points, np.ones(len(points)), 4):
        assert cell.low[1] is None
        assert cell.high[1] is None


def test_cells_are_halved_until_they_fit() -> None:
    rng = np.random.default_rng(0)
    points, load = rng.uniform(-50, 50, (2000, 2)), np.full(2000, 1 / 2000)

    def share(cell: BlockCell) -> float:
        return float(load[cell.contains(points)].sum())

    cells = cells_that_fit(points, load, lambda cell, _extent: share(cell) <= 0.3)
    assert len(cells) == 4
    assert max(map(share, cells)) <= 0.3
    with pytest.raises(DegenerateGeometryError):
        cells_that_fit(points, load, lambda _cell, _extent: False)


def test_neighbours_meet_and_opposites_do_not() -> None:
    west, east = BlockCell().cut(0, 10.0)
    assert not west.meets(east)  # half-open: the border belongs to one of them
    assert west.widened((1.0, 1.0)).meets(east)
    south = west.cut(1, 0.0)[0]
    north_east = east.cut(1, 5.0)[1]
    assert not south.widened((2.0, 2.0)).meets(north_east)
    assert south.widened((3.0, 3.0)).meets(north_east.widened((3.0, 3.0)))
