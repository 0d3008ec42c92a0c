"""Plans: names that cover nothing, scale bars of round lengths."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipelines.formats.image_file import header_size
from pipelines.report.plots.plans import (
    NamedPlaces,
    add_names,
    frame_around,
    movement_plan,
    new_plan,
    nice_number,
    site_plan,
)

NOTHING = NamedPlaces()


@given(st.floats(1e-6, 1e9))
def test_nice_numbers_are_round_and_not_too_large(most: float) -> None:
    nice = nice_number(most)
    assert most / 2.5 < nice <= most * (1 + 1e-9)
    assert f"{nice:e}"[0] in "125"


def test_names_that_would_overlap_are_left_out() -> None:
    places = np.array([[0.0, 0.0], [50.0, 50.0], [50.1, 50.1], [50.2, 50.0], [50.0, 50.2], [50.1, 50.0]])
    figure, axes = new_plan(frame_around(places), "names")
    written = add_names(
        figure, axes, places, ["$a_b$ \\frac", *("a long name" for _ in range(5))], np.zeros((0, 2))
    )
    assert 2 <= written < len(places)
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) == written
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_plan_of_a_single_photograph_can_be_drawn() -> None:
    png = site_plan(np.zeros((1, 2)), np.zeros((0, 2)), NOTHING, NOTHING, np.zeros((0, 2)))
    assert header_size(png) is not None


def test_movements_are_magnified_by_a_round_number() -> None:
    rng = np.random.default_rng(0)
    center = rng.uniform(-50, 50, (12, 2))
    moved = np.full((12, 2), 0.02) * [1, 0]
    moved[3] = np.nan  # not measured
    drawn = movement_plan(center, moved, np.tile(np.eye(2) * 0.01**2, (12, 1, 1)), np.arange(12) == 1)
    longer = frame_around(center).longer_m
    assert drawn.arrow_factor == nice_number(0.08 * longer / 0.02)
    assert drawn.ellipse_factor == nice_number(0.02 * longer / 0.01)
    still = movement_plan(center, np.zeros((12, 2)), None, np.zeros(12, dtype=bool))
    assert (still.arrow_factor, still.ellipse_factor) == (None, None)
