"""Estimate of a run: what its stages would do, for which photographs, for how long, with how much memory.

A dry run prints it. A run derives its remaining time from it, corrected by the times of the stages that are done.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from georef_cli import tables
from georef_cli.layout import plain_table, shown
from georef_cli.output import print_json, print_rich, size
from georef_cli.tables import Renderable
from pipelines.core.errors import GeorefError
from pipelines.core.options import OptionsT, notation, require_available
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
    from pipelines.sfm.estimate import ReconstructionEstimate
    from pipelines.train.estimate import TrainingEstimate

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FoundPhotographs:
    """Photographs of a survey at a glance."""

    count: int
    size_px: tuple[int, int]  # of the first, or of the largest camera
    bytes: int | None  # size of the files; None: not known without reading a bag


@dataclass(frozen=True)
class RunEstimate:
    """Estimate of a run."""

    planned: Sequence[PlannedStage]
    photographs: FoundPhotographs | None  # None: in a bag that was not read yet
    seconds: Mapping[str, float | None]  # about, by stage, of those that take long
    reconstruction: ReconstructionEstimate | None  # None where none would run, or before a bag is read
    training: TrainingEstimate | None  # likewise


def estimate_run(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> RunEstimate:
    """Return the estimate of a run, as of `plan`; nothing is written. A GeorefError: the run would be refused."""
    from pipelines.sfm.reconstructor import reconstructor_of
    from pipelines.train.estimate import estimate_training

    planned = plan(workspace, stages, flags, force=force)
    for row in planned:
        if row.action not in ("keep", "refuse"):
            require_available(row.resolved)
    photographs = _photographs(workspace, planned)
    reconstruction, training = None, None
    if photographs is not None:
        photo_px = photographs.size_px
        if (sfm := _to_run(planned, SfmOptions)) is not None:
            reconstruction = reconstructor_of(sfm).estimate(photographs.count, photo_px, sfm)
        if (train := _to_run(planned, TrainOptions)) is not None:
            training = estimate_training(photographs.count, photo_px, train)
    seconds: dict[str, float | None] = {}
    for name, estimate in (("sfm", reconstruction), ("train", training)):
        if estimate is not None and estimate.refusal:
            planned = [
                replace(row, action="refuse", reason=estimate.refusal) if row.stage == name else row
                for row in planned
            ]
        elif estimate is not None:
            seconds[name] = estimate.seconds
    return RunEstimate(planned, photographs, seconds, reconstruction, training)


def checked_inputs(
    workspace: Workspace, planned: Sequence[PlannedStage], progress: Progress = SILENT
) -> Summary | None:
    """Return the summary of the survey that `ingest` would make, unwritten; None where it would not run."""
    asked = _to_run(planned, IngestOptions)
    if asked is None:
        return None
    from pipelines.ingest.stage import check_inputs

    return check_inputs(workspace, asked, progress)


def _to_run(planned: Sequence[PlannedStage], options: type[OptionsT]) -> OptionsT | None:
    """Return the options of a class with which a stage will run; None: it will not."""
    going = (row.resolved for row in planned if row.action not in ("keep", "refuse"))
    return next((resolved for resolved in going if isinstance(resolved, options)), None)


def _photographs(workspace: Workspace, planned: list[PlannedStage]) -> FoundPhotographs | None:
    """Return the photographs of the survey, or of the folder ahead of `ingest`; None for a bag not read yet."""
    ingest = next((row for row in planned if row.stage == "ingest" and row.action != "keep"), None)
    if ingest is None:
        if not (workspace.root / SURVEY).is_file():
            return None
        survey = load_json(Survey, workspace.path(SURVEY))
        folder = photograph_folder(workspace, survey.image_dir)
        sizes = [path.stat().st_size for image in survey.images if (path := folder / image.name).is_file()]
        return FoundPhotographs(len(survey.images), survey.largest_photograph_px, sum(sizes) or None)
    assert isinstance(ingest.resolved, IngestOptions)
    if ingest.resolved.images is None:
        return None
    from pipelines.ingest.photo_folder import glance

    count, total_bytes, size_px = glance(ingest.resolved.images)
    return FoundPhotographs(count, size_px, total_bytes)


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
    """Print what a run would do, and what `ingest` would find; a GeorefError: the run would be refused."""
    run = estimate_run(workspace, stages, flags, force=force)
    survey = checked_inputs(workspace, run.planned, progress)
    for warning in () if survey is None else survey.warnings:
        log.warning("ingest: %s", warning.sentence, extra={"code": warning.code})
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
        parts += [f"  assumed: {shown(assumption.sentence)}" for assumption in survey.assumptions]
        parts += tables.cautions({"ingest": survey.cautions})
    if run.reconstruction is not None:
        parts += ["\n[bold]Reconstruction[/]", *(f"  {shown(text)}" for text in run.reconstruction.sentences())]
    if run.training is not None:
        parts += ["\n[bold]Training[/]", *(f"  {shown(text)}" for text in run.training.sentences())]
    print_rich(*parts, "\n[dim]Nothing was run. Times are estimates for an idle machine.[/]")


def announced_seconds(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> Mapping[str, float | None]:
    """Return the estimated seconds of a run's stages that take long; none for a run that will be refused.

    The estimate of the training is logged at the start: not after hours of other stages.
    """
    try:
        run = estimate_run(workspace, stages, flags, force=force)
        for sentence in () if run.training is None else run.training.sentences():
            log.info("train: %s", sentence)
    except GeorefError:
        return {}
    return run.seconds


def _document(workspace: Workspace, run: RunEstimate, survey: Summary | None) -> dict[str, Any]:
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
        "survey": survey
        and {
            "key_figure": survey.key_figure,
            "values": survey.values,
            "warnings": [warning.model_dump() for warning in survey.warnings],
            "cautions": [caution.model_dump() for caution in survey.cautions],
            "assumptions": [assumption.model_dump() for assumption in survey.assumptions],
        },
        "photographs": run.photographs and dataclasses.asdict(run.photographs),
        "reconstruction": run.reconstruction and dataclasses.asdict(run.reconstruction),
        "training": run.training and dataclasses.asdict(run.training),
    }


class RunTimeLeft:
    """Time that the remaining stages of a run will take, from their estimated seconds; None: not known.

    Stages without an estimate count as nothing: they take seconds. The stages that are done correct the estimates
    of the others, because one machine is slower than another by a factor.
    """

    def __init__(self, seconds: Mapping[str, float | None], clock: Callable[[], float] = time.monotonic) -> None:
        self._unknown = any(value is None for value in seconds.values())
        self._left = {stage: value for stage, value in seconds.items() if value is not None}
        self._clock, self._began = clock, clock()
        self._estimated_s = self._took_s = 0.0

    def begin(self) -> None:
        self._began = self._clock()

    def end(self, stage: str) -> None:
        estimated_s = self._left.pop(stage, 0.0)
        if estimated_s:
            self._estimated_s += estimated_s
            self._took_s += self._clock() - self._began

    @property
    def seconds(self) -> float | None:
        """Seconds that the stages not yet done will take; None: not known."""
        if self._unknown:
            return None
        return sum(self._left.values()) * (self._took_s / self._estimated_s if self._estimated_s else 1.0)
