"""The options of `georef calibrate`."""

from __future__ import annotations

from pydantic import Field

from pipelines.core.options import StageOptions
from pipelines.scene.rig import RigParameters


class CalibrateOptions(StageOptions):
    """What `georef calibrate` estimates from the SfM cameras and the recorded navigation."""

    estimate: RigParameters = Field(
        ("time-offset", "boresight"), description="Any of time-offset, boresight and lever-arm, with commas."
    )
    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search the time offset so many seconds on either side of the present one."
    )
