"""Options of `georef init-sim3`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.options import StageOptions


class InitSim3Options(StageOptions):
    """Options of the similarity from the SfM model into the frame `geo`."""

    method: Literal["robust", "paper"] = Field(
        "robust", description="robust: RANSAC and weights from covariances; paper: plain least squares."
    )
    max_residual: float | None = Field(
        None, gt=0, description="Fail if the RMS residual of the camera centres is larger, in metres."
    )
    control_points: bool = Field(True, description="Use the control points.")
    seed: int = Field(0, ge=0, description="Seed of the RANSAC.")
    accept_contradiction: bool = Field(
        False, description="Go on where sources contradict each other, with a caution and larger σ."
    )
