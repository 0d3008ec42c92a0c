"""Command `georef status`."""

import dataclasses
from typing import Any

from georef_cli import options, tables
from georef_cli.command import Command
from georef_cli.output import evaluated_cameras, print_json, print_rich, with_evaluation
from pipelines.core import staleness as states
from pipelines.core.manifest import Memo
from pipelines.core.options import notation
from pipelines.core.plan import option_origins
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.survey.headline import headline_of, outdated, with_newest_solution


def _status(workspace: Workspace, with_options: bool, as_json: bool) -> None:
    memo: Memo = {}  # the same large files decide the states and the newest solution
    rows, newest = states.status(workspace, memo), with_newest_solution(workspace, memo)
    solved = evaluated_cameras(newest, with_area=False)
    cautions = with_evaluation({**states.cautions_by_stage(newest), **outdated(workspace, newest)}, solved)
    accuracy = headline_of(newest, memo) if solved is None else solved.headline
    origins = [row for spec in BY_NAME.values() for row in option_origins(workspace, spec)] if with_options else []
    if not as_json:
        print_rich(tables.states(rows, cautions), *tables.accuracy_line(accuracy), *tables.cautions(cautions))
        if with_options:
            print_rich(*tables.origins(origins))
        return
    stages = [{**dataclasses.asdict(row), "finished": row.finished and row.finished.isoformat()} for row in rows]
    document: dict[str, Any] = {
        "workspace": str(workspace.root),
        "stages": stages,
        "accuracy": accuracy and accuracy.model_dump(),
    }
    if with_options:
        document["options"] = [{**dataclasses.asdict(row), "value": notation(row.value)} for row in origins]
    print_json({**document, "cautions": states.document_of_cautions(cautions)})


command = Command(
    "status",
    params=[
        options.WORKSPACE,
        options.flag(
            "--options",
            "with_options",
            text="Show the changed options too: remembered from earlier commands, or of georef.toml.",
        ),
        options.JSON,
    ],
    callback=_status,
    help="""
        A stage is missing, current, stale (its inputs or options have changed since), damaged (a file is not as
        the stage wrote it), interrupted or failed. The accuracy of the result follows, and the cautions that limit
        it.

        \b
        Examples:
          georef status flight
          georef status flight --options
          georef status flight --json
        """,
)
