"""The closed forms against PROJ's, which shares no code with them."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer

from pipelines.geodesy import enu
from pipelines.geodesy.enu import Origin
from tests.earth import enu_from_lla

# A survey at 70° N whose far end is 10 km east: curvature 7.8 m, meridian convergence 0.25°.
NORTH = Origin(lat_deg=70.0, lon_deg=24.0, alt_m=120.0)
PLACES = np.array(
    [
        [46.02, 7.75, 1620.0],
        [70.0, 24.0, -3.5],
        [-33.9, 151.2, 8848.0],
        [0.0, 180.0, 0.0],
        [-89.999999, 12.0, 2800.0],
    ]
)


def test_ecef_agrees_with_proj() -> None:
    proj = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = np.stack(proj.transform(PLACES[:, 1], PLACES[:, 0], PLACES[:, 2]), axis=-1)
    # Two float64 roundings at 6.4e6 m are 2e-9 m.
    np.testing.assert_allclose(enu.ecef_from_lla(PLACES), expected, rtol=0, atol=1e-8)


def test_poles_have_exact_heights() -> None:
    poles = np.array([[90.0, 0.0, 100.0], [-90.0, 0.0, 2800.0]])
    back = enu.lla_from_ecef(enu.ecef_from_lla(poles))
    np.testing.assert_allclose(back[:, [0, 2]], poles[:, [0, 2]], rtol=0, atol=1e-8)


def test_enu_at_70_north_10_km_agrees_with_proj() -> None:
    lla = np.array([[70.0, 24.2625, 120.0], [70.09, 24.0, 55.0], [69.95, 23.9, 300.0]])
    pipeline = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=24 +lat_0=70 +h_0=120"
    )
    expected = np.stack(
        pipeline.transform(np.radians(lla[:, 1]), np.radians(lla[:, 0]), lla[:, 2], radians=True), axis=-1
    )
    computed = enu_from_lla(lla, NORTH)
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-8)
    assert -8.5 < computed[0, 2] < -7.0  # d²/2R: the Earth falls away from the tangent plane


def test_rotation_is_east_north_up() -> None:
    rotation = enu.ecef_from_enu_rotation(PLACES)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    metre = enu.ecef_from_lla(PLACES + np.array([0.0, 0.0, 1.0])) - enu.ecef_from_lla(PLACES)
    np.testing.assert_allclose(metre, rotation[..., 2], atol=1e-8)


def test_north_turns_by_the_convergence_of_the_meridians() -> None:
    rotation = enu.geo_from_enu_at([70.0, 24.2625, 120.0], NORTH)
    turn_deg = np.degrees(np.arctan2(-rotation[0, 1], rotation[1, 1]))  # anticlockwise
    assert turn_deg == pytest.approx(0.2625 * np.sin(np.radians(70.0)), rel=1e-4)


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(…, 3\)"):
        enu.ecef_from_lla(np.zeros((4, 2)))


def test_median_across_the_date_line() -> None:
    lla = [[10.0, 179.9, 1.0], [11.0, -179.8, 2.0], [12.0, -179.9, 3.0]]
    np.testing.assert_allclose(enu.median_lla(lla), [11.0, -179.9, 2.0])
