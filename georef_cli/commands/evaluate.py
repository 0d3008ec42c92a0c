"""Command `georef evaluate`."""

from collections.abc import Mapping
from typing import Any

from rich.console import Group

from georef_cli.options import flag
from georef_cli.stage import StageCommand
from georef_cli.tables import coordinate_tables, error_tables
from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report


def _tables(workspace: Workspace, values: Mapping[str, Any]) -> list[Group]:
    """Return coordinates, and errors point by point if they are wanted."""
    report = read_report(workspace.path(REPORT))
    return [*coordinate_tables(report), *(error_tables(report) if values["points"] else [])]


command = StageCommand(
    "evaluate",
    """
    Without training, the cameras of init-sim3 are evaluated alone. Check points are triangulated (their marks
    intersected) and measured on the rendered surface (the depth of the Gaussians at the marks, not their
    centres), and stated as the ASPRS standard asks. The predicted accuracy over the scene is drawn in
    evaluate/accuracy.png. A survey without check points has --cross-validate: every control point measured by a
    solution that does not know it. The report is evaluate/report.json; evaluate/points.csv has the error of every
    point, and --points prints them.

    \b
    Examples:
      georef evaluate flight
      georef evaluate flight --renders 2 --json
      georef evaluate flight --points --crs EPSG:32632
      georef evaluate flight --cross-validate
      georef evaluate flight --reference scan.laz --reference-sigma 0.02
    """,
    extra=[flag("--points", text="Print the errors of every check and control point.")],
    more=_tables,
)
