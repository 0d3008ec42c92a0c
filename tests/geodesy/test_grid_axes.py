"""Axes of a grid: against PROJ's own convergence, and where there is no grid."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Proj

from pipelines.core.errors import InputError
from pipelines.geodesy.crs import grid_from_enu, parse_crs
from tests.refusals import refused


@pytest.mark.parametrize(
    ("crs", "lla"),
    [
        ("EPSG:32632", [[47.4, 8.5, 500.0], [60.0, 11.9, 0.0], [46.0, 6.1, 4000.0]]),
        ("EPSG:32733", [[-33.9, 18.4, 20.0], [-20.0, 16.2, 1500.0]]),
        ("EPSG:3035", [[50.0, 14.0, 300.0]]),  # equal areas: at right angles only on average
        ("EPSG:2263", [[40.7, -74.0, 10.0]]),  # feet
    ],
)
def test_angle_is_the_convergence_of_the_projection(crs: str, lla: list[list[float]]) -> None:
    found = grid_from_enu(parse_crs(crs), lla)
    projection = Proj(crs)
    for rotation, (lat, lon, _) in zip(found, lla, strict=True):
        # The convergence is the true azimuth of grid north: the meridian lies on the other side of grid north.
        # EPSG:3035 shears by up to 1°, which the nearest rotation shares out between meridian and parallel.
        factors = projection.get_factors(lon, lat)
        north = rotation @ [0.0, 1.0, 0.0]
        meridian = np.degrees(np.arctan2(north[0], north[1]))
        sheared = abs(factors.meridian_parallel_angle - 90.0)
        assert meridian == pytest.approx(-factors.meridian_convergence, abs=1e-5 + sheared)
        np.testing.assert_allclose(rotation[2], [0, 0, 1], atol=1e-15)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4979", "EPSG:4978", "EPSG:4326+3855"])
def test_without_a_grid_the_axes_are_true_east_and_north(crs: str) -> None:
    np.testing.assert_array_equal(grid_from_enu(parse_crs(crs), [[47.0, 8.0, 0.0]] * 2), [np.eye(3)] * 2)


def test_axes_that_point_west_and_south_are_half_a_turn() -> None:
    found = grid_from_enu(parse_crs("EPSG:2053"), [[-29.0, 29.0, 100.0]])  # on its central meridian
    np.testing.assert_allclose(found[0], np.diag([-1.0, -1.0, 1.0]), atol=1e-9)


def test_left_handed_axes_are_refused() -> None:
    with refused("axes-left-handed", InputError):
        grid_from_enu(parse_crs("EPSG:5513"), [[50.0, 14.4, 300.0]])
