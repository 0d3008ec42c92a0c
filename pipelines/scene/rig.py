"""The rig as `calibrate` estimates it: time offset, boresight and lever arm with their σ."""

from __future__ import annotations

from collections.abc import Container
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, model_validator

from pipelines.core.options import WRITTEN, from_text, listed_names
from pipelines.core.products import Product

RigParameter = Literal["time-offset", "boresight", "lever-arm"]
RIG_PARAMETERS: tuple[RigParameter, ...] = get_args(RigParameter)
_COMPONENTS: dict[RigParameter, int] = {"time-offset": 1, "boresight": 3, "lever-arm": 3}


def in_usual_order(names: Container[RigParameter]) -> tuple[RigParameter, ...]:
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

    `start` is the value that `ingest` was told, `sigma` of each component; `observable` by component: whether σ is
    small enough to use it.
    """

    name: RigParameter
    unit: Literal["s", "deg", "m"]
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    start: tuple[float, ...]
    observable: tuple[bool, ...]

    @model_validator(mode="after")
    def _has_all_components(self) -> RigEstimate:
        lengths = {len(self.value), len(self.sigma), len(self.start), len(self.observable)}
        if lengths != {_COMPONENTS[self.name]}:
            raise ValueError(
                f"{self.name} has {_COMPONENTS[self.name]} components: value, sigma, start, observable"
            )
        return self

    @property
    def usable(self) -> bool:
        """Whether every component is observable."""
        return all(self.observable)


class RigCalibration(Product):
    """Product of `calibrate`: estimates of the rig, and which of them are applied when the survey is read.

    `wanted` names the parameters that were to be estimated, `problem` tells why none could be. `rms_position_m` and
    `rms_attitude_deg` are the robust σ per axis of what is left over.
    """

    format_version: Literal[1] = 1
    wanted: tuple[RigParameter, ...] = ()
    applied: tuple[RigEstimate, ...] = ()
    not_applied: tuple[RigEstimate, ...] = ()
    images: int = 0
    control_points: int = 0
    rms_position_m: float | None = None
    rms_attitude_deg: float | None = None
    problem: str = ""

    @model_validator(mode="after")
    def _names_each_once(self) -> RigCalibration:
        names = [estimate.name for estimate in (*self.applied, *self.not_applied)]
        if len(set(names)) != len(names):
            raise ValueError("a parameter is estimated twice")
        return self

    @property
    def estimates(self) -> tuple[RigEstimate, ...]:
        """All estimates, in the usual order of the parameters."""
        by_name = {estimate.name: estimate for estimate in (*self.applied, *self.not_applied)}
        return tuple(by_name[name] for name in in_usual_order(by_name))
