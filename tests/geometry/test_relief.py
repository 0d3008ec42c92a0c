"""Light on a surface: brightest where it faces the sun in the north-west."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.types import FloatArray
from pipelines.geometry.relief import LEVEL_LIGHT, sunlight


def plane(*, east: float, north: float) -> FloatArray:
    """Heights with slopes towards east and north; rows run from the north, cells are 2 wide."""
    row, column = np.mgrid[0:5, 0:7]
    return 2.0 * (east * column - north * row)


@pytest.mark.parametrize(
    ("east", "north", "expected"),
    [
        (0.0, 0.0, np.sin(np.radians(45))),
        # It falls towards the north-west at 45°: the sun stands on it at a right angle.
        (np.sqrt(0.5), -np.sqrt(0.5), 1.0),
        # It rises towards the north-west at 45°: the sun grazes it.
        (-np.sqrt(0.5), np.sqrt(0.5), 0.0),
    ],
)
def test_light_of_planes(east: float, north: float, expected: float) -> None:
    assert sunlight(plane(east=east, north=north), 2.0) == pytest.approx(np.full((5, 7), expected))


def test_unknown_heights_are_lit_as_level_ground() -> None:
    height = plane(east=0.3, north=0.1)
    height[2, 3] = np.nan
    light = sunlight(height, 2.0)
    assert np.isfinite(light).all()
    assert light[2, 2] == LEVEL_LIGHT  # its slope would need the unknown height
    assert (sunlight(np.ones((1, 4)), 2.0) == LEVEL_LIGHT).all()
