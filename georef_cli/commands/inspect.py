"""Command `georef inspect`."""

import dataclasses
from pathlib import Path

import click

from georef_cli import options, tables
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.layout import shown
from georef_cli.output import print_result


def _inspect(ctx: click.Context, bag: Path, as_json: bool) -> None:
    from pipelines.ingest.bag_inspection import inspect_bag

    report = inspect_bag(bag, progress_for(ctx.obj))
    document = dataclasses.asdict(report)
    remarks = [f"[dim]chosen:[/] {shown(text)}" for text in report.remarks]
    remarks += [f"[yellow]missing:[/] {shown(text)}" for text in report.missing]
    print_result(document, tables.topics(document["topics"]), *remarks, as_json=as_json)


command = Command(
    "inspect",
    params=[
        click.Argument(["bag"], type=options.FILE, metavar="BAG"),
        options.JSON,
    ],
    callback=click.pass_context(_inspect),
    help="""Show what a ROS bag holds.

        Topics with type, rate, gaps, time span and frames; what `georef ingest` would choose, and what is missing.
        BAG is a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 .bag. Nothing is written.

        \b
        Examples:
          georef inspect flight_bag
          georef inspect flight_0.mcap --json
        """,
)
