"""Ground below a cloud, and heights where nothing was measured, against scenes whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.surface.filling import fill_cells
from pipelines.surface.ground import GroundModel, terrain_of
from tests.refusals import refused

SPACING_M, SIZE_M, NOISE_M = 0.25, 60.0, 0.02


def hillside(plan: np.ndarray) -> np.ndarray:
    """Return a slope of 15 % with waves of 0.6 m."""
    return 0.15 * plan[:, 0] + 0.3 * np.sin(plan[:, 1] / 8)


def town(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and normals of a hillside with houses, trees and walls, and which are ground."""
    step = np.arange(SPACING_M / 2, SIZE_M, SPACING_M)
    plan = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2) + rng.uniform(-0.05, 0.05, (len(step) ** 2, 2))
    ground = hillside(plan)
    height, on_ground = ground.copy(), np.ones(len(plan), dtype=bool)
    for east, north in ((8.0, 8.0), (35.0, 12.0), (15.0, 40.0)):
        inside = (np.abs(plan - [east + 5, north + 4]) < [5, 4]).all(axis=1)
        height[inside], on_ground[inside] = hillside(np.array([[east, north]]))[0] + 7.0, False
    for east, north in ((50.0, 40.0), (52.0, 50.0), (30.0, 52.0)):
        away = np.linalg.norm(plan - [east, north], axis=1)
        crown = away < 2.5
        height[crown] += 3.0 + 2.0 * np.sqrt(1 - (away[crown] / 2.5) ** 2)
        on_ground[crown] = False
    points = np.column_stack([plan, height + rng.normal(0, NOISE_M, len(plan))])
    normal = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    # A wall of the first house, seen from the east.
    wall = np.array([(13.0, north, up) for north in np.arange(8, 16, 0.25) for up in np.arange(2.0, 8.5, 0.25)])
    points = np.concatenate([points, wall])
    normal = np.concatenate([normal, np.tile([1.0, 0.0, 0.0], (len(wall), 1))])
    foot = np.abs(wall[:, 2] - hillside(wall[:, :2])) < 0.3
    return points, normal, np.concatenate([on_ground, foot])


@pytest.fixture(scope="module")
def terrain() -> tuple[GroundModel, np.ndarray, np.ndarray]:
    points, normal, on_ground = town(np.random.default_rng(0))
    return terrain_of(points, normal, SPACING_M), points, on_ground


def test_ground_is_told_from_what_stands_on_it(terrain: tuple[GroundModel, np.ndarray, np.ndarray]) -> None:
    found, points, on_ground = terrain
    told = found.is_ground(points)
    assert (on_ground & ~told).sum() < 0.05 * on_ground.sum()  # errors of type I
    assert (told & ~on_ground).sum() < 0.05 * (~on_ground).sum()  # and of type II


def test_ground_is_where_it_is_and_its_sigma_says_how_well(
    terrain: tuple[GroundModel, np.ndarray, np.ndarray],
) -> None:
    """Open ground to the noise of a cell's mean and the bend of a metre; below houses to 0.15 m, as by its σ."""
    found, points, on_ground = terrain
    plan = points[:, :2]
    error = found.interpolated(found.height, plan) - hillside(plan)
    gap_m = found.interpolated(found.gap_m, plan)
    is_open = gap_m == 0
    assert is_open.sum() > 0.6 * on_ground.sum()
    assert np.sqrt(np.mean(error[is_open] ** 2)) < 0.03
    below = ~on_ground & (points[:, 0] < SIZE_M - 3) & (gap_m > 1)
    assert np.sqrt(np.mean(error[below] ** 2)) < 0.15
    assert np.sqrt(np.mean(error[below] ** 2 / found.bridged_variance(gap_m[below]))) < 1.4


def test_a_street_between_houses_is_ground() -> None:
    """It is three cells wide: those with known ground all around lie on one line, which spans no plane."""
    rng, step = np.random.default_rng(4), np.arange(SPACING_M / 2, SIZE_M, SPACING_M)
    plan = np.stack(np.meshgrid(step, step[step < 15]), axis=-1).reshape(-1, 2)
    street = (plan[:, 1] >= 6) & (plan[:, 1] < 9)
    height = np.where(street, 0.0, 7.0) + rng.normal(0, NOISE_M, len(plan))
    found = terrain_of(np.column_stack([plan, height]), np.tile([0.0, 0.0, 1.0], (len(plan), 1)), SPACING_M)
    assert np.abs(found.interpolated(found.height, plan[street])).max() < 0.1


def test_library_writes_nothing_into_the_results(capfd: pytest.CaptureFixture[str]) -> None:
    points, normal, _ = town(np.random.default_rng(1))
    terrain_of(points, normal, SPACING_M)
    assert capfd.readouterr().out == ""


def test_walls_alone_have_no_ground() -> None:
    points, normal, _ = town(np.random.default_rng(2))
    with refused("no-ground", DegenerateGeometryError):
        terrain_of(points, normal[:, [2, 1, 0]], SPACING_M)


def test_a_hole_in_a_level_surface_is_level() -> None:
    """Only the noise of the rim is left, of which a low quantile counts."""
    height = np.random.default_rng(3).normal(10, 0.01, (80, 90))
    hole = np.zeros(height.shape, dtype=bool)
    hole[30:50, 40:70] = True
    height[hole] = np.nan
    filled = fill_cells(height, hole, 64)
    assert np.abs(filled.height[hole] - 10).max() < 0.03
    assert filled.sigma[hole].max() < 0.05
    assert filled.distance[40, 55] == 10
    np.testing.assert_array_equal(filled.height[~hole], height[~hole])
    assert not hole.ravel()[filled.source[hole]].any(), "colours come from measured cells"


def test_beyond_reach_and_outside_the_area_nothing_is_filled() -> None:
    height = np.full((60, 60), np.nan)
    height[:, :10] = 5.0
    wanted = np.ones(height.shape, dtype=bool)
    wanted[50:] = False
    filled = fill_cells(height, wanted, 20)
    assert np.isfinite(filled.height[:50, :28]).all()
    assert not np.isfinite(filled.height[:, 31:]).any()
    assert not np.isfinite(filled.height[50:, 10:]).any()


def test_errors_of_filled_heights_are_as_large_as_their_sigma() -> None:
    """Over towns of flat-roofed houses, with holes where surveys have them: beside walls, and over their edges.

    The low heights around are right there more often than surveys allow, and σ counts the high ones: it is careful.
    """
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(8):
        true, hole = np.zeros((300, 300)), np.zeros((300, 300), dtype=bool)
        for row, column in rng.integers(10, 250, (10, 2)):
            height, width = rng.integers(20, 40, 2)
            true[row : row + height, column : column + width] = rng.uniform(3, 12)
            over, beyond = rng.integers(0, 6), rng.integers(4, 25)
            hole[row : row + height, column + width - over : column + width + beyond] = True
        measured = np.where(hole, np.nan, true + rng.normal(0, 0.05, true.shape))
        filled = fill_cells(measured, hole, 64)
        squares.append(((filled.height - true)[hole] / np.hypot(filled.sigma[hole], 0.05)) ** 2)
    assert 0.3 < np.sqrt(np.mean(np.concatenate(squares))) < 1.4
