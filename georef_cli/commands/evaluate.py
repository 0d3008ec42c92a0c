"""Command `georef evaluate`."""

from __future__ import annotations

from georef_cli.stage import StageCommand

command = StageCommand(
    "evaluate",
    """Measure test views and check points.

    Check points are measured by camera (their marks intersected) and by model (the rendered depth of the
    Gaussians at the marks, not their centres), and stated as the ASPRS standard asks. The predicted accuracy over
    the scene is drawn in evaluate/accuracy.png. A survey without check points has --cross-validate: every control
    point measured by a solution that does not know it. The report is evaluate/report.json.

    \b
    Examples:
      georef evaluate flight
      georef evaluate flight --renders 2 --json
      georef evaluate flight --crs EPSG:32632
      georef evaluate flight --cross-validate
    """,
)
