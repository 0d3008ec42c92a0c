"""Estimated systematic error of the measurements: part of the adjustment."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Vector3


class EstimatedError(Product):
    """Systematic error of the measurements that the adjustment estimated, with its σ, by axis.

    Attributes:
        name: `bias`: fix minus truth, east, north, up, in m. `lever-arm`: antenna seen from the camera beyond the
            arm that the survey has applied, camera axes, in m. `boresight`: rotation vector from the true to the
            nominal camera axes, in degrees. `lidar-shift`: LiDAR minus its true place, east, north, up, in m.
        session: of a bias: index into the survey's sessions.
        unit: of `value` and `sigma`.
        value: the estimate.
        sigma: its σ.
        prior: σ of its prior.
        observed: σ is at most half of that of the prior.
    """

    name: Literal["bias", "lever-arm", "boresight", "lidar-shift"]
    session: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    prior: Vector3
    observed: tuple[bool, bool, bool]
