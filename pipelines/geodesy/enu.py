"""East-North-Up, Earth-centred and geodetic coordinates on WGS84. Plain numpy, float64, any number of points.

Arrays end in an axis of length 3: `lla` is latitude and longitude in degrees and ellipsoidal height in metres,
`ecef` is EPSG:4978 in metres, `enu` is East-North-Up in metres in the plane tangent at an `Origin` (the frame
that products call `geo`). Nothing here assumes a flat Earth: a point 10 km away keeps its curvature.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipelines.core.products import Product
from pipelines.core.types import FloatArray

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_SECOND_E2 = _E2 / (1.0 - _E2)
# Bowring's iteration gains about six digits a step near the ground; five keep 1e-9 m up to 10 000 km.
_STEPS = 5


def ecef_from_lla(lla: ArrayLike) -> FloatArray:
    """Return Earth-centred metres (…, 3) of latitude, longitude (degrees) and ellipsoidal height (…, 3)."""
    points = _checked(lla)
    lat, lon, alt = np.radians(points[..., 0]), np.radians(points[..., 1]), points[..., 2]
    prime_vertical = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    ring = (prime_vertical + alt) * np.cos(lat)
    z = (prime_vertical * (1.0 - _E2) + alt) * np.sin(lat)
    return np.stack([ring * np.cos(lon), ring * np.sin(lon), z], axis=-1)


def lla_from_ecef(ecef: ArrayLike) -> FloatArray:
    """Return latitude, longitude (degrees, −180 … 180), ellipsoidal height (…, 3) of Earth-centred points (…, 3).

    Bowring's iteration (doi 10.1179/sre.1976.23.181.323), for points more than 1 000 km from the Earth's centre.
    """
    points = _checked(ecef)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    ring = np.hypot(x, y)
    reduced = np.arctan2(z, (1.0 - FLATTENING) * ring)
    for _ in range(_STEPS):
        lat = np.arctan2(
            z + _SECOND_E2 * _SEMI_MINOR_M * np.sin(reduced) ** 3, ring - _E2 * SEMI_MAJOR_M * np.cos(reduced) ** 3
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(lat), np.cos(lat))
    # This form of the height stays exact at the poles, where ring / cos(lat) does not.
    alt = ring * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_M * np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), alt], axis=-1)


def median_lla(lla: ArrayLike) -> FloatArray:
    """Return the median latitude, longitude and height (3,) of points (N, 3), N ≥ 1; also across the date line."""
    points = _checked(lla)
    lon = points[:, 1] - 360.0 * np.round((points[:, 1] - points[0, 1]) / 360.0)
    middle = np.median(np.stack([points[:, 0], lon, points[:, 2]], axis=-1), axis=0)
    middle[1] -= 360.0 * np.round(middle[1] / 360.0)
    return np.asarray(middle)


def lla_of(origin: Origin) -> FloatArray:
    """Return the origin as an array (3,) of latitude, longitude, height."""
    return np.array([origin.lat_deg, origin.lon_deg, origin.alt_m])


def ecef_from_enu_rotation(lla: ArrayLike) -> FloatArray:
    """Return rotations (…, 3, 3) whose columns are east, north, up at `lla` (…, 3), in Earth-centred axes."""
    points = _checked(lla)
    lat, lon = np.radians(points[..., 0]), np.radians(points[..., 1])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lon)], axis=-1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return np.stack([east, north, up], axis=-1)


def ecef_from_enu(enu: ArrayLike, origin: Origin) -> FloatArray:
    """Return Earth-centred points (…, 3) of tangent-plane points (…, 3) at `origin`; all in metres."""
    lla = lla_of(origin)
    return _checked(enu) @ ecef_from_enu_rotation(lla).T + ecef_from_lla(lla)


def enu_from_ecef(ecef: ArrayLike, origin: Origin) -> FloatArray:
    """Return tangent-plane points (…, 3) at `origin` of Earth-centred points (…, 3); all in metres."""
    lla = lla_of(origin)
    return (_checked(ecef) - ecef_from_lla(lla)) @ ecef_from_enu_rotation(lla)


def lla_from_enu(enu: ArrayLike, origin: Origin) -> FloatArray:
    """Return geodetic points (…, 3) of tangent-plane points (…, 3) in metres at `origin`."""
    return lla_from_ecef(ecef_from_enu(enu, origin))


def geo_from_enu_at(lla: ArrayLike, origin: Origin) -> FloatArray:
    """Return rotations (…, 3, 3) from East-North-Up at each point `lla` (…, 3) into the frame at `origin`.

    Attitudes and σ are measured against the vertical and north of the place where they are measured. The
    meridians converge: 10 km east at 70° N, north has turned by 0.25°.
    """
    return ecef_from_enu_rotation(lla_of(origin)).T @ ecef_from_enu_rotation(lla)


def _checked(points: ArrayLike) -> FloatArray:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim < 1 or array.shape[-1] != 3:
        raise ValueError(f"expected points of shape (…, 3), got {array.shape}")
    return array


class Origin(Product):
    """Origin of the `geo` frame: WGS84 degrees and ellipsoidal metres."""

    lat_deg: float = Field(ge=-90, le=90)
    lon_deg: float = Field(ge=-180, le=180)
    alt_m: float
