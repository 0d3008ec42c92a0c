"""Options of `georef calibrate`."""

from __future__ import annotations

from pydantic import Field

from pipelines.core.options import StageOptions
from pipelines.scene.rig import RigParameters


class CalibrateOptions(StageOptions):
    """Options of the calibration of the rig: parameters to estimate, and parameters to apply."""

    estimate: RigParameters | None = Field(
        None,
        description="Any of time-offset, boresight and lever-arm, with commas (default: what ingest was asked to "
        "estimate).",
    )
    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search the time offset so many seconds on either side of the present one."
    )
    apply: bool | None = Field(
        None,
        description="Apply the estimates that are observable, or none (default: those that ingest was asked for).",
    )
