"""Dry run: what the stages would do, with which options, for how long and with how much memory."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from georef_cli import tables
from georef_cli.layout import plain_table
from georef_cli.markup import shown
from georef_cli.output import print_json, print_rich
from georef_cli.overview import size
from georef_cli.tables import Renderable
from pipelines.core.errors import GeorefError
from pipelines.core.options import notation
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.plan import PlannedStage, plan
from pipelines.core.products import load_json
from pipelines.core.sentences import about
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.scene.survey import Survey
from pipelines.sfm.options import SfmOptions
from pipelines.train.options import TrainOptions

if TYPE_CHECKING:
    from pipelines.train.forecast import TrainingForecast

log = logging.getLogger(__name__)

_STYLE = {
    "run": "yellow",
    "perhaps": "yellow",
    "resume": "cyan",
    "extend": "cyan",
    "keep": "green",
    "refuse": "red",
}


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


def print_dry_run(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool, as_json: bool
) -> None:
    """Print what a run of the stages would do; nothing is written.

    Args:
        workspace: may not exist yet.
        stages: in the order of the pipeline.
        flags: all options by stage, the remembered ones among them.
        force: as of the run.
        as_json: print one document.

    Raises:
        GeorefError: the run would be refused for its options, or for a missing file.
    """
    planned = plan(workspace, stages, flags, force=force)
    photographs = _photographs(workspace, planned)
    seconds = _seconds(planned, photographs)
    training = _training(planned, photographs)
    if as_json:
        print_json(_document(workspace, planned, photographs, seconds, training))
        return
    table = plain_table("stage", "", "about", "why", right=[2])
    for row in planned:
        action = f"[{_STYLE[row.action]}]{row.action}[/]"
        table.add_row(row.stage, action, about(seconds.get(row.stage)), shown(row.reason))
    parts: list[Renderable] = [table, *tables.origins([origin for row in planned for origin in row.options])]
    if photographs is not None:
        width, height = photographs.size_px
        files = "" if photographs.bytes is None else f", {size(photographs.bytes)}"
        parts.append(f"\n[bold]Photographs[/]: {photographs.count} of {width}×{height} px{files}")
    if training is not None:
        parts += ["\n[bold]Training[/]", *(f"  {shown(text)}" for text in training.sentences())]
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
        planned = plan(workspace, stages, flags, force=force)
        training = _training(planned, _photographs(workspace, planned))
        for sentence in () if training is None else training.sentences():
            log.info("train: %s", sentence)


def _document(
    workspace: Workspace,
    planned: list[PlannedStage],
    photographs: Photographs | None,
    seconds: Mapping[str, float | None],
    training: TrainingForecast | None,
) -> dict[str, Any]:
    stages = [
        {
            "stage": row.stage,
            "action": row.action,
            "reason": row.reason,
            "seconds": seconds.get(row.stage),
            "options": [{**dataclasses.asdict(origin), "value": notation(origin.value)} for origin in row.options],
        }
        for row in planned
    ]
    return {
        "workspace": str(workspace.root),
        "stages": stages,
        "photographs": photographs and dataclasses.asdict(photographs),
        "training": training and dataclasses.asdict(training),
    }


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


def _seconds(planned: list[PlannedStage], photographs: Photographs | None) -> dict[str, float | None]:
    """Return the seconds of the stages that take long."""
    from pipelines.sfm.pace import reconstruction_seconds

    seconds: dict[str, float | None] = {}
    for row in planned:
        if photographs is None or row.action in ("keep", "refuse"):
            continue
        if isinstance(row.resolved, SfmOptions):
            seconds[row.stage] = reconstruction_seconds(photographs.count, photographs.size_px, row.resolved)
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
