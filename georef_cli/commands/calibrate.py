"""`georef calibrate`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import click

from georef_cli import boundary, options, tables
from georef_cli.output import print_json, print_rich
from pipelines.calibrate.options import CalibrateOptions
from pipelines.core.options import CONFIG_FILE, resolve
from pipelines.core.stages import CALIBRATE


def _calibrate(ctx: click.Context, **values: Any) -> None:
    from pipelines.calibrate.stage import apply_calibration, calibrate

    workspace = values["workspace"]
    config = resolve(CalibrateOptions, {}, options.given(ctx, CalibrateOptions.model_fields), Path(CONFIG_FILE))
    found = calibrate(workspace, config)
    applied: list[str] = []
    if values["apply"]:
        applied = [one.name for one in found.estimates if one.usable]
        with workspace.lock(CALIBRATE.name), boundary.written(workspace.log_file(CALIBRATE)):
            apply_calibration(workspace, found)
    if values["as_json"]:
        print_json({**found.model_dump(mode="json"), "applied": applied})
        return
    print_rich(*tables.calibration(found.model_dump(mode="json")))
    if values["apply"]:
        print_rich(f"applied to the survey: {', '.join(applied) or 'nothing'}")


command = click.Command(
    "calibrate",
    params=[
        options.workspace_argument(),
        *options.stage_options(CalibrateOptions),
        click.Option(["--apply"], is_flag=True, help="Put what is observable into the survey."),
        options.json_option(),
    ],
    callback=click.pass_context(_calibrate),
    help=inspect.cleandoc(
        """Estimate time offset, boresight and lever arm from the SfM cameras.

        After sfm, the track of the cameras is laid on the navigation that ingest kept from a bag or a trajectory by
        time. Each parameter comes with its σ; one that the flight does not show is said to be not observable, and
        is not applied. `georef run` does this itself where ingest was asked to (--time-offset auto, --estimate).

        \b
        Examples:
          georef calibrate flight
          georef calibrate flight --estimate time-offset --max-offset 5
          georef calibrate flight --estimate time-offset,boresight,lever-arm --apply
        """
    ),
)
