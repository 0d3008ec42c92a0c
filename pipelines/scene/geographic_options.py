"""The options of the geographic losses: those of `train`, and of whoever restores what it trained."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from pipelines.core.options import AUTO, StageOptions

ERROR_PARAMETERS = ("bias", "lever-arm", "boresight")


class GeographicOptions(StageOptions):
    """Which measurements hold similarity and cameras, how they are weighted, and what is estimated beside them."""

    geo_loss: bool = Field(True, description="Use the geographic losses.")
    weighting: Literal["whitened", "paper"] = Field(
        "whitened",
        description="Residuals divided by their σ, or plain mean squares as in the paper.",
    )
    gcp_loss: bool = Field(True, description="Use the control points, L_gcp.")
    gcp_mode: Literal["camera", "depth"] = Field(
        "camera", description="Find control points by intersecting their marks, or through the rendered depth."
    )
    rel_loss: bool = Field(True, description="Use distances between located points, L_rel.")
    geo_weight: float = Field(0.05, gt=0, description="Final weight w_max of the geographic losses (eq. 27).")
    geo_schedule: Literal["rising", "constant"] = Field(
        "rising", description="Let that weight rise as in eq. 27, or be final from the first iteration."
    )
    loss_weights: Literal["fixed", "learned"] = Field(
        "fixed", description="Weigh the geographic losses by the stated σ, or learn a variance factor for each."
    )
    estimate: str = Field(
        "auto",
        description="Constant errors to estimate: any of bias (of the positions of a flight), lever-arm and "
        "boresight, with commas; auto: a bias that 3 or more control points show; or none.",
    )
    optimize_cameras: bool = Field(
        True,
        description="Correct the training cameras while training; unless weighted as in the paper, the lens too.",
    )

    @property
    def estimated(self) -> tuple[str, ...]:
        """The constant errors that are asked for by name."""
        return tuple(name for name in ERROR_PARAMETERS if name in self.estimate.split(","))

    @field_validator("estimate")
    @classmethod
    def _are_errors(cls, text: str) -> str:
        unknown = [name for name in text.split(",") if name not in ERROR_PARAMETERS]
        if unknown and text not in (AUTO, "none"):
            raise ValueError(f"{unknown[0]!r} is none of {', '.join(ERROR_PARAMETERS)}; or auto, or none")
        return text

    @field_validator("estimate")
    @classmethod
    def _has_sigma(cls, text: str, info: ValidationInfo) -> str:
        if info.data.get("weighting") == "paper" and text not in (AUTO, "none"):
            raise ValueError("constant errors are estimated with --weighting whitened only")
        return text
