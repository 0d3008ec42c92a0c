"""Product of `calibrate`: estimates of time offset, boresight and lever arm with their σ."""

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
    """Return the named parameters of the rig in their usual order, without repetition."""
    return tuple(name for name in RIG_PARAMETERS if name in names)


# Type of an option that names parameters of the rig.
RigParameters = Annotated[
    tuple[RigParameter, ...],
    from_text(lambda text: listed_names(text, RIG_PARAMETERS)),
    AfterValidator(in_usual_order),
    WRITTEN,
]


class RigEstimate(Product):
    """Parameter of the rig, estimated from the SfM cameras.

    Sign and unit are those of the option of `ingest` with the same name.

    Attributes:
        name: the parameter.
        unit: of value, σ and start.
        value: estimate, by component.
        sigma: σ, by component.
        start: value given to `ingest`, by component.
        observable: by component, whether σ is small enough for the estimate to be used.
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
    """Product of `calibrate`: estimates of the rig, divided into those applied to the survey and the others.

    Attributes:
        format_version: version of the format.
        wanted: parameters that were to be estimated.
        applied: estimates that `load_survey` applies.
        not_applied: all other estimates.
        images: number of images in the fit.
        control_points: number of control points in the fit.
        rms_position_m, rms_attitude_deg: robust σ of the residuals per axis.
        problem: reason why nothing was estimated; else empty.
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
