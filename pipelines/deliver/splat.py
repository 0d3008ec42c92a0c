"""The splat to deliver: the opaque Gaussians of the model, in the frame of the placement.

The model is the trained one, or what `georef clean` has made of it. Its place on Earth is that of the trained model
in any case, so that a cleaned file lies exactly where the other did.
"""

import itertools
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.special import expit

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import load_json
from pipelines.core.stages import BLOCK_RECORD, CLEAN, CLEANED, GAUSSIANS, MODEL
from pipelines.core.staleness import is_made_from
from pipelines.core.types import BoolArray, Float32Array, FloatArray, vector3
from pipelines.core.workspace import Workspace
from pipelines.deliver.options import SplatOptions, WebSplatOptions
from pipelines.deliver.placement import Placement, solved_placement
from pipelines.formats.splat_ply import SplatArrays, read_centres, read_logit_opacities
from pipelines.splat.gaussians import Gaussians, read_gaussians, transformed
from pipelines.splat.sh import coefficient_count
from pipelines.surface.measured_area import Crop, crop_of
from pipelines.survey.block_plan import BlockRecord
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CropOptions
from pipelines.survey.solution import TrainedModel, read_trained

log = logging.getLogger(__name__)

Origin = Literal["trained", "cleaned"]


def model_to_deliver(workspace: Workspace, options: SplatOptions) -> tuple[Path, Origin]:
    """Return the file of the Gaussians to deliver, in `model`, and of which model it is; errors as of `path`.

    It is that of `georef clean`, if it was made from the trained model as it is, and --trained is not given.
    """
    trained = workspace.path(GAUSSIANS)
    if options.trained or not workspace.has(CLEANED):
        return trained, "trained"
    if is_made_from(workspace, CLEAN, (MODEL, GAUSSIANS), {}):
        return workspace.path(CLEANED), "cleaned"
    log.warning(
        "%s was made from another training and is not used: the file holds the trained model. Run `%s` again, or "
        "give --trained.",
        CLEANED, workspace.command_of(CLEAN), extra={"code": "cleaned-model-stale"},
    )  # fmt: skip
    return trained, "trained"


@dataclass(frozen=True)
class PlacedSplat:
    """Splat in the frame `file` of its placement, the number of Gaussians that were left out, and their model.

    `mip_filter`: the training had it, and renders of the splat need it.
    """

    gaussians: Gaussians
    placement: Placement
    left_out: int
    model: Origin = "trained"
    mip_filter: bool = False


@dataclass(frozen=True)
class SplatParts:
    """Splat in the frame `file` of its placement, read part by part: each block of a training in blocks is one.

    Attributes:
        path, rows: file of the trained Gaussians, and a range of its rows for each part.
        center_in_file: (N, 3) metres, of all Gaussians that are delivered.
        left_out: number of those that are too transparent, or outside the crop.
        sh_degree: of the harmonics to deliver.
    """

    path: Path
    rows: tuple[slice, ...]
    placement: Placement
    center_in_file: Float32Array
    left_out: int
    sh_degree: int
    options: CropOptions
    crop: Crop | None
    model: Origin = "trained"

    def __iter__(self) -> Iterator[SplatArrays]:
        """Yield the Gaussians of each part that are delivered, if it has any."""
        for rows in self.rows:
            gaussians = read_gaussians(self.path, rows)
            chosen = _chosen(gaussians.means.numpy(), gaussians.logit_opacities.numpy(), self.options, self.crop)
            if chosen.any():
                kept = gaussians.select(torch.from_numpy(chosen))
                yield codec_arrays(transformed(kept, self.placement.file_from_model), self.sh_degree)


def splat_values(splat: PlacedSplat | SplatParts) -> dict[str, object]:
    """Return what every deliverable of the splat tells: counts, origin, accuracy, σ of the georeference."""
    placement = splat.placement
    count = len(splat.gaussians if isinstance(splat, PlacedSplat) else splat.center_in_file)
    accuracy, sigma = placement.accuracy, placement.georeference_sigma
    return {
        "model": splat.model,
        "gaussians": count,
        "left_out": splat.left_out,
        "origin_lla": None if placement.origin_lla is None else vector3(placement.origin_lla),
        "stated_accuracy": None if accuracy is None else accuracy.text,
        "georeference_sigma_h_m": None if sigma is None else sigma.sigma_h_m,
        "georeference_sigma_v_m": None if sigma is None else sigma.sigma_v_m,
    }


def load_splat(workspace: Workspace, options: SplatOptions) -> PlacedSplat:
    """Return the splat of a workspace, placed on Earth; a DegenerateGeometryError: no Gaussian is opaque enough."""
    path, origin = model_to_deliver(workspace, options)
    model = read_trained(workspace)
    placement = _placement_of(workspace, model)
    splat = placed_splat(read_gaussians(path), placement, options, crop_of(workspace, options))
    return replace(splat, model=origin, mip_filter=model.mip_filter)


def _placement_of(workspace: Workspace, model: TrainedModel) -> Placement:
    survey = load_survey(workspace)
    return solved_placement(model, survey, read_centres(workspace.path(GAUSSIANS)), headline_of(workspace))


def load_splat_parts(workspace: Workspace, options: WebSplatOptions) -> SplatParts:
    """Return the splat of a workspace, placed on Earth, to be read part by part; a GeorefError: as `load_splat`."""
    path, origin = model_to_deliver(workspace, options)
    centers, crop = read_centres(path), crop_of(workspace, options)
    chosen = _chosen(centers, read_logit_opacities(path), options, crop)
    _require_any(chosen, options)
    placement = _placement_of(workspace, read_trained(workspace))
    center_in_file = placement.file_from_model.apply(centers[chosen]).astype(np.float32)
    whole = (slice(0, len(centers)),)
    rows = whole if origin == "cleaned" else _rows_of_blocks(workspace, len(centers))
    trained = read_gaussians(path, slice(0, 1)).sh_degree
    degree = trained if options.sh_degree is None else min(options.sh_degree, trained)
    return SplatParts(path, rows, placement, center_in_file, int((~chosen).sum()), degree, options, crop, origin)


def _rows_of_blocks(workspace: Workspace, count: int) -> tuple[slice, ...]:
    """Return the ranges of rows that blocks have trained; of another training, one range.

    Raises:
        InputError: the record of the blocks speaks of another number of Gaussians.
    """
    record = workspace.root / BLOCK_RECORD
    if not record.is_file():
        return (slice(0, count),)
    numbers = [block.training.gaussians_in_cell for block in load_json(BlockRecord, record).blocks]
    ends = np.cumsum([0, *numbers]).tolist()
    if ends[-1] != count:
        message = (
            f"The blocks have {ends[-1]} Gaussians, and {GAUSSIANS} has {count}. Run `georef train --force` again."
        )
        raise InputError("blocks-mismatch", message, path=record)
    return tuple(slice(first, last) for first, last in itertools.pairwise(ends))


def placed_splat(
    gaussians: Gaussians, placement: Placement, options: CropOptions, crop: Crop | None = None
) -> PlacedSplat:
    """Return the Gaussians to deliver, moved from `model` to the placement; a DegenerateGeometryError: none is."""
    chosen = _chosen(gaussians.means.numpy(), gaussians.logit_opacities.numpy(), options, crop)
    _require_any(chosen, options)
    kept = gaussians.select(torch.from_numpy(chosen))
    return PlacedSplat(transformed(kept, placement.file_from_model), placement, len(gaussians) - len(kept))


def _chosen(
    center_in_model: FloatArray | Float32Array,
    logit_opacities: Float32Array,
    options: CropOptions,
    crop: Crop | None,
) -> BoolArray:
    opaque: BoolArray = expit(logit_opacities) >= options.min_opacity
    return opaque if crop is None else opaque & crop.keeps(center_in_model)


def _require_any(chosen: BoolArray, options: CropOptions) -> None:
    if not chosen.any():
        raise DegenerateGeometryError(
            "no-opaque-gaussians",
            f"None of {len(chosen)} Gaussians has an opacity of {options.min_opacity} or more, inside the area if "
            "one was asked for. Lower --min-opacity, or check --boundary.",
        )


def codec_arrays(gaussians: Gaussians, sh_degree: int | None = None) -> SplatArrays:
    """Return Gaussians for a codec, with spherical harmonics up to a degree; None: all that there are."""
    arrays = gaussians.arrays()
    if sh_degree is not None:
        arrays["sh"] = arrays["sh"][:, : coefficient_count(sh_degree)]
    return SplatArrays(**arrays)
