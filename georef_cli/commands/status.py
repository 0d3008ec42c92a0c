"""`georef status`."""

from __future__ import annotations

import dataclasses

import click

from georef_cli import options, tables
from georef_cli.output import print_json, print_rich
from pipelines.core import staleness as states
from pipelines.core.workspace import Workspace


def _status(workspace: Workspace, as_json: bool) -> None:
    rows = states.status(workspace)
    if not as_json:
        print_rich(tables.states(rows))
        return
    stages = [{**dataclasses.asdict(row), "finished": row.finished and row.finished.isoformat()} for row in rows]
    print_json({"workspace": str(workspace.root), "stages": stages})


command = click.Command(
    "status",
    params=[options.workspace_argument(), options.json_option()],
    callback=_status,
    help="""Show the state of every stage: missing, current, stale (its inputs or options have changed since),
damaged (a file is not as the stage wrote it), interrupted or failed.

\b
Examples:
  georef status flight
  georef status flight --json
""",
)
