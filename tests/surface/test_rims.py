"""Where a surface ends before another, its outermost pixels are given up; nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.surface.agreement import without_rims

HEIGHT, WIDTH, FOCAL = 30, 40, 50.0


def plane(tilt_x: float, tilt_y: float, distance_m: float = 100.0) -> np.ndarray:
    """Return the depth along z of the plane z + tilt · (x, y) = distance."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    return (distance_m / (1 + tilt_x * x + tilt_y * y)).astype(np.float32)


@given(tilt=st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), reach=st.integers(1, 4))
def test_a_plane_has_no_rims_however_steep(tilt: tuple[float, float], reach: int) -> None:
    depth = plane(*tilt)
    np.testing.assert_array_equal(without_rims(depth, reach), depth)


@pytest.mark.parametrize("reach", [1, 2, 3])
def test_the_near_side_of_a_step_is_given_up(reach: int) -> None:
    depth = plane(0.3, 0.5)
    depth[:, :20] *= 0.95  # a roof 5 m before the ground
    trimmed = without_rims(depth, reach)
    assert (trimmed[:, 20 - reach : 20] == 0).all()
    np.testing.assert_array_equal(trimmed[:, : 20 - reach], depth[:, : 20 - reach])
    np.testing.assert_array_equal(trimmed[:, 20:], depth[:, 20:])  # what lies behind is seen beside the edge, too


def test_steps_below_the_noise_and_unknown_places_are_no_rims() -> None:
    depth = plane(0.0, 0.4)
    depth[:, :20] *= 0.995
    depth[5:8, 5:8] = 0
    np.testing.assert_array_equal(without_rims(depth, 2), depth)


def test_the_ridge_of_a_roof_is_no_rim() -> None:
    # Roofs of 45° seen with a focal length of 340 px turn by 1 % within two pixels; here the pixels are coarser.
    depth = np.maximum(plane(0.1, 0.0), plane(-0.1, 0.0))
    np.testing.assert_array_equal(without_rims(depth, 2), depth)
