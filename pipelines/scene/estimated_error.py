"""Estimated constant error of the measurements: part of the trained model."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Vector3


class EstimatedError(Product):
    """Constant error of the measurements that training estimated, with its σ, by axis.

    Attributes:
        name: `bias`: fix minus truth, east, north, up, in m. `lever-arm`: antenna seen from the camera beyond the
            arm that the survey has applied, camera axes, in m. `boresight`: rotation vector from the true to the
            nominal camera axes, in degrees. `lidar-shift`: LiDAR minus its true place, east, north, up, in m.
        flight: of a bias, counted from 0 in the order of time.
        unit: of `value` and `sigma`.
        value: the estimate.
        sigma: its σ.
        observed: σ is at most half of that of the prior.
    """

    name: Literal["bias", "lever-arm", "boresight", "lidar-shift"]
    flight: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    observed: tuple[bool, bool, bool]
