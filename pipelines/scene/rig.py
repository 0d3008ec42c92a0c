"""The rig as `calibrate` finds it: time offset, boresight and lever arm with their σ."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator

from pipelines.core.options import WRITTEN, from_text, listed_names
from pipelines.core.products import Product

RigParameter = Literal["time-offset", "boresight", "lever-arm"]
RIG_PARAMETERS: tuple[RigParameter, ...] = get_args(RigParameter)


def in_usual_order(names: Collection[RigParameter]) -> tuple[RigParameter, ...]:
    """Return parameters of the rig in their usual order, each once."""
    return tuple(name for name in RIG_PARAMETERS if name in names)


# An option: parameters of the rig.
RigParameters = Annotated[
    tuple[RigParameter, ...],
    from_text(lambda text: listed_names(text, RIG_PARAMETERS)),
    AfterValidator(in_usual_order),
    WRITTEN,
]


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
