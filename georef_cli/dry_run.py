"""Dry run: what the stages would do, with which options, for how long and with how much memory."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Mapping
from typing import Any

from georef_cli import tables
from georef_cli.forecast import RunForecast, checked_inputs, forecast_run
from georef_cli.layout import plain_table
from georef_cli.markup import shown
from georef_cli.output import print_json, print_rich
from georef_cli.overview import size
from georef_cli.tables import Renderable
from pipelines.core.errors import GeorefError
from pipelines.core.options import notation
from pipelines.core.progress import Progress
from pipelines.core.sentences import about
from pipelines.core.stages import StageSpec
from pipelines.core.staleness import Flags
from pipelines.core.workspace import Summary, Workspace
from pipelines.train.options import TrainOptions

log = logging.getLogger(__name__)

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
