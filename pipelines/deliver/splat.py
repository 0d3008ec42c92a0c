"""The splat to deliver: the opaque Gaussians of the trained model, in the frame of the placement."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.workspace import Workspace
from pipelines.deliver.options import SplatOptions
from pipelines.deliver.placement import Placement, place
from pipelines.formats.splat_ply import SplatArrays
from pipelines.scene.calibrated import load_survey
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.sh import coefficient_count
from pipelines.splat.storage import read_gaussians
from pipelines.splat.transform import transformed


@dataclass(frozen=True)
class PlacedSplat:
    """Splat in the frame `file` of its placement.

    Attributes:
        gaussians: in `file`, metres.
        placement: place of that frame on Earth.
        left_out: number of Gaussians that were too transparent.
    """

    gaussians: Gaussians
    placement: Placement
    left_out: int

    def figures(self) -> dict[str, object]:
        """Return the figures that every deliverable of the splat tells: counts, origin, predicted σ."""
        accuracy = self.placement.sidecar().accuracy
        return {
            "gaussians": len(self.gaussians),
            "left_out": self.left_out,
            "origin_lla": tuple(self.placement.origin_lla.tolist()),
            "sigma_h_m": None if accuracy is None else accuracy.sigma_h_m,
            "sigma_v_m": None if accuracy is None else accuracy.sigma_v_m,
        }

    def key_figure(self) -> str:
        """Return the number of Gaussians and the predicted σ, in one line."""
        accuracy = self.placement.sidecar().accuracy
        sigma = "" if accuracy is None else f", σ {accuracy.sigma_h_m:.3f} m H, {accuracy.sigma_v_m:.3f} m V"
        return f"{len(self.gaussians)} Gaussians{sigma}"


def load_splat(workspace: Workspace, options: SplatOptions) -> PlacedSplat:
    """Return the splat of a workspace, placed on Earth.

    Raises:
        MissingProductError: ingest or train has not been run.
        InputError: a product is damaged.
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    survey = load_survey(workspace)
    model = load_json(TrainedModel, workspace.path(MODEL))
    return placed_splat(read_gaussians(workspace.path(GAUSSIANS)), model, survey, options)


def placed_splat(gaussians: Gaussians, model: TrainedModel, survey: Survey, options: SplatOptions) -> PlacedSplat:
    """Return the opaque Gaussians of a model in an East-North-Up frame at the scene.

    Args:
        gaussians: in the frame `model`.
        model: has the similarity geo ← model and its covariance.
        survey: has the origin of geo and the vertical datum.
        options: the least opacity.

    Raises:
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    kept = gaussians.select(torch.sigmoid(gaussians.logit_opacities) >= options.min_opacity)
    if len(kept) == 0:
        raise DegenerateGeometryError(
            f"none of {len(gaussians)} Gaussians has an opacity of {options.min_opacity} or more: "
            "lower --min-opacity"
        )
    # The placement is that of the model, whatever part of it a file holds.
    placement = place(model, survey, gaussians.means.numpy())
    return PlacedSplat(transformed(kept, placement.file_from_model), placement, len(gaussians) - len(kept))


def codec_arrays(gaussians: Gaussians, sh_degree: int | None = None) -> SplatArrays:
    """Return Gaussians for a codec, with spherical harmonics up to a degree; None: all that there are."""
    arrays = gaussians.arrays()
    if sh_degree is not None:
        arrays["sh"] = arrays["sh"][:, : coefficient_count(sh_degree)]
    return SplatArrays(**arrays)
