"""A trained workspace with known Gaussians, for the tests of the deliverables of the splat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pipelines.core.products import save_json
from pipelines.core.stages import GAUSSIANS, MODEL, SURVEY
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geodesy.enu import Origin, ecef_from_enu
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, write_gaussians
from pipelines.survey.block_plan import BlockTraining
from pipelines.survey.survey import Survey
from tests.scenes import trained_model

ORIGIN = Origin(lat_deg=50.8231, lon_deg=-0.1372, alt_m=55.0)
# The scene lies 3 km from the survey's origin, where vertical and north have visibly turned.
GEO_FROM_MODEL = Similarity(1.3, exp_so3(np.array([0.4, -1.1, 2.0])), np.array([2500.0, -1800.0, 40.0]))


def splat_arrays(count: int = 40, seed: int = 3, extent_m: float = 4.0) -> SplatArrays:
    """Return Gaussians of degree 3 around the origin, all of them opaque enough to be delivered."""
    rng = np.random.default_rng(seed)

    def rows(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return SplatArrays(extent_m * rows(3), rows(4), 0.3 * rows(3) - 1.5, rows() + 1, 0.2 * rows(16, 3))


def covariance() -> FloatArray:
    """Return a covariance (7, 7) of the similarity, about the origin of geo."""
    half = np.random.default_rng(0).normal(size=(7, 7)) * np.array([1e-5, 1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.02])
    return np.asarray(half.T @ half)


def write_trained(root: Path, splat: SplatArrays, folder: str) -> StageRun:
    """Write a workspace with these Gaussians in the frame `model`, and return the run of a stage in it."""
    survey = Survey(
        origin=ORIGIN,
        source_crs="EPSG:4326",
        vertical=VerticalDatum(name="EGM2008", stated=True),
        image_dir="images",
        cameras=(),
        images=(),
    )
    record = GEO_FROM_MODEL.to_record("model", "geo", covariance=covariance())
    save_json(survey, root / SURVEY)
    save_json(trained_model(GEO_FROM_MODEL).model_copy(update={"geo_from_model": record}), root / MODEL)
    write_gaussians(root / GAUSSIANS, Gaussians(**{name: torch.tensor(a) for name, a in vars(splat).items()}))
    out = root / f"{folder}.partial"
    out.mkdir()
    return StageRun(Workspace(root), out)


def block_training(count: int) -> BlockTraining:
    """Return the record of a block with so many Gaussians in its cell."""
    return BlockTraining(
        id=0,
        iterations=1,
        gaussians=count,
        gaussians_in_cell=count,
        photographs=1,
        seconds=1.0,
        processor_s=None,
        mean_gaussians=count,
        mean_visible=count,
        mean_px=1.0,
        surroundings=0,
        peak_bytes=None,
        threads=1,
        backend="cpu",
        train_psnr=20.0,
    )


def true_ecef(splat: SplatArrays) -> FloatArray:
    """Return the true places (N, 3) of Gaussians that are in the frame `model`."""
    return ecef_from_enu(GEO_FROM_MODEL.apply(splat.means), ORIGIN)
