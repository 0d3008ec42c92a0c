"""The options of `georef calibrate`."""

from __future__ import annotations

from pydantic import Field, field_validator

from pipelines.core.options import RIG_PARAMETERS, RigParameter, StageOptions, rig_parameters


class CalibrateOptions(StageOptions):
    """What `georef calibrate` estimates from the SfM cameras and the recorded navigation."""

    estimate: str = Field(
        "time-offset,boresight", description="Any of time-offset, boresight and lever-arm, with commas."
    )
    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search the time offset so many seconds on either side of the present one."
    )

    @property
    def wanted(self) -> tuple[RigParameter, ...]:
        """The parameters, in their usual order."""
        return tuple(name for name in RIG_PARAMETERS if name in self.estimate.split(","))

    @field_validator("estimate")
    @classmethod
    def _are_parameters(cls, text: str) -> str:
        return rig_parameters(text)
