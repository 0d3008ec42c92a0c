"""Image rays of cameras whose poses carry errors, and the points at which they meet (`geometry.intersection`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class CommonRotation:
    """A rotation error that all cameras share, as when SfM's rotations were aligned to geo as a whole.

    Attributes:
        cov_rad2: (3, 3) of the rotation vector in geo.
        gain: (n, 3, 3) rotation in rad per metre of error of each camera's centre, from which it was estimated.
    """

    cov_rad2: FloatArray
    gain: FloatArray


@dataclass(frozen=True)
class UncertainCameras:
    """n cameras in geo, with errors that are independent between cameras (but for `common`).

    Attributes:
        center_in_geo: (n, 3) metres.
        rotation_geo_from_cam: (n, 3, 3).
        cov_center_in_geo: (n, 3, 3) m², of the position.
        sigma_attitude_rad: (n,) per axis.
        sigma_ray: (n,) σ of x/z and y/z: σ of the pixel over the focal length.
        common: rotation error of all cameras together, or None.
    """

    center_in_geo: FloatArray
    rotation_geo_from_cam: FloatArray
    cov_center_in_geo: FloatArray
    sigma_attitude_rad: FloatArray
    sigma_ray: FloatArray
    common: CommonRotation | None = None


@dataclass(frozen=True)
class Rays:
    """M rays: `point` (M,) ascending, `view` (M,) index of the camera, `xy` (M, 2) undistorted x/z and y/z."""

    point: IntArray
    view: IntArray
    xy: FloatArray


@dataclass(frozen=True)
class Intersections:
    """Positions of N points at which rays intersect.

    Attributes:
        position_in_geo: (N, 3) metres, NaN with fewer than two rays or parallel ones.
        cov_in_geo: (N, 3, 3) m², NaN likewise.
        ray_count: (N,) rays used.
        max_angle_deg: (N,) largest angle between two used rays.
        condition: (N,) condition number of the normal matrix; infinite where there is no position.
        consistent: (N,) most rays agree within their σ, and the point lies in front of all that do.
        used: (M,) rays that were used.
    """

    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    consistent: BoolArray
    used: BoolArray

    @classmethod
    def none(cls, point_count: int, ray_count: int = 0) -> Intersections:
        """Return the intersections of points none of which has a position."""
        return cls(
            position_in_geo=np.full((point_count, 3), np.nan),
            cov_in_geo=np.full((point_count, 3, 3), np.nan),
            ray_count=np.zeros(point_count, dtype=np.int32),
            max_angle_deg=np.zeros(point_count),
            condition=np.full(point_count, np.inf),
            consistent=np.zeros(point_count, dtype=bool),
            used=np.zeros(ray_count, dtype=bool),
        )
