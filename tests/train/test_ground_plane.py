"""The ground below a scene: a plane, whatever stands on it and whatever SfM mismatched."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.train.initial_gaussians import ground_plane

pytestmark = pytest.mark.usefixtures("one_thread")


def scene(slope: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Points on a slope with houses on a third of it, noise, and some far mismatches."""
    place = rng.uniform(-60, 60, (4000, 2))
    height = place @ np.array(slope) - 20 + rng.normal(0, 0.2, 4000)
    height += np.where(rng.random(4000) < 0.35, rng.uniform(2, 15, 4000), 0.0)
    return np.vstack([np.column_stack([place, height]), rng.normal(0, 3000, (30, 3))])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.12, -0.05)])
def test_a_slope_is_found_below_houses_and_mismatches(slope: tuple[float, float]) -> None:
    a, b, c = ground_plane(scene(slope, np.random.default_rng(0)))
    # A tenth of all points is the lowest sixth of those on the ground: about one σ (0.2 m) below it.
    assert abs(a - slope[0]) < 0.005 and abs(b - slope[1]) < 0.005
    assert abs(c + 20) < 0.5


def test_walls_alone_have_level_ground() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0, 0.5, 500), rng.uniform(-5, 5, 500), rng.uniform(0, 30, 500)])
    points[:, 0] += 0.2 * points[:, 2]
    a, b, c = ground_plane(points)
    assert (a, b) == (0, 0) and 0 < c < 5
