"""Outline of what is measured: holes by their width, no spikes, no islands, and never beyond what encloses it."""

import numpy as np
import pytest
import shapely

from pipelines.survey.measured_ground import MeasuredGround

CELL_M, SIZE = 0.25, 240  # a square of 60 m
WITHIN = shapely.box(5, 5, 55, 55)


def ground(*, without: list[shapely.Polygon], also: tuple[shapely.Polygon, ...] = ()) -> MeasuredGround:
    """Return ground that is measured in a square of 10 to 50 m and some places more, but not in others."""
    middle = CELL_M * (np.arange(SIZE) + 0.5)
    east, north = np.meshgrid(middle, middle)
    shape = shapely.union_all([shapely.box(10, 10, 50, 50), *also]).difference(shapely.union_all(without))
    measured = shapely.contains_xy(shape, east.ravel(), north.ravel()).reshape(SIZE, SIZE)
    return MeasuredGround(measured, np.zeros(2), np.array([CELL_M, 0.02]))


def disc(east: float, north: float, width: float) -> shapely.Polygon:
    return shapely.Point(east, north).buffer(width / 2)


@pytest.mark.parametrize(
    ("fill", "filled"), [(None, {1.5}), (0.0, set()), (4.0, {1.5, 3.0}), (9.0, {1.5, 3.0, 8.0})]
)
def test_holes_are_filled_up_to_a_width(fill: float | None, filled: set[float]) -> None:
    """Without a width it is two metres, since ten of these pixels are less."""
    holes = {width: disc(20.0 + 10 * number, 30.0, width) for number, width in enumerate((1.5, 3.0, 8.0))}
    outline = ground(without=list(holes.values())).outline(WITHIN, fill)
    assert {width for width, hole in holes.items() if outline.contains(hole.centroid)} == filled
    expected = 1600.0 - sum(hole.area for width, hole in holes.items() if width not in filled)
    assert outline.area == pytest.approx(expected, rel=0.01)


def test_ten_pixels_of_coarse_photographs_are_filled() -> None:
    coarse = ground(without=[disc(30, 30, 3.0)])
    coarse = MeasuredGround(coarse.measured, coarse.corner, np.array([CELL_M, 0.4]))
    assert coarse.outline(WITHIN, None).contains(shapely.Point(30, 30))


def test_no_more_than_a_tenth_is_filled() -> None:
    """Stripes of a metre between stripes of two: a third of the area would be filled."""
    stripes = [shapely.box(east, 0, east + 1.0, 60) for east in np.arange(10.0, 50.0, 3.0)]
    sparse = ground(without=stripes)
    assert sparse.outline(WITHIN, None).area == pytest.approx(1600 * 2 / 3, rel=0.05)
    assert sparse.outline(WITHIN, 2.0).area == pytest.approx(1600, rel=0.1)  # bays at the rim stay


def test_spikes_islands_and_what_lies_outside_are_left_out() -> None:
    spike, island, beyond = shapely.box(50, 30, 54, 30.5), disc(53, 20, 1.5), shapely.box(20, 50, 40, 59)
    outline = ground(without=[], also=(spike, island, beyond)).outline(WITHIN, None)
    assert not outline.contains(shapely.Point(53, 30.25))
    assert not outline.contains(island.centroid)
    assert outline.contains(shapely.Point(30, 54))
    assert outline.difference(WITHIN.buffer(1e-6)).is_empty
    assert outline.area == pytest.approx(1600 + 20 * 5, rel=0.01)


def test_share_is_of_the_polygon_also_where_nothing_is_known() -> None:
    half = ground(without=[shapely.box(10, 10, 30, 50)])
    assert half.share(shapely.box(10, 10, 50, 50)) == pytest.approx(0.5, abs=0.01)
    assert half.share(shapely.box(30, 10, 110, 50)) == pytest.approx(0.25, abs=0.01)
    assert ground(without=[shapely.box(0, 0, 60, 60)]).outline(WITHIN, None) is None
