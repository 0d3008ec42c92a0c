"""Command `georef calibrate`."""

from collections.abc import Mapping
from typing import Any

from rich.console import RenderableType
from rich.table import Table

from georef_cli.layout import plain_table, shown
from georef_cli.stage import StageCommand
from pipelines.core.products import load_json
from pipelines.core.stages import RIG
from pipelines.core.workspace import Workspace
from pipelines.survey.survey import RigCalibration

_COMPONENTS = {"boresight": ("x", "y", "z"), "lever-arm": ("forward", "right", "down"), "time-offset": ("",)}


def _tables(workspace: Workspace, values: Mapping[str, Any]) -> tuple[RenderableType, ...]:
    if values["as_json"]:
        return ()
    calibration = load_json(RigCalibration, workspace.path(RIG))
    if not calibration.estimates:
        return ()
    parts = [] if calibration.rms_position_m is None else [f"{calibration.rms_position_m:.3f} m an axis"]
    parts += [] if calibration.rms_attitude_deg is None else [f"{calibration.rms_attitude_deg:.2f}°"]
    images, points = calibration.images, calibration.control_points
    left_over = f"left over: {', '.join(parts)} ({images} images, {points} control points)"
    return _estimates(calibration), shown(left_over)


def _estimates(calibration: RigCalibration) -> Table:
    table = plain_table("", "estimated", "± σ", "ingest", "unit", "", right=(1, 2, 3))
    for estimate in calibration.estimates:
        applied = "applied" if estimate in calibration.applied else "[dim]not applied[/]"
        columns = (estimate.value, estimate.sigma, estimate.start, estimate.observable)
        components = zip(_COMPONENTS[estimate.name], *columns, strict=True)
        for component, value, sigma, start, observable in components:
            name = f"{estimate.name} {component}".strip()
            remark = applied if observable else "[yellow]not observable in this flight[/]"
            table.add_row(name, f"{value:.4f}", f"{sigma:.4f}", f"{start:.4f}", estimate.unit, remark)
    return table


command = StageCommand(
    "calibrate",
    """
    After sfm, the track of the cameras is fitted to the navigation that ingest recorded from a bag or a trajectory
    by time. Each parameter is stated with its σ. A parameter that the flight does not determine is reported as not
    observable, and is not applied. Parameters requested in ingest (--time-offset auto, --estimate) are applied to
    the positions and attitudes of later stages; other parameters only with --apply. The survey itself stays as
    recorded.

    Positions by photograph, of EXIF or a table with image names, are tested for a lag against the exposures, which
    is applied where lines in two directions show it; --no-apply leaves them as they are.

    \b
    Examples:
      georef calibrate flight
      georef calibrate flight --estimate time-offset --max-offset 5
      georef calibrate flight --estimate time-offset,boresight,lever-arm --apply
    """,
    more=_tables,
)
