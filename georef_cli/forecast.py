"""Forecast of a run: what its stages would do, for which photographs, for how long, with how much memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.core.options import StageOptions
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.plan import PlannedStage, plan
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Summary, Workspace
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
    reconstruction, training = _reconstruction(planned, photographs), _training(planned, photographs)
    for name, forecast in (("sfm", reconstruction), ("train", training)):
        if forecast is not None and forecast.refusal:
            planned = [_refused(row, forecast.refusal) if row.stage == name else row for row in planned]
    seconds: dict[str, float | None] = {}
    for options, known in ((SfmOptions, reconstruction), (TrainOptions, training)):
        row = _to_run(planned, options)
        if row is not None and known is not None:
            seconds[row.stage] = known.seconds
    return RunForecast(planned, photographs, seconds, reconstruction, training)


def checked_inputs(
    workspace: Workspace, planned: Sequence[PlannedStage], progress: Progress = SILENT
) -> Summary | None:
    """Return the summary of the survey that `ingest` would make; None where it would not run. Nothing is written.

    Raises:
        InputError: as `ingest` itself would.
    """
    row = _to_run(planned, IngestOptions)
    if row is None:
        return None
    from pipelines.ingest.stage import check_inputs

    assert isinstance(row.resolved, IngestOptions)
    return check_inputs(workspace, row.resolved, progress)


def _to_run(planned: Sequence[PlannedStage], options: type[StageOptions]) -> PlannedStage | None:
    """Return the stage with such options that will run; None: it will not."""
    going = (row for row in planned if row.action not in ("keep", "refuse"))
    return next((row for row in going if isinstance(row.resolved, options)), None)


def _refused(row: PlannedStage, reason: str) -> PlannedStage:
    return replace(row, action="refuse", reason=reason)


def _reconstruction(
    planned: Sequence[PlannedStage], photographs: Photographs | None
) -> ReconstructionForecast | None:
    """Return the forecast of the reconstruction; None where none would run, or before a bag is read."""
    from pipelines.sfm.forecast import forecast

    row = _to_run(planned, SfmOptions)
    if row is None or photographs is None:
        return None
    assert isinstance(row.resolved, SfmOptions)
    return forecast(photographs.count, photographs.size_px, row.resolved)


def _photographs(workspace: Workspace, planned: list[PlannedStage]) -> Photographs | None:
    """Return the photographs of the survey, or of the folder ahead of `ingest`; None for a bag not read yet."""
    ingest = next((row for row in planned if row.stage == "ingest" and row.action != "keep"), None)
    if ingest is None:
        if not (workspace.root / SURVEY).is_file():
            return None
        survey = load_json(Survey, workspace.path(SURVEY))
        folder = photograph_folder(workspace, survey.image_dir)
        sizes = [path.stat().st_size for image in survey.images if (path := folder / image.name).is_file()]
        return Photographs(len(survey.images), survey.largest_photograph_px, sum(sizes) or None)
    assert isinstance(ingest.resolved, IngestOptions)
    return None if ingest.resolved.images is None else _in_folder(ingest.resolved.images)


def _in_folder(folder: Path) -> Photographs:
    from pipelines.ingest.photo_folder import glance

    count, total_bytes, size_px = glance(folder)
    return Photographs(count, size_px, total_bytes)


def _training(planned: Sequence[PlannedStage], photographs: Photographs | None) -> TrainingForecast | None:
    """Return the forecast of the training; None where none would run, or before a bag is read."""
    from pipelines.train.forecast import forecast

    row = _to_run(planned, TrainOptions)
    if row is None or photographs is None:
        return None
    assert isinstance(row.resolved, TrainOptions)
    return forecast(photographs.count, photographs.size_px, row.resolved)
