"""The pipeline at a glance: every stage, what it reads, and which module does it.

Light on purpose: `georef status` and `--help` read this table without importing a stage.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.config import (
    AdjustConfig,
    CalibrateConfig,
    EvaluateConfig,
    ExportPlyConfig,
    GeolocateConfig,
    InitSim3Config,
    SfmConfig,
    StageConfig,
)
from pipelines.errors import GeorefError
from pipelines.ingest_config import IngestConfig
from pipelines.train_config import TrainConfig

SURVEY = "ingest/survey.json"
TRACK = "ingest/track.npz"  # not always there
SPARSE = "sfm/sparse"
POINTS = "geolocate/points.npz"
SIM3 = "sim3/geo_from_local.json"
MODEL = "train/model.json"
GAUSSIANS = "train/gaussians.ply"
REPORT = "evaluate/report.json"
SPLAT = "export/splat.ply"


@dataclass(frozen=True)
class StageSpec:
    """One stage.

    Attributes:
        name: the subcommand.
        module: where `run(stage, config) -> Summary` lives.
        config: its options.
        folder: its folder in the workspace.
        reads: workspace paths (files or folders) that decide its result.
        product: the path that later stages and people look for.
        photographs_only: whether it reads nothing of the survey but photographs, cameras, and the positions and
            attitudes as recorded: control points, σ and what `calibrate` applies do not make it stale.
        title: one line of help.
        resumable: whether a partial product can be continued.
        also: further paths in its folder that others look for, besides what the stages of the pipeline read.
    """

    name: str
    module: str
    config: type[StageConfig]
    folder: str
    reads: tuple[str, ...]
    product: str
    title: str
    resumable: bool = False
    also: tuple[str, ...] = ()
    photographs_only: bool = False


PIPELINE: tuple[StageSpec, ...] = (
    StageSpec(
        "ingest", "pipelines.ingest", IngestConfig, "ingest", (), SURVEY,
        "Read photographs, positions, attitudes and control points into one survey.",
    ),
    StageSpec(
        "sfm", "pipelines.sfm", SfmConfig, "sfm", (SURVEY,), SPARSE,
        "Reconstruct cameras and points with COLMAP.", resumable=True, photographs_only=True,
    ),
    StageSpec(
        "geolocate", "pipelines.geolocate", GeolocateConfig, "geolocate", (SURVEY, SPARSE), POINTS,
        "Intersect every SfM point on Earth from the measured positions and attitudes.",
    ),
    StageSpec(
        "init-sim3", "pipelines.init_sim3", InitSim3Config, "sim3", (SURVEY, SPARSE, POINTS), SIM3,
        "Estimate the similarity from the SfM model to the Earth.",
    ),
    StageSpec(
        "train", "pipelines.train", TrainConfig, "train", (SURVEY, SPARSE, SIM3, POINTS), MODEL,
        "Train the Gaussians together with the similarity and the cameras.", resumable=True,
    ),
    StageSpec(
        "evaluate", "pipelines.evaluate", EvaluateConfig, "evaluate",
        (SURVEY, SPARSE, MODEL, GAUSSIANS, SIM3), REPORT,
        "Measure test views and check points.",
    ),
    StageSpec(
        "export-ply", "pipelines.export_ply", ExportPlyConfig, "export",
        (SURVEY, MODEL, GAUSSIANS), SPLAT,
        "Write the splat as a PLY that knows where it is.",
    ),
)  # fmt: skip

# Not part of the line: `georef compare` runs it for the baseline, whose later stages find in its folder what they
# otherwise read from those of sfm and init-sim3.
ADJUST = StageSpec(
    "adjust", "pipelines.adjust", AdjustConfig, "adjust", (SURVEY, SPARSE), "adjust/sparse",
    "Adjust the bundle with the fixes as priors of the camera positions.", also=("adjust/geo_from_local.json",),
)  # fmt: skip

STAGES = (*PIPELINE, ADJUST)
# Between sfm and what builds on the survey's positions: makes the survey anew where it asks for that.
CALIBRATE = StageSpec(
    "calibrate", "pipelines.calibrate", CalibrateConfig, "ingest", (SURVEY, SPARSE), SURVEY,
    "Estimate time offset, boresight and lever arm after sfm.",
)  # fmt: skip
CALIBRATED_BEFORE = "geolocate"

BY_NAME = {spec.name: spec for spec in PIPELINE}
CONFIGS = {spec.name: spec.config for spec in PIPELINE}


def producer_of(path: str) -> StageSpec:
    """The stage that writes a workspace path."""
    folder = path.split("/", maxsplit=1)[0]
    return next(spec for spec in STAGES if spec.folder == folder)


def products_of(spec: StageSpec) -> tuple[str, ...]:
    """Everything in a stage's folder that people or later stages look for."""
    read = (path for other in PIPELINE for path in other.reads if producer_of(path) is spec)
    return tuple(dict.fromkeys((spec.product, *spec.also, *read)))


def stage_slice(first: str | None, last: str | None) -> tuple[StageSpec, ...]:
    """The stages from `first` to `last`, both included.

    Raises:
        GeorefError: `first` comes after `last`.
    """
    names = [spec.name for spec in PIPELINE]
    begin = names.index(first) if first else 0
    end = names.index(last) if last else len(names) - 1
    if begin > end:
        raise GeorefError(f"--from {first} comes after --to {last}: the order is {', '.join(names)}")
    return PIPELINE[begin : end + 1]
