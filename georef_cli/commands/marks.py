"""Command `georef marks`."""

import dataclasses

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import print_result
from georef_cli.tables import literal
from pipelines.core.options import OptionValue
from pipelines.core.staleness import must_exist
from pipelines.core.workspace import Workspace
from pipelines.view.options import ProposalOptions


def _marks(ctx: click.Context, workspace: Workspace, as_json: bool, **_values: OptionValue) -> None:
    from pipelines.view.proposed_marks import propose_marks

    must_exist(workspace)
    wanted = options.resolved(ctx, ProposalOptions, workspace.config_file)
    proposal = propose_marks(workspace, wanted, progress_for(ctx.obj))
    left_out = [f"[yellow]left out, other marks contradict it:[/] {literal(text)}" for text in proposal.left_out]
    counts = (
        f"{proposal.marks} marks of {proposal.points} points, {proposal.quarters} of them quartered targets, in "
    )
    document = {**dataclasses.asdict(proposal), "file": str(proposal.file)}
    print_result(document, *left_out, counts + literal(str(proposal.file)), as_json=as_json)


command = Command(
    "marks",
    params=[options.WORKSPACE, *options.stage_options(ProposalOptions), options.JSON],
    callback=click.pass_context(_marks),
    help="""
        Points are projected with the adjusted cameras, so init-sim3 must have run. Near each expected pixel a
        quartered target is searched; else what the nearest marked photograph shows. The table is written for
        `georef ingest` --marks. No mark of the survey is changed.

        \b
        Examples:
          georef marks flight
          georef marks flight --reach 60 --json
        """,
)
