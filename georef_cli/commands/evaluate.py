"""Command `georef evaluate`."""

from __future__ import annotations

from typing import Any

import click

from georef_cli.output import print_outcome
from georef_cli.point_tables import point_tables
from georef_cli.stage import StageCommand


class EvaluateCommand(StageCommand):
    """Command of the stage, with `--points`."""

    def act(self, ctx: click.Context, **values: Any) -> None:
        """Run the stage and print its result, with the errors point by point if they are wanted."""
        outcome = self.run(ctx, values)
        more = point_tables(values["workspace"]) if values["points"] and not values["as_json"] else []
        print_outcome(values["workspace"], outcome, *more, as_json=values["as_json"])


command = EvaluateCommand(
    "evaluate",
    """Measure test views and check points.

    Check points are measured by camera (their marks intersected) and by model (the rendered depth of the
    Gaussians at the marks, not their centres), and stated as the ASPRS standard asks. The predicted accuracy over
    the scene is drawn in evaluate/accuracy.png. A survey without check points has --cross-validate: every control
    point measured by a solution that does not know it. The report is evaluate/report.json; evaluate/points.csv has
    the error of every point, and --points prints them.

    \b
    Examples:
      georef evaluate flight
      georef evaluate flight --renders 2 --json
      georef evaluate flight --points --crs EPSG:32632
      georef evaluate flight --cross-validate
    """,
    extra=[click.Option(["--points"], is_flag=True, help="Print the errors of every check and control point.")],
)
