"""Command `georef marks`."""

import dataclasses
from typing import Any

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.layout import shown
from georef_cli.output import print_result
from pipelines.core.staleness import must_exist
from pipelines.core.workspace import Workspace
from pipelines.view.options import ProposalOptions


def _marks(ctx: click.Context, workspace: Workspace, as_json: bool, **_values: Any) -> None:
    from pipelines.view.proposed_marks import propose_marks

    must_exist(workspace)
    wanted = options.resolved(ctx, ProposalOptions, workspace.config_file)
    found = propose_marks(workspace, wanted, progress_for(ctx.obj))
    left_out = [f"[yellow]left out, other marks contradict it:[/] {shown(text)}" for text in found.left_out]
    counts = f"{found.marks} marks of {found.points} points, {found.quarters} of them quartered targets, in "
    document = {**dataclasses.asdict(found), "file": str(found.file)}
    print_result(document, *left_out, counts + shown(str(found.file)), as_json=as_json)


command = Command(
    "marks",
    params=[options.WORKSPACE, *options.stage_options(ProposalOptions), options.JSON],
    callback=click.pass_context(_marks),
    help="""Propose marks of ground points in the photographs that lack them.

        Points are projected with the adjusted cameras, so init-sim3 must have run. Near each expected pixel a
        quartered target is searched; else what the nearest marked photograph shows. The table is written for
        `georef ingest` --marks. No mark of the survey is changed.

        \b
        Examples:
          georef marks flight
          georef marks flight --reach 60 --json
        """,
)
