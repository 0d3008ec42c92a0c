"""`georef evaluate`."""

from __future__ import annotations

from georef_cli.stage import StageCommand

command = StageCommand(
    "evaluate",
    """Measure test views and check points.

    Check points are measured by camera (their marks intersected) and by model (the depth of the Gaussians at
    the marks). The report is evaluate/report.json.

    \b
    Examples:
      georef evaluate flight
      georef evaluate flight --renders 2 --json
      georef evaluate flight --crs EPSG:32632
    """,
)
