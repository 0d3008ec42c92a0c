"""Command `georef inspect`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.table import Table

from georef_cli import options, tables
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import print_result
from georef_cli.tables import literal, plain_table

if TYPE_CHECKING:
    from pipelines.deliver.splat_file import SplatReport

_SPLATS = (".spz", ".ply")


def _inspect(ctx: click.Context, file: Path, as_json: bool) -> None:
    if file.suffix.lower() in _SPLATS:
        from pipelines.deliver.splat_file import inspect_splat

        splat = inspect_splat(file)
        remark_lines = [f"[yellow]{remark.code}:[/] {literal(remark.text)}" for remark in splat.remarks]
        print_result(splat.document(), _splat(splat), *remark_lines, as_json=as_json)
        return
    from pipelines.ingest.bag_inspection import inspect_bag

    report = inspect_bag(file, progress_for(ctx.obj))
    document = dataclasses.asdict(report)
    remarks = [f"[dim]chosen:[/] {literal(text)}" for text in report.remarks]
    remarks += [f"[yellow]missing:[/] {literal(text)}" for text in report.missing]
    print_result(document, tables.topics(document["topics"]), *remarks, as_json=as_json)


def _splat(report: "SplatReport") -> Table:
    """Return the table of a file of a splat."""
    table = plain_table("", "", header=False)
    table.add_row("file", f"{report.format}, {report.gaussians} Gaussians, harmonics of degree {report.sh_degree}")
    for axis, low, high in zip("xyz", report.low, report.high, strict=True):
        table.add_row(axis, f"{low:.2f} … {high:.2f} m")
    for georeference in report.places:
        epoch = "" if georeference.epoch is None else f", epoch {georeference.epoch:.3f}"
        table.add_row("place by", literal(f"{georeference.source} ({georeference.crs[:60]}{epoch})"))
        if georeference.middle_lla is not None:
            lat, lon, height_m = georeference.middle_lla
            table.add_row("its middle", f"{lat:.8f}°, {lon:.8f}°, {height_m:.3f} m above the ellipsoid")
    return table


command = Command(
    "inspect",
    params=[
        click.Argument(["file"], type=options.FILE, metavar="FILE"),
        options.JSON,
    ],
    callback=click.pass_context(_inspect),
    help="""
        Of a bag: topics with type, rate, gaps, time span and frames; what `georef ingest` would choose, and what is
        missing. A bag is a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 .bag.

        Of a splat, .spz or .ply: Gaussians, bounds, and the place on Earth, by what the SPZ itself says and what
        its sidecar FILE.georef.json says; where both differ, by how much. Nothing is written.

        \b
        Examples:
          georef inspect flight_bag
          georef inspect flight_0.mcap --json
          georef inspect splat.spz
        """,
)
