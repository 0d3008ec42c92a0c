"""A constant error of the measurements, as it was estimated: part of the trained model."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Vector3


class EstimatedError(Product):
    """A constant error of the measurements that training estimated, with its σ, by axis.

    `bias`: fix minus truth, east, north, up, in m; `flight` counts from 0 in the order of time. `lever-arm`:
    antenna seen from the camera beyond what the survey has applied, camera axes, in m. `boresight`: rotation vector
    from the true to the nominal camera axes, in degrees. `observed`: σ is at most half of that of the prior.
    """

    name: Literal["bias", "lever-arm", "boresight"]
    flight: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    observed: tuple[bool, bool, bool]
