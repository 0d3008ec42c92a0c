"""Results on stdout: a short text for people, or one JSON document."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import click
from rich.console import Console, RenderableType
from rich.text import Text

from georef_cli import tables
from georef_cli.markup import Safe
from pipelines.core.products import dump_json
from pipelines.core.runner import Outcome
from pipelines.core.workspace import Workspace

PIPED_WIDTH = 120


def print_json(document: Any) -> None:
    """Print one JSON document."""
    click.echo(dump_json(document))


def print_rich(*parts: RenderableType) -> None:
    """Print for people: in colour on a terminal, plain elsewhere."""
    console = Console(
        width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False, emoji=False, file=sys.stdout
    )
    for part in parts:
        console.print(Safe(part if not isinstance(part, str) else Text.from_markup(part, emoji=False)))


def document_of(outcome: Outcome) -> dict[str, Any]:
    """The JSON form of a stage's result."""
    manifest = outcome.manifest
    return {
        "stage": outcome.stage,
        "ran": outcome.ran,
        "key_figure": manifest.key_figure,
        "values": manifest.values,
        "warnings": manifest.warnings,
        "duration_s": manifest.duration_s,
    }


def print_outcome(workspace: Workspace, outcome: Outcome, *, as_json: bool) -> None:
    """Print a stage's result."""
    if as_json:
        print_json(document_of(outcome))
    else:
        print_rich(*tables.outcome(workspace, outcome))


def print_outcomes(workspace: Workspace, outcomes: Sequence[Outcome], *, as_json: bool) -> None:
    """Print the results of several stages."""
    if as_json:
        print_json({"workspace": str(workspace.root), "stages": [document_of(outcome) for outcome in outcomes]})
        return
    print_rich(tables.outcomes(outcomes))
    for outcome in outcomes:
        if outcome.stage == "evaluate":
            print_rich(*tables.report_of(workspace))
