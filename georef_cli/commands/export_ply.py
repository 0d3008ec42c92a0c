"""Command `georef export-ply`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from georef_cli.delivery import check_target, deliver
from georef_cli.output import print_outcome
from georef_cli.stage import StageCommand
from pipelines.core.stages import SPLAT


class ExportCommand(StageCommand):
    """Command of the stage, with `-o FILE`."""

    def act(self, ctx: click.Context, **values: Any) -> None:
        """Run the stage, copy its result to the user's file, and print it.

        Raises:
            InputError: the file exists already, or cannot be written.
        """
        workspace, output = values["workspace"], values["output"]
        if output is not None:
            check_target(output, overwrite=values["force"])
        outcome = self.run(ctx, values)
        if output is not None:
            with workspace.lock("export-ply"):
                deliver(workspace.path(SPLAT), output)
        print_outcome(workspace, outcome, as_json=values["as_json"])


command = ExportCommand(
    "export-ply",
    """Write the splat as a PLY with its place on Earth.

    The PLY is in an East-North-Up frame in metres. FILE.georef.json beside it states the place of that frame on
    Earth, and its accuracy.

    \b
    Examples:
      georef export-ply flight
      georef export-ply flight -o splat.ply --min-opacity 0.02
    """,
    extra=[
        click.Option(
            ["-o", "--output"],
            type=click.Path(dir_okay=False, resolve_path=True, path_type=Path),
            metavar="FILE",
            help="Copy the PLY and its sidecar here; an existing file is replaced only with --force.",
        )
    ],
)
