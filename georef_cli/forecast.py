"""Forecast of a run: what its stages would do, for which photographs, for how long, with how much memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.plan import PlannedStage, plan
from pipelines.core.products import load_json
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.scene.survey import Survey
from pipelines.sfm.options import SfmOptions
from pipelines.train.options import TrainOptions

if TYPE_CHECKING:
    from pipelines.sfm.forecast import ReconstructionForecast
    from pipelines.train.forecast import TrainingForecast


@dataclass(frozen=True)
class Photographs:
    """Photographs of a survey at a glance.

    Attributes:
        count: their number.
        size_px: width and height of the first, or of the largest camera.
        bytes: size of the files; None: not known without reading a bag.
    """

    count: int
    size_px: tuple[int, int]
    bytes: int | None


@dataclass(frozen=True)
class RunForecast:
    """Forecast of a run.

    Attributes:
        planned: what each stage would do.
        photographs: of the survey; None: in a bag that was not read yet.
        seconds: about, by stage, of those that take long.
        reconstruction: None where none would run, or before a bag is read.
        training: None where none would run, or before a bag is read.
    """

    planned: Sequence[PlannedStage]
    photographs: Photographs | None
    seconds: Mapping[str, float | None]
    reconstruction: ReconstructionForecast | None
    training: TrainingForecast | None


def forecast_run(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> RunForecast:
    """Return the forecast of a run of the stages; nothing is written.

    Args:
        workspace: may not exist yet.
        stages: in the order of the pipeline.
        flags: all options by stage, the remembered ones among them.
        force: as of the run.

    Raises:
        GeorefError: the run would be refused for its options, or for a missing file.
    """
    planned = plan(workspace, stages, flags, force=force)
    photographs = _photographs(workspace, planned)
    reconstruction = _reconstruction(planned, photographs)
    if reconstruction is not None and reconstruction.refusal:
        planned = [_refused(row, reconstruction) if row.stage == "sfm" else row for row in planned]
    seconds = _seconds(planned, photographs, reconstruction)
    return RunForecast(planned, photographs, seconds, reconstruction, _training(planned, photographs))


def _refused(row: PlannedStage, reconstruction: ReconstructionForecast) -> PlannedStage:
    return replace(row, action="refuse", reason=reconstruction.refusal)


def _reconstruction(
    planned: Sequence[PlannedStage], photographs: Photographs | None
) -> ReconstructionForecast | None:
    """Return the forecast of the reconstruction; None where none would run, or before a bag is read."""
    from pipelines.sfm.forecast import forecast

    for row in planned:
        if (
            isinstance(row.resolved, SfmOptions)
            and row.action not in ("keep", "refuse")
            and photographs is not None
        ):
            return forecast(photographs.count, photographs.size_px, row.resolved)
    return None


def _photographs(workspace: Workspace, planned: list[PlannedStage]) -> Photographs | None:
    """Return the photographs of the survey, or of the folder ahead of `ingest`; None for a bag not read yet."""
    ingest = next((row for row in planned if row.stage == "ingest" and row.action != "keep"), None)
    if ingest is None:
        if not (workspace.root / SURVEY).is_file():
            return None
        survey = load_json(Survey, workspace.path(SURVEY))
        largest = max(survey.cameras, key=lambda camera: camera.width * camera.height)
        folder = photograph_folder(workspace, survey.image_dir)
        sizes = [path.stat().st_size for image in survey.images if (path := folder / image.name).is_file()]
        return Photographs(len(survey.images), (largest.width, largest.height), sum(sizes) or None)
    assert isinstance(ingest.resolved, IngestOptions)
    return None if ingest.resolved.images is None else _in_folder(ingest.resolved.images)


def _in_folder(folder: Path) -> Photographs:
    from pipelines.ingest.photo_folder import glance

    count, total_bytes, size_px = glance(folder)
    return Photographs(count, size_px, total_bytes)


def _seconds(
    planned: list[PlannedStage], photographs: Photographs | None, reconstruction: ReconstructionForecast | None
) -> dict[str, float | None]:
    """Return the seconds of the stages that take long."""
    seconds: dict[str, float | None] = {}
    for row in planned:
        if photographs is None or row.action in ("keep", "refuse"):
            continue
        if isinstance(row.resolved, SfmOptions):
            seconds[row.stage] = 0.0 if reconstruction is None else reconstruction.seconds
        elif isinstance(row.resolved, TrainOptions):
            forecast = _training([row], photographs)
            seconds[row.stage] = None if forecast is None else forecast.seconds
    return seconds


def _training(planned: list[PlannedStage], photographs: Photographs | None) -> TrainingForecast | None:
    """Return the forecast of the training; None where none would run, or before a bag is read."""
    from pipelines.train.forecast import forecast

    for row in planned:
        if (
            isinstance(row.resolved, TrainOptions)
            and row.action not in ("keep", "refuse")
            and photographs is not None
        ):
            return forecast(photographs.count, photographs.size_px, row.resolved)
    return None
