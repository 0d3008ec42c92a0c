"""Command `georef status`."""

from __future__ import annotations

import dataclasses

from georef_cli import options, tables
from georef_cli.command import Command
from georef_cli.output import document_of_cautions, print_json, print_rich
from pipelines.core import staleness as states
from pipelines.core.workspace import Workspace


def _status(workspace: Workspace, as_json: bool) -> None:
    rows, cautions = states.status(workspace), states.cautions_by_stage(workspace)
    if not as_json:
        print_rich(tables.states(rows, cautions), *tables.cautions(cautions))
        return
    stages = [{**dataclasses.asdict(row), "finished": row.finished and row.finished.isoformat()} for row in rows]
    document = {"workspace": str(workspace.root), "stages": stages}
    print_json({**document, "cautions": document_of_cautions(cautions)})


command = Command(
    "status",
    params=[options.workspace_argument(), options.json_option()],
    callback=_status,
    help="""Show the state of every stage: missing, current, stale (its inputs or options have changed since),
damaged (a file is not as the stage wrote it), interrupted or failed; and the cautions, which limit the result.

\b
Examples:
  georef status flight
  georef status flight --json
""",
)
