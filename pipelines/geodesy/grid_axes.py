"""Axes of a map grid at a place: how far grid north lies from true north."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef

_STEP_M = 10.0  # long against the rounding of eastings and northings, short against the curvature of a grid


def grid_from_enu(crs: PointCrs, lla: ArrayLike) -> FloatArray:
    """Return rotations (n, 3, 3) from true East-North-Up to the axes of a CRS, at places `lla` (n, 3).

    The third axis stays up, along the normal of the ellipsoid. The first two are the directions in which the first
    and the second coordinate grow. In a projection that is not conformal they are not at right angles: the result
    is the rotation nearest to them. A CRS without a grid (angles, or geocentric) has the axes of true
    East-North-Up.

    Raises:
        InputError: the axes of the CRS are left-handed, or a place lies outside its domain.
    """
    places = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
    rotations = np.tile(np.eye(3), (len(places), 1, 1))
    if crs.is_geographic or crs.is_geocentric or not len(places):
        return rotations
    axes = ecef_from_enu_rotation(places)
    steps = _STEP_M * np.stack([axes[..., 0], -axes[..., 0], axes[..., 1], -axes[..., 1]])
    moved = crs.xyz_from_lla(lla_from_ecef(ecef_from_lla(places) + steps).reshape(-1, 3)).reshape(4, -1, 3)
    by_enu = np.stack([moved[0] - moved[1], moved[2] - moved[3]], axis=-1)[:, :2]  # (n, xy, east and north)
    left, _, right = np.linalg.svd(by_enu)
    rotations[:, :2, :2] = left @ right
    if (np.linalg.det(rotations) < 0).any():
        raise InputError(
            f"the axes of {crs.name} are left-handed, and angles of cameras are not defined in them: give a CRS "
            "whose coordinates are easting and northing"
        )
    return rotations
