"""`georef calibrate`."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import click

from georef_cli import boundary, options, tables
from georef_cli.display import progress_for
from georef_cli.output import document_of, print_json, print_outcome, print_rich
from pipelines import runner
from pipelines.config import CONFIG_FILE, CalibrateConfig, resolve
from pipelines.stages import BY_NAME


def _calibrate(ctx: click.Context, **values: Any) -> None:
    from pipelines.calibrate import calibrate

    workspace, spec = values["workspace"], BY_NAME["ingest"]
    config = resolve(CalibrateConfig, {}, options.given(ctx, CalibrateConfig.model_fields), Path(CONFIG_FILE))
    found = calibrate(workspace, config)
    document = dataclasses.asdict(found)
    if not values["as_json"]:
        print_rich(*tables.calibration(document))
    outcome = None
    if values["apply"] and found.options:
        flags = runner.remembered(workspace, spec, found.options)
        with boundary.written(workspace.log_file(spec)):
            outcome = runner.run_stage(workspace, spec, flags, progress=progress_for(ctx.obj))
    if values["as_json"]:
        print_json({**document, "applied": outcome and document_of(outcome)})
    elif outcome is not None:
        print_outcome(workspace, outcome, as_json=False)


command = click.Command(
    "calibrate",
    params=[
        options.workspace_argument(),
        *options.stage_options(CalibrateConfig),
        click.Option(["--apply"], is_flag=True, help="Run ingest again with what is observable."),
        options.json_option(),
    ],
    callback=click.pass_context(_calibrate),
    help=inspect.cleandoc(
        """Estimate time offset, boresight and lever arm from the SfM cameras.

        After sfm, the track of the cameras is laid on the navigation that ingest kept from a bag. Each parameter
        comes with its σ; one that the flight does not show is said to be not observable, and is not applied.

        \b
        Examples:
          georef calibrate flight
          georef calibrate flight --estimate time-offset --max-offset 5
          georef calibrate flight --estimate time-offset,boresight,lever-arm --apply
        """
    ),
)
