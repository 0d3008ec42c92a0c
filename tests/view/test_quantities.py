"""Quantities of points and their σ; tests/georef/test_monte_carlo.py has those of distances in whole surveys."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pipelines.view.quantities import (
    PickedPoints,
    SampledSurface,
    VolumeBase,
    grid_in_polygon,
    length,
    plan_area,
    rim_base,
    volumes,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def exact(places: np.ndarray, cov: np.ndarray | None = None) -> PickedPoints:
    return PickedPoints(places, cov, places[:, 2])


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_sigma_is_that_of_draws(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-20, 20, (4, 3)) + np.arange(4)[:, None] * [10.0, 3.0, 0.0]
    root = 0.01 * rng.standard_normal((12, 12))
    points = exact(places, root @ root.T)
    drawn = places + (rng.standard_normal((500, 12)) @ root.T).reshape(-1, 4, 3)
    for quantity, draws in (
        (length(points)[0], [length(exact(each))[0].value for each in drawn]),
        (plan_area(points), [plan_area(exact(each)).value for each in drawn]),
    ):
        assume(quantity.value > 5 * quantity.sigma)  # an area of nearly zero has no sign to be linear in
        assert quantity.sigma == pytest.approx(np.std(draws), rel=0.16)  # 500 draws know σ to 3 %


def test_areas_of_known_polygons() -> None:
    square = np.array([[0.0, 0, 1], [4, 0, 2], [4, 3, 3], [0, 3, 4]])
    assert plan_area(exact(square)).value == pytest.approx(12.0)
    assert plan_area(exact(square[::-1])).value == pytest.approx(12.0)
    # A polygon with a bay: the grid leaves the bay out.
    bay = np.array([[0.0, 0], [6, 0], [6, 6], [3, 2], [0, 6]])
    grid = grid_in_polygon(bay, 0.1)
    assert len(grid) * 0.01 == pytest.approx(plan_area(exact(np.column_stack([bay, np.zeros(5)]))).value, rel=0.01)
    assert not ((np.abs(grid[:, 0] - 3) < 0.5) & (grid[:, 1] > 4)).any()


@pytest.mark.parametrize(("kind", "expected"), [("plane", 50.0), ("mean", 50.0), ("lowest", 70.0)])
def test_volume_over_each_base(kind, expected: float) -> None:
    # A slab 0.5 m above a sloping square of 10 m; its lowest side lies 0.2 m below the middle.
    corners = np.array([[0.0, 0, 0], [10, 0, 0.4], [10, 10, 0.4], [0, 10, 0]])
    grid = grid_in_polygon(corners[:, :2], 0.5)
    samples = np.column_stack([grid, 0.04 * grid[:, 0] + 0.5])
    chosen = np.arange(0, len(samples), 40)
    cov = 1e-4 * np.eye(3 * (4 + len(chosen)))
    none = np.zeros(len(samples))
    surface = SampledSurface(exact(corners, cov[:12, :12]), samples, none, cov, chosen, pixel_m=0.0)
    above, below, volume = volumes(surface, rim_base(kind, corners, grid))
    assert volume.value == pytest.approx(expected)
    assert (above.value, below.value) == (pytest.approx(expected), 0.0)
    assert volume.sigma is not None
    # 100 m² over the mean of four corners, each ± 1 cm (or of one), with that of the chosen samples.
    of_base = 1.0 if kind == "lowest" else 1.0 / np.sqrt(4)
    of_sampling = volumes_of_chequers(samples, surface, rim_base(kind, corners, grid))
    expected_sigma = np.sqrt(of_base**2 + 1.0 / len(chosen) + of_sampling**2)
    assert volume.sigma == pytest.approx(expected_sigma, rel=0.1)


def volumes_of_chequers(samples: np.ndarray, surface: SampledSurface, base: VolumeBase) -> float:
    """Return half the difference between the volumes over the white and the black cells of the grid."""
    column, row = (np.unique(np.round(samples[:, axis], 3), return_inverse=True)[1] for axis in (0, 1))
    above, white = samples[:, 2] - base.height_m, (column + row) % 2 == 0
    return float(plan_area(surface.corners).value * abs(above[white].mean() - above[~white].mean()) / 2)


def test_sigma_of_cut_and_fill_is_that_of_draws() -> None:
    """Half of a field is cut, half is filled: corners and the surface as a whole err."""
    rng = np.random.default_rng(5)
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
    grid = grid_in_polygon(corners[:, :2], 0.5)
    heights = np.where(grid[:, 0] < 5, 0.6, -0.4)
    samples, chosen = np.column_stack([grid, heights]), np.arange(0, len(grid), 7)
    joint = np.zeros((3 * (4 + len(chosen)),) * 2)
    up = np.arange(2, 12, 3)
    joint[up, up] = 0.03**2  # of the corners' heights
    surface = SampledSurface(exact(corners, joint[:12, :12]), samples, np.full(len(grid), 0.05), joint, chosen, 0.0)
    above, below, volume = volumes(surface, rim_base("mean", corners, grid))
    assert (above.value, below.value, volume.value) == pytest.approx((30.0, 20.0, 10.0))
    drawn = []
    for _ in range(400):
        base = (corners[:, 2] + rng.normal(0, 0.03, 4)).mean()
        each = samples[:, 2] + rng.normal(0, 0.05, len(samples)) - base
        drawn.append([100 * np.maximum(each, 0).mean(), 100 * np.maximum(-each, 0).mean(), 100 * each.mean()])
    np.testing.assert_allclose([above.sigma, below.sigma, volume.sigma], np.std(drawn, axis=0), rtol=0.2)
