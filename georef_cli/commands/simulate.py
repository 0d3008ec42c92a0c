"""Command `georef simulate`."""

import dataclasses
import time
from pathlib import Path

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import print_result
from georef_cli.tables import literal
from pipelines.core.options import CONFIG_FILE, OptionValue
from pipelines.core.sentences import duration
from pipelines.simulate.options import SimulateOptions


def _simulate(ctx: click.Context, **values: OptionValue) -> None:
    from pipelines.simulate.stage import simulate

    survey_options = options.resolved(ctx, SimulateOptions, Path(CONFIG_FILE))
    started = time.monotonic()
    summary = simulate(survey_options, values["directory"], progress_for(ctx.obj), overwrite=values["force"])
    took = duration(time.monotonic() - started)
    text = f"[bold]simulate[/]: {literal(f'{summary.key_figure} in {summary.directory} ({took})')}"
    document = {**dataclasses.asdict(summary), "directory": str(summary.directory)}
    print_result(document, text, as_json=values["as_json"])


command = Command(
    "simulate",
    params=[
        click.Argument(["directory"], type=options.FOLDER, metavar="DIR"),
        *options.stage_options(SimulateOptions),
        options.flag("--force", text="Replace an earlier simulation in DIR."),
        options.JSON,
    ],
    callback=click.pass_context(_simulate),
    help="""
        DIR gets photographs, a trajectory, raw navigation, control and check points in the form of a surveyor's
        files, and truth.json with the truth behind them. The same options give the same bytes.

        \b
        Examples:
          georef simulate survey
          georef simulate survey --scene village --flight grid --images 60 --size 1200x900 --gnss consumer
          georef simulate survey --height 50 --height 75 --lever-arm 0.1,0,-0.3 --boresight 0.5,0.3,-1
          georef simulate survey --clock-offset 0.2 --bag mcap --depth --origin=-33.86,151.21,40
        """,
)
