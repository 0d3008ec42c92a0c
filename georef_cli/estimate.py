"""Estimate of a run: what its stages would do, for which photographs, for how long, with how much memory.

A dry run prints it. A run derives its remaining time from it, corrected by the times of the stages that are done.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from georef_cli import tables
from georef_cli.output import print_json, print_rich, size
from georef_cli.tables import Renderable, literal, plain_table
from pipelines.core.errors import GeorefError
from pipelines.core.options import OptionsT, flag_name, notation, require_available
from pipelines.core.plan import OptionOrigin, PlannedStage, photograph_folder, plan
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import Outcome
from pipelines.core.sentences import about
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Summary, Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.jobs import pace
from pipelines.jobs.costs import COSTS, Work
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey
from pipelines.train.options import TrainOptions

if TYPE_CHECKING:
    from pipelines.sfm.estimate import ReconstructionEstimate
    from pipelines.train.estimate import TrainingEstimate

log = logging.getLogger(__name__)

_FEATURES_BYTES = 2_500_000  # of a photograph in COLMAP's database and model
# A smaller photograph, its depth map and confidence; the model's depth and colour, and the surface fused from them.
_TRAINED_PIXEL_BYTES = 17
_BELIEVED = 0.1  # share of a run's estimated time that weighs for the estimate when done stages correct it
_GAUSSIAN_BYTES = 59 * 4 * 5  # parameters and both moments in the checkpoint, the model, and the PLY


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
    seconds: Mapping[str, float | None]  # about, by stage that would run; None: not measured, as on a GPU
    modelled: Mapping[str, float | None]  # the same, before this machine's own runs correct it
    reconstruction: ReconstructionEstimate | None  # None where none would run, or before a bag is read
    training: TrainingEstimate | None  # likewise
    compilation_s: float = 0.0  # by which the training is later on a machine that has to compile its kernels

    @property
    def total_s(self) -> float | None:
        """Seconds of the whole run; None: not known, as of a bag that is not read yet or of a training on a GPU."""
        going = [row.stage for row in self.planned if row.works]
        known = [seconds for stage in going if (seconds := self.seconds.get(stage)) is not None]
        return sum(known) + self.compilation_s if len(known) == len(going) else None

    @property
    def peak_bytes(self) -> int:
        """Largest predicted memory of a stage; 0: no stage has an estimate."""
        return max(
            (part.peak_bytes for part in (self.reconstruction, self.training) if part is not None), default=0
        )

    @property
    def disk_bytes(self) -> int:
        """Room on the disk that features, smaller photographs, depth maps and checkpoints take, about."""
        total = 0
        if self.reconstruction is not None:
            total += self.reconstruction.photographs * _FEATURES_BYTES
        if self.training is not None:
            width, height = self.training.training_px
            total += self.training.photographs * width * height * _TRAINED_PIXEL_BYTES
            total += self.training.max_gaussians * _GAUSSIAN_BYTES
        return total


def estimate_run(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> RunEstimate:
    """Return the estimate of a run, as of `plan`; nothing is written. A GeorefError: the run would be refused."""
    from pipelines.sfm.reconstructor import reconstructor_of
    from pipelines.train.compilation import compilation_s
    from pipelines.train.estimate import estimate_training

    planned = plan(workspace, stages, flags, force=force)
    for row in planned:
        if row.works:
            require_available(row.resolved)
    photographs = _photographs(workspace, planned)
    reconstruction, training = None, None
    if photographs is not None:
        photo_px = photographs.size_px
        if (sfm := _to_run(planned, SfmOptions)) is not None:
            reconstruction = reconstructor_of(sfm).estimate(photographs.count, photo_px, sfm)
        if (train := _to_run(planned, TrainOptions)) is not None:
            training = estimate_training(photographs.count, photo_px, train)
    modelled: dict[str, float | None] = {}
    for name, estimate in (("sfm", reconstruction), ("train", training)):
        if estimate is not None and estimate.refusal:
            planned = [
                replace(row, action="refuse", reason=estimate.refusal) if row.stage == name else row
                for row in planned
            ]
        elif estimate is not None:
            modelled[name] = estimate.seconds
    if photographs is not None:
        width, height = photographs.size_px if training is None else training.training_px
        work = Work(photographs=photographs.count, megapixels=photographs.count * width * height / 1e6)
        for row in planned:
            if row.works and row.stage in COSTS:
                modelled[row.stage] = COSTS[row.stage].of(work)
    seconds = {name: None if value is None else pace.corrected(name, value) for name, value in modelled.items()}
    once_s = 0.0 if training is None or training.refusal else compilation_s()
    return RunEstimate(planned, photographs, seconds, modelled, reconstruction, training, once_s)


def checked_inputs(
    workspace: Workspace, planned: Sequence[PlannedStage], progress: Progress = SILENT
) -> Summary | None:
    """Return the summary of the survey that `ingest` would make, unwritten; None where it would not run."""
    ingest_options = _to_run(planned, IngestOptions)
    if ingest_options is None:
        return None
    from pipelines.ingest.stage import check_inputs

    return check_inputs(workspace, ingest_options, progress)


def _to_run(planned: Sequence[PlannedStage], options: type[OptionsT]) -> OptionsT | None:
    """Return the options of a class with which a stage will run; None: it will not."""
    going = (row.resolved for row in planned if row.works)
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
    given: Mapping[str, Flags] | None = None,
) -> None:
    """Print what a run would do, and what `ingest` would find; a GeorefError: the run would be refused.

    `given` are the flags of this command line, without those that are remembered; None: `flags`.
    """
    run = estimate_run(workspace, stages, flags, force=force)
    run = replace(run, planned=[_with_origins(row, given) for row in run.planned])
    survey = checked_inputs(workspace, run.planned, progress)
    for warning in () if survey is None else survey.warnings:
        log.warning("ingest: %s", warning.text, extra={"code": warning.code})
    if as_json:
        print_json(_document(workspace, run, survey))
        return
    table = plain_table("stage", "", "about", "why", right=[2])
    for row in run.planned:
        action = f"[{_STYLE[row.action]}]{row.action}[/]"
        table.add_row(row.stage, action, about(run.seconds.get(row.stage)), literal(row.reason))
    parts: list[Renderable] = [table, *tables.origins([origin for row in run.planned for origin in row.options])]
    if run.photographs is not None:
        width, height = run.photographs.size_px
        files = "" if run.photographs.bytes is None else f", {size(run.photographs.bytes)}"
        parts.append(f"\n[bold]Photographs[/]: {run.photographs.count} of {width}×{height} px{files}")
    if survey is not None:
        parts.append(f"\n[bold]Survey[/]: {literal(survey.key_figure)}")
        parts += [f"  assumed: {literal(assumption.text)}" for assumption in survey.assumptions]
        parts += tables.cautions({"ingest": survey.cautions})
    if run.reconstruction is not None:
        parts += ["\n[bold]Reconstruction[/]", *(f"  {literal(text)}" for text in run.reconstruction.sentences())]
    if run.training is not None:
        parts += ["\n[bold]Training[/]", *(f"  {literal(text)}" for text in run.training.sentences())]
    if run.compilation_s:
        parts.append(f"  about {about(run.compilation_s)} more, once: this machine compiles the kernels")
    if run.photographs is not None:
        time_text = "not measured" if run.total_s is None else f"about {about(run.total_s)}"
        memory = f"; memory about {size(run.peak_bytes)}" if run.peak_bytes else ""
        parts.append(f"\n[bold]In all[/]: {time_text}{memory}; disk about {size(run.disk_bytes)}")
    busy = pace.load_sentence()
    parts += [f"[yellow]{busy}[/]"] if busy else []
    print_rich(*parts, "\n[dim]Nothing was run. Times are estimates for an idle machine.[/]")


def _with_origins(row: PlannedStage, given: Mapping[str, Flags] | None) -> PlannedStage:
    """Return a planned stage whose options name their true origin, those that follow from a preset among them."""
    names = {flag_name(type(row.resolved), name) for name in (given or {}).get(row.stage, {})}
    origins = [replace(each, origin="command line") if each.flag in names else each for each in row.options]
    if isinstance(row.resolved, TrainOptions):
        effort, known = row.resolved.effort, {each.flag for each in origins}
        for name in ("iterations", "max_image_size", "max_gaussians"):
            flag = flag_name(TrainOptions, name)
            if flag not in known:
                origins.append(OptionOrigin(row.stage, flag, getattr(effort, name), "preset"))
    return replace(row, options=tuple(origins))


def keep_times(run: RunEstimate | None, outcomes: Sequence[Outcome], before: pace.Ticks | None) -> None:
    """Keep the times of whole stages for the next estimate, unless others used the machine meanwhile."""
    used = os.times()
    share = pace.used_by_others(before, used.user + used.system + used.children_user + used.children_system)
    if run is None or not outcomes:
        return
    if pace.is_loaded(share):
        log.info("run: others used %.0f %% of this machine: its times are not kept for estimates.", 100 * share)
        return
    whole = {row.stage for row in run.planned if row.action in ("run", "perhaps")}
    if run.compilation_s:  # Stages after the training compile further kernels, often for longer than they run.
        names = [row.stage for row in run.planned]
        whole -= set(names[names.index("train") + 1 :])
    for outcome in outcomes:
        if outcome.ran and outcome.stage in whole:
            pace.learn(outcome.stage, run.modelled.get(outcome.stage), outcome.manifest.duration_s)


def announced_estimate(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool
) -> RunEstimate | None:
    """Return the estimate of a run; None for one that will be refused.

    The estimate of the training is logged at the start: not after hours of other stages.
    """
    try:
        run = estimate_run(workspace, stages, flags, force=force)
        for sentence in () if run.training is None else run.training.sentences():
            log.info("train: %s", sentence)
        busy = pace.load_sentence()
        if busy:
            log.info("run: %s", busy)
    except GeorefError:
        return None
    return run


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
        "total": {
            "seconds": run.total_s,
            "compilation_seconds": run.compilation_s,
            "peak_bytes": run.peak_bytes,
            "disk_bytes": run.disk_bytes,
        },
    }


class RunTimeLeft:
    """Time that the remaining stages of a run will take, from their estimated seconds; None: not known.

    Stages without an estimate count as nothing: they take seconds. The stages that are done correct the estimates
    of the others, because one machine is slower than another by a factor: so far as they are much of the run, since
    a second's stage tells little of an hour's.
    """

    def __init__(self, seconds: Mapping[str, float | None], clock: Callable[[], float] = time.monotonic) -> None:
        self._unknown = any(value is None for value in seconds.values())
        self._left = {stage: value for stage, value in seconds.items() if value is not None}
        self._clock, self._began = clock, clock()
        self._estimated_s = self._took_s = _BELIEVED * sum(self._left.values())

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
