"""Options of `georef evaluate`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.options import InputPath, StageOptions


class EvaluateOptions(StageOptions):
    """Options of the evaluation with test views and check points."""

    backend: Literal["auto", "cpu", "cuda"] = Field("auto", description="Rasteriser.")
    renders: int = Field(8, ge=0, description="Side-by-side renders to write at the most.")
    similarity: Literal["trained", "initial"] = Field(
        "trained", description="Place the model on Earth as training found, or as init-sim3 did."
    )
    crs: str | None = Field(
        None, description="List the check points in this CRS too, e.g. EPSG:32632, or EPSG:32632+5773 for heights."
    )
    lpips_weights: InputPath | None = Field(
        None, description="NPZ file of LPIPS (VGG) weights; without it LPIPS is null."
    )
    cross_validate: bool = Field(
        False, description="Leave out each control point in turn and measure it by a solution without it."
    )
