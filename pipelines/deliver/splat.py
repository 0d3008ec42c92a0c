"""The splat to deliver: the opaque Gaussians of the trained model, in the frame of the placement."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.special import expit

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import load_json
from pipelines.core.stages import BLOCK_RECORD, GAUSSIANS, MODEL
from pipelines.core.types import BoolArray, Float32Array, FloatArray, vector3
from pipelines.core.workspace import Workspace
from pipelines.deliver.options import SplatOptions, WebSplatOptions
from pipelines.deliver.placement import Placement, place
from pipelines.formats.splat_ply import SplatArrays, read_centres, read_logit_opacities
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, read_gaussians, transformed
from pipelines.splat.sh import coefficient_count
from pipelines.surface.measured_area import area_of
from pipelines.survey.area import Area
from pipelines.survey.block_plan import BlockRecord
from pipelines.survey.calibrated import load_survey
from pipelines.survey.headline import headline_of
from pipelines.survey.trained_model import TrainedModel
from pipelines.survey.trained_survey import load_cameras


@dataclass(frozen=True)
class Crop:
    """Area outside which Gaussians are left out; those higher than `sky_m` in `geo` stay."""

    area: Area
    geo_from_model: Similarity
    sky_m: float

    def keeps(self, center_in_model: FloatArray | Float32Array) -> BoolArray:
        """Return which of Gaussians' centres (N, 3) stay."""
        center = self.geo_from_model.apply(center_in_model)
        return self.area.contains(center) | (center[:, 2] > self.sky_m)


def crop_of(workspace: Workspace, options: SplatOptions) -> Crop | None:
    """Return the crop that the options ask for; None: none. Errors as of `load_cameras` and `area_of`.

    The sky is what lies higher than all cameras.
    """
    if not options.crop and options.boundary is None:
        return None
    solved = load_cameras(workspace)
    cameras = solved.geo_from_model.apply(solved.poses.cam_center_in_model)
    sky_m = float(cameras[:, 2].max()) if options.keep_sky else np.inf
    return Crop(area_of(options, solved, workspace), solved.geo_from_model, sky_m)


@dataclass(frozen=True)
class PlacedSplat:
    """Splat in the frame `file` of its placement, and the number of Gaussians that were left out."""

    gaussians: Gaussians
    placement: Placement
    left_out: int


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
    options: SplatOptions
    crop: Crop | None

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
        "gaussians": count,
        "left_out": splat.left_out,
        "origin_lla": None if placement.origin_lla is None else vector3(placement.origin_lla),
        "stated_accuracy": None if accuracy is None else accuracy.text,
        "georeference_sigma_h_m": None if sigma is None else sigma.sigma_h_m,
        "georeference_sigma_v_m": None if sigma is None else sigma.sigma_v_m,
    }


def load_splat(workspace: Workspace, options: SplatOptions) -> PlacedSplat:
    """Return the splat of a workspace, placed on Earth; a DegenerateGeometryError: no Gaussian is opaque enough."""
    survey, model = load_survey(workspace), load_json(TrainedModel, workspace.path(MODEL))
    gaussians = read_gaussians(workspace.path(GAUSSIANS))
    placement = place(model, survey, gaussians.means.numpy(), headline_of(workspace))
    return placed_splat(gaussians, placement, options, crop_of(workspace, options))


def load_splat_parts(workspace: Workspace, options: WebSplatOptions) -> SplatParts:
    """Return the splat of a workspace, placed on Earth, to be read part by part; a GeorefError: as `load_splat`."""
    survey, model = load_survey(workspace), load_json(TrainedModel, workspace.path(MODEL))
    path = workspace.path(GAUSSIANS)
    centers, crop = read_centres(path), crop_of(workspace, options)
    chosen = _chosen(centers, read_logit_opacities(path), options, crop)
    _require_any(chosen, options)
    placement = place(model, survey, centers, headline_of(workspace))
    center_in_file = placement.file_from_model.apply(centers[chosen]).astype(np.float32)
    rows = _rows_of_blocks(workspace, len(centers))
    trained = read_gaussians(path, slice(0, 1)).sh_degree
    degree = trained if options.sh_degree is None else min(options.sh_degree, trained)
    return SplatParts(path, rows, placement, center_in_file, int((~chosen).sum()), degree, options, crop)


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
        message = f"The blocks have {ends[-1]} Gaussians, and {GAUSSIANS} has {count}. Run `georef blocks` again."
        raise InputError("blocks-mismatch", message, path=record)
    return tuple(slice(first, last) for first, last in itertools.pairwise(ends))


def placed_splat(
    gaussians: Gaussians, placement: Placement, options: SplatOptions, crop: Crop | None = None
) -> PlacedSplat:
    """Return the Gaussians to deliver, moved from `model` to the placement; a DegenerateGeometryError: none is."""
    chosen = _chosen(gaussians.means.numpy(), gaussians.logit_opacities.numpy(), options, crop)
    _require_any(chosen, options)
    kept = gaussians.select(torch.from_numpy(chosen))
    return PlacedSplat(transformed(kept, placement.file_from_model), placement, len(gaussians) - len(kept))


def _chosen(
    center_in_model: FloatArray | Float32Array,
    logit_opacities: Float32Array,
    options: SplatOptions,
    crop: Crop | None,
) -> BoolArray:
    opaque: BoolArray = expit(logit_opacities) >= options.min_opacity
    return opaque if crop is None else opaque & crop.keeps(center_in_model)


def _require_any(chosen: BoolArray, options: SplatOptions) -> None:
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
