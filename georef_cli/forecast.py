"""Forecast of a run: what its stages would do, for which photographs, for how long, with how much memory.

Dry run: what the stages would do, with which options, for how long and with how much memory.

Time left of a whole run, from the forecast of its stages and the pace of those that are done.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from georef_cli import tables
from georef_cli.layout import plain_table, shown
from georef_cli.output import print_json, print_rich, size
from georef_cli.tables import Renderable
from pipelines.core.errors import GeorefError
from pipelines.core.options import StageOptions, notation
from pipelines.core.plan import PlannedStage, photograph_folder, plan
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.sentences import about
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Summary, Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey
from pipelines.train.options import TrainOptions

if TYPE_CHECKING:
    from pipelines.sfm.forecast import ReconstructionForecast
    from pipelines.train.forecast import TrainingForecast

log = logging.getLogger(__name__)


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
    from pipelines.sfm.reconstructor import reconstructor_of

    row = _to_run(planned, SfmOptions)
    if row is None or photographs is None:
        return None
    assert isinstance(row.resolved, SfmOptions)
    return reconstructor_of(row.resolved).forecast(photographs.count, photographs.size_px, row.resolved)


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


_STYLE = {
    "run": "yellow",
    "perhaps": "yellow",
    "resume": "cyan",
    "extend": "cyan",
    "keep": "green",
    "refuse": "red",
}


def print_dry_run(
    workspace: Workspace,
    stages: tuple[StageSpec, ...],
    flags: Mapping[str, Flags],
    *,
    force: bool,
    as_json: bool,
    progress: Progress,
) -> None:
    """Print what a run of the stages would do, and what `ingest` would find; nothing is written.

    Args:
        workspace: may not exist yet.
        stages: in the order of the pipeline.
        flags: all options by stage, the remembered ones among them.
        force: as of the run.
        as_json: print one document.
        progress: shows the reading of the photographs' tags.

    Raises:
        GeorefError: the run would be refused for its options or its input.
    """
    run = forecast_run(workspace, stages, flags, force=force)
    survey = checked_inputs(workspace, run.planned, progress)
    for warning in () if survey is None else survey.warnings:
        log.warning("ingest: %s", warning)
    if as_json:
        print_json(_document(workspace, run, survey))
        return
    table = plain_table("stage", "", "about", "why", right=[2])
    for row in run.planned:
        action = f"[{_STYLE[row.action]}]{row.action}[/]"
        table.add_row(row.stage, action, about(run.seconds.get(row.stage)), shown(row.reason))
    parts: list[Renderable] = [table, *tables.origins([origin for row in run.planned for origin in row.options])]
    if run.photographs is not None:
        width, height = run.photographs.size_px
        files = "" if run.photographs.bytes is None else f", {size(run.photographs.bytes)}"
        parts.append(f"\n[bold]Photographs[/]: {run.photographs.count} of {width}×{height} px{files}")
    if survey is not None:
        parts.append(f"\n[bold]Survey[/]: {shown(survey.key_figure)}")
    if run.reconstruction is not None:
        parts += ["\n[bold]Reconstruction[/]", *(f"  {shown(text)}" for text in run.reconstruction.sentences())]
    if run.training is not None:
        parts += ["\n[bold]Training[/]", *(f"  {shown(text)}" for text in run.training.sentences())]
    print_rich(*parts, "\n[dim]Nothing was run. Times are estimates for an idle machine.[/]")


def announce_training(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> None:
    """Log the forecast of the training that a run will come to, at its start: not after hours of other stages.

    Args:
        workspace, stages, flags, force: as for `print_dry_run`. A run that will be refused is announced by nothing.
    """
    if all(spec.options is not TrainOptions for spec in stages):
        return
    with contextlib.suppress(GeorefError):
        training = forecast_run(workspace, stages, flags, force=force).training
        for sentence in () if training is None else training.sentences():
            log.info("train: %s", sentence)


def _document(workspace: Workspace, run: RunForecast, survey: Summary | None) -> dict[str, Any]:
    stages = [
        {
            "stage": row.stage,
            "action": row.action,
            "reason": row.reason,
            "seconds": run.seconds.get(row.stage),
            "options": [{**dataclasses.asdict(origin), "value": notation(origin.value)} for origin in row.options],
        }
        for row in run.planned
    ]
    return {
        "workspace": str(workspace.root),
        "stages": stages,
        "survey": survey and {name: getattr(survey, name) for name in ("key_figure", "values", "warnings")},
        "photographs": run.photographs and dataclasses.asdict(run.photographs),
        "reconstruction": run.reconstruction and dataclasses.asdict(run.reconstruction),
        "training": run.training and dataclasses.asdict(run.training),
    }


class RunTimeLeft:
    """Time that the remaining stages of a run will take.

    Stages that the forecast knows no time for count as nothing: they take seconds. Stages that are done correct the
    forecast of the others, because one machine is slower than another by a factor.

    Args:
        seconds: forecast by stage, of those that take long; None: not known.
        clock: returns seconds.
    """

    def __init__(self, seconds: Mapping[str, float | None], clock: Callable[[], float] = time.monotonic) -> None:
        self._unknown = any(value is None for value in seconds.values())
        self._left = {stage: value for stage, value in seconds.items() if value is not None}
        self._clock, self._began = clock, clock()
        self._forecast_s = self._took_s = 0.0

    def begin(self) -> None:
        """Begin to measure a stage."""
        self._began = self._clock()

    def end(self, stage: str) -> None:
        """Note the end of a stage."""
        forecast_s = self._left.pop(stage, 0.0)
        if forecast_s:
            self._forecast_s += forecast_s
            self._took_s += self._clock() - self._began

    @property
    def seconds(self) -> float | None:
        """Seconds that the stages not yet done will take; None: not known."""
        if self._unknown:
            return None
        return sum(self._left.values()) * (self._took_s / self._forecast_s if self._forecast_s else 1.0)
