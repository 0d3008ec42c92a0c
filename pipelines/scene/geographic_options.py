"""Options of the geographic losses: of `train`, and of the stages that set up its problem again."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, ValidationInfo, field_validator

from pipelines.core.errors import InputError
from pipelines.core.options import WRITTEN, StageOptions, from_text, listed_names

# A dense basis of more cameras takes more than 2 GiB (`geometry.correction_basis`).
MOST_JOINT_CAMERAS = 1300
# Sparse equations are faster for more cameras, whose time in dense ones grows with their cube.
MOST_DENSE_CAMERAS = 100
Solve = Literal["auto", "joint", "once"]
ConstantError = Literal["bias", "lever-arm", "boresight"]
CONSTANT_ERRORS: tuple[ConstantError, ...] = get_args(ConstantError)


def _constant_errors(text: str) -> tuple[str, ...] | str:
    if text == "auto":
        return text
    return () if text == "none" else listed_names(text, CONSTANT_ERRORS, "; or auto, or none")


ConstantErrors = Annotated[tuple[ConstantError, ...] | Literal["auto"], from_text(_constant_errors), WRITTEN]


class GeographicOptions(StageOptions):
    """Options of the geographic losses: measurements in use, their weights, and constant errors to estimate."""

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
    estimate: ConstantErrors = Field(
        "auto",
        description="Constant errors to estimate: any of bias (of the positions of a flight), lever-arm and "
        "boresight, with commas; auto: a bias that 3 or more control points show; or none.",
    )
    optimize_cameras: bool = Field(
        True,
        description="Correct the training cameras while training; unless weighted as in the paper, the lens too.",
    )

    solve: Solve = Field(
        "auto",
        description="Refine similarity and cameras jointly with the Gaussians, or solve them once and hold them; "
        f"auto: once beyond {MOST_JOINT_CAMERAS} photographs.",
    )

    @property
    def estimated(self) -> tuple[ConstantError, ...]:
        """Constant errors that `estimate` names; none with `auto`."""
        return tuple(name for name in CONSTANT_ERRORS if self.estimate != "auto" and name in self.estimate)

    def solves_once(self, cameras: int) -> bool:
        """Return whether that many cameras are solved once, in sparse equations, and then held."""
        wanted = self.solve == "once" or (self.solve == "auto" and cameras > MOST_JOINT_CAMERAS)
        return wanted and self.optimize_cameras and self.geo_loss

    def without_photographs(self, cameras: int) -> Self:
        """Return the options of a solution without photographs, where dense and sparse equations agree.

        "auto" then means the faster ones for that many cameras.
        """
        faster: Solve = "once" if cameras > MOST_DENSE_CAMERAS else "joint"
        return self.model_copy(update={"solve": faster}) if self.solve == "auto" else self

    def refined_cameras(self, cameras: int) -> int:
        """Return how many of that many cameras are refined together with the Gaussians: all or none."""
        return cameras if self.optimize_cameras and not self.solves_once(cameras) else 0

    def require_trainable(self, cameras: int) -> None:
        """Refuse options that change the cameras' solution during a training, if the training holds it.

        Raises:
            InputError: names the option.
        """
        if not self.solves_once(cameras):
            return
        for value, plain, name in (
            (self.weighting, "whitened", "--weighting"),
            (self.loss_weights, "fixed", "--loss-weights"),
            (self.gcp_mode, "camera", "--gcp-mode"),
        ):
            if value != plain:
                raise InputError(
                    f"{value!r} changes the solution of the cameras during the training, and these {cameras} are "
                    f"solved once before it: use {name} {plain}, --solve joint or --no-optimize-cameras",
                    field=name,
                )

    @field_validator("estimate")
    @classmethod
    def _has_sigma(
        cls, errors: tuple[ConstantError, ...] | Literal["auto"], info: ValidationInfo
    ) -> tuple[ConstantError, ...] | Literal["auto"]:
        if info.data.get("weighting") == "paper" and errors and errors != "auto":
            raise ValueError("constant errors are estimated with --weighting whitened only")
        return errors
