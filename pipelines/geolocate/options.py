"""Options of `georef geolocate`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.options import StageOptions


class GeolocateOptions(StageOptions):
    """Options of the intersection of every SfM point in the frame `geo`."""

    attitude: Literal["auto", "recorded", "sfm"] = Field(
        "auto", description="Rotations of the rays: recorded with the images, or SfM's aligned to geo."
    )
    sigma_px: float = Field(0.7, gt=0, description="σ of an image observation in pixels.")
    min_angle: float = Field(1.0, gt=0, lt=90, description="Least intersection angle of an inlier in degrees.")
    max_sigma: float | None = Field(
        None, gt=0, description="Largest σ along any axis of an inlier, in metres (default: no limit)."
    )
