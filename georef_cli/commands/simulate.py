"""Command `georef simulate`."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.layout import shown
from georef_cli.output import print_json, print_rich
from pipelines.core.options import CONFIG_FILE, resolve
from pipelines.core.sentences import duration
from pipelines.simulate.options import SimulateOptions


def _simulate(ctx: click.Context, **values: Any) -> None:
    from pipelines.simulate.stage import simulate

    survey_options = resolve(
        SimulateOptions, {}, options.given(ctx, SimulateOptions.model_fields), Path(CONFIG_FILE)
    )
    started = time.monotonic()
    summary = simulate(survey_options, values["directory"], progress_for(ctx.obj), overwrite=values["force"])
    if values["as_json"]:
        print_json({**dataclasses.asdict(summary), "directory": str(summary.directory)})
        return
    took = duration(time.monotonic() - started)
    print_rich(f"[bold]simulate[/]: {shown(f'{summary.key_figure} in {summary.directory} ({took})')}")


command = Command(
    "simulate",
    params=[
        click.Argument(
            ["directory"], type=click.Path(file_okay=False, resolve_path=True, path_type=Path), metavar="DIR"
        ),
        *options.stage_options(SimulateOptions),
        click.Option(["--force"], is_flag=True, help="Replace an earlier simulation in DIR."),
        options.JSON,
    ],
    callback=click.pass_context(_simulate),
    help="""Simulate a survey whose truth is known exactly.

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
