"""ENU, ECEF and lla go round without loss anywhere on Earth."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geodesy import enu
from pipelines.geodesy.enu import Origin
from tests.earth import enu_from_lla

LATITUDES = st.floats(-90.0, 90.0)
LONGITUDES = st.floats(-180.0, 180.0)
HEIGHTS = st.floats(-11000.0, 500000.0)
OFFSETS = st.floats(-20000.0, 20000.0)


@given(LATITUDES, LONGITUDES, HEIGHTS)
def test_lla_and_ecef(lat: float, lon: float, alt: float) -> None:
    ecef = enu.ecef_from_lla([lat, lon, alt])
    back = enu.lla_from_ecef(ecef)
    # Compared as positions: at a pole the longitude is free. 1e-8 m is ten roundings at the Earth's radius.
    np.testing.assert_allclose(enu.ecef_from_lla(back), ecef, rtol=0, atol=1e-8)
    assert abs(back[0] - lat) < 1e-13 * 90 * 10 and abs(back[2] - alt) < 1e-8


@given(LATITUDES, LONGITUDES, HEIGHTS, st.tuples(OFFSETS, OFFSETS, OFFSETS))
def test_enu_and_lla(lat: float, lon: float, alt: float, offset: tuple[float, float, float]) -> None:
    origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    back = enu_from_lla(enu.lla_from_enu(offset, origin), origin)
    np.testing.assert_allclose(back, offset, rtol=0, atol=2e-8)


@given(LATITUDES, LONGITUDES, st.tuples(OFFSETS, OFFSETS, OFFSETS), st.tuples(OFFSETS, OFFSETS, OFFSETS))
def test_distances_are_kept(
    lat: float, lon: float, first: tuple[float, float, float], second: tuple[float, float, float]
) -> None:
    origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=0.0)
    ecef = enu.ecef_from_enu([first, second], origin)
    expected = np.linalg.norm(np.subtract(first, second))
    assert abs(np.linalg.norm(ecef[0] - ecef[1]) - expected) < 1e-8
