"""Results on stdout: a short text for people, or one JSON document."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console, RenderableType
from rich.text import Text

from georef_cli import overview, tables
from georef_cli.markup import Safe, shown
from pipelines.core.cautions import Caution, union
from pipelines.core.products import dump_json
from pipelines.core.runner import Outcome
from pipelines.core.staleness import cautions_by_stage
from pipelines.core.workspace import Workspace
from pipelines.scene.headline import headline_of

if TYPE_CHECKING:
    from pipelines.deliver.overview import Overview
    from pipelines.scene.report import EvaluationReport

PIPED_WIDTH = 120


def print_json(document: Any) -> None:
    """Print one JSON document."""
    click.echo(dump_json(document))


def print_rich(*parts: RenderableType) -> None:
    """Print renderables: in colour on a terminal, plain elsewhere."""
    console = Console(
        width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False, emoji=False, file=sys.stdout
    )
    for part in parts:
        console.print(Safe(part if not isinstance(part, str) else Text.from_markup(part, emoji=False)))


def document_of(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON form of a stage's result."""
    manifest = outcome.manifest
    return {
        "stage": outcome.stage,
        "ran": outcome.ran,
        "key_figure": manifest.key_figure,
        "values": manifest.values,
        "warnings": manifest.warnings,
        "duration_s": manifest.duration_s,
    }


def document_of_cautions(by_stage: Mapping[str, Sequence[Caution]]) -> list[dict[str, str]]:
    """Return the JSON form of cautions by stage."""
    return [
        {"stage": stage, **caution.model_dump()} for stage, cautions in by_stage.items() for caution in cautions
    ]


def print_outcome(workspace: Workspace, outcome: Outcome, *more: RenderableType, as_json: bool, told: bool) -> None:
    """Print the result of a stage, then the cautions of the workspace.

    Args:
        workspace: with the result.
        outcome: of the stage.
        more: printed below its figures.
        as_json: print one document.
        told: the log on the same terminal has shown the headline.
    """
    cautions = cautions_by_stage(workspace)
    if as_json:
        print_json({**document_of(outcome), "cautions": document_of_cautions(cautions)})
    else:
        print_rich(*tables.outcome(workspace, outcome, headline=not told), *more, *tables.cautions(cautions))


def print_outcomes(
    workspace: Workspace,
    outcomes: Sequence[Outcome],
    result: Overview | None,
    solved: EvaluationReport | None = None,
    *,
    as_json: bool,
    told: bool,
) -> None:
    """Print the results of several stages, the overview of the whole if there is one, and last the cautions.

    Args:
        workspace: with the results.
        outcomes: of the stages.
        result: the overview.
        solved: evaluation of cameras without training; None: no part of the result.
        as_json: print one document.
        told: the log on the same terminal has shown the stages.
    """
    cautions = cautions_by_stage(workspace)
    if solved is not None:
        carried = union(*cautions.values())
        cautions["evaluation"] = tuple(caution for caution in solved.cautions if caution not in carried)
    if as_json:
        stages = [document_of(outcome) for outcome in outcomes]
        document = {"workspace": str(workspace.root), "stages": stages, "result": result and result.feature()}
        if solved is not None:
            document["evaluation"] = solved.model_dump(mode="json")
        print_json({**document, "cautions": document_of_cautions(cautions)})
        return
    if not told:
        print_rich(tables.outcomes(outcomes))
    if result is not None:
        print_rich(*overview.short(result))
    else:
        if solved is not None:
            print_rich(*tables.report(solved))
        print_rich(*tables.accuracy(headline_of(workspace) if solved is None else solved.headline))
        if told:
            print_rich(f"[bold]Next[/]: georef run {shown(str(workspace.root))} completes it")
    print_rich(*tables.cautions(cautions))
