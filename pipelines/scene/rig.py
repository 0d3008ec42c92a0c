"""The rig as `calibrate` finds it: time offset, boresight and lever arm with their σ."""

from __future__ import annotations

from typing import Literal

from pipelines.core.options import RigParameter
from pipelines.core.products import Product


class RigEstimate(Product):
    """A parameter of the rig, estimated from the SfM cameras, in sense and unit of `ingest`'s option of that name.

    `start` is what `ingest` was told, `sigma` of each component; `observable` by component: whether σ is small
    enough to use it.
    """

    name: RigParameter
    unit: Literal["s", "deg", "m"]
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    start: tuple[float, ...]
    observable: tuple[bool, ...]

    @property
    def usable(self) -> bool:
        """Whether every component is observable."""
        return all(self.observable)


class RigCalibration(Product):
    """Estimates of the rig, and what is left over: robust σ per axis of positions (m) and attitudes (degrees).

    `problem` tells why there are none. `model` is the fingerprint of the SfM model that they are from, `layout`
    that of the survey's positions and attitudes before what is usable was applied to them.
    """

    wanted: tuple[RigParameter, ...]
    estimates: tuple[RigEstimate, ...] = ()
    images: int = 0
    control_points: int = 0
    rms_position_m: float | None = None
    rms_attitude_deg: float | None = None
    problem: str = ""
    model: str = ""
    layout: str = ""
