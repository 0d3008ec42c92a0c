"""The pipeline at a glance: every stage, what it reads, and which module does it.

Light on purpose: `georef status` and `--help` read this table without importing a stage.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from pipelines.core.errors import GeorefError
from pipelines.core.options import StageOptions

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
        options_place: where the class of its options lives, `module:class`.
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
    options_place: str
    folder: str
    reads: tuple[str, ...]
    product: str
    title: str
    resumable: bool = False
    also: tuple[str, ...] = ()
    photographs_only: bool = False

    @property
    def options(self) -> type[StageOptions]:
        """The class of its options, imported when it is asked for."""
        module, _, name = self.options_place.partition(":")
        options: type[StageOptions] = getattr(importlib.import_module(module), name)
        return options


PIPELINE: tuple[StageSpec, ...] = (
    StageSpec(
        name="ingest",
        module="pipelines.ingest.stage",
        options_place="pipelines.ingest.options:IngestOptions",
        folder="ingest",
        reads=(),
        product=SURVEY,
        title="Read photographs, positions, attitudes and control points into one survey.",
    ),
    StageSpec(
        name="sfm",
        module="pipelines.sfm.stage",
        options_place="pipelines.sfm.options:SfmOptions",
        folder="sfm",
        reads=(SURVEY,),
        product=SPARSE,
        title="Reconstruct cameras and points with COLMAP.",
        resumable=True,
        photographs_only=True,
    ),
    StageSpec(
        name="geolocate",
        module="pipelines.geolocate.stage",
        options_place="pipelines.geolocate.options:GeolocateOptions",
        folder="geolocate",
        reads=(SURVEY, SPARSE),
        product=POINTS,
        title="Intersect every SfM point on Earth from the measured positions and attitudes.",
    ),
    StageSpec(
        name="init-sim3",
        module="pipelines.init_sim3.stage",
        options_place="pipelines.init_sim3.options:InitSim3Options",
        folder="sim3",
        reads=(SURVEY, SPARSE, POINTS),
        product=SIM3,
        title="Estimate the similarity from the SfM model to the Earth.",
    ),
    StageSpec(
        name="train",
        module="pipelines.train.stage",
        options_place="pipelines.train.options:TrainOptions",
        folder="train",
        reads=(SURVEY, SPARSE, SIM3, POINTS),
        product=MODEL,
        title="Train the Gaussians together with the similarity and the cameras.",
        resumable=True,
    ),
    StageSpec(
        name="evaluate",
        module="pipelines.evaluate.stage",
        options_place="pipelines.evaluate.options:EvaluateOptions",
        folder="evaluate",
        reads=(SURVEY, SPARSE, MODEL, GAUSSIANS, SIM3),
        product=REPORT,
        title="Measure test views and check points.",
    ),
    StageSpec(
        name="export-ply",
        module="pipelines.deliver.ply",
        options_place="pipelines.deliver.options:ExportPlyOptions",
        folder="export",
        reads=(SURVEY, MODEL, GAUSSIANS),
        product=SPLAT,
        title="Write the splat as a PLY that knows where it is.",
    ),
)

# Not part of the line: `georef compare` runs it for the baseline, whose later stages find in its folder what they
# otherwise read from those of sfm and init-sim3.
ADJUST = StageSpec(
    name="adjust",
    module="pipelines.sfm.pose_prior",
    options_place="pipelines.sfm.options:AdjustOptions",
    folder="adjust",
    reads=(SURVEY, SPARSE),
    product="adjust/sparse",
    title="Adjust the bundle with the fixes as priors of the camera positions.",
    also=("adjust/geo_from_local.json",),
)

STAGES = (*PIPELINE, ADJUST)
# Between sfm and what builds on the survey's positions: makes the survey anew where it asks for that.
CALIBRATE = StageSpec(
    name="calibrate",
    module="pipelines.calibrate.stage",
    options_place="pipelines.calibrate.options:CalibrateOptions",
    folder="ingest",
    reads=(SURVEY, SPARSE),
    product=SURVEY,
    title="Estimate time offset, boresight and lever arm after sfm.",
)
CALIBRATED_BEFORE = "geolocate"

BY_NAME = {spec.name: spec for spec in PIPELINE}


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
