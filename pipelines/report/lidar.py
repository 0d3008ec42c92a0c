"""LiDAR that the training has used: its registration, and the places that have changed since."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.products import load_json
from pipelines.core.stages import LIDAR, LIDAR_MAP
from pipelines.core.workspace import Workspace
from pipelines.pages.pictures import Picture, limited, picture_of, read_picture
from pipelines.scene.lidar_report import LidarReport

_MAP_PX = 1400
_LISTED = 12


@dataclass(frozen=True)
class ShiftRow:
    """Shift along one axis, and its σ, in metres; whether it is beyond 3 σ."""

    axis: str
    shift_m: float
    sigma_m: float
    beyond: bool


@dataclass(frozen=True)
class LidarFacts:
    """LiDAR of a training.

    Attributes:
        report: the record of the training.
        shift: by axis.
        listed: number of areas in the table.
        map: picture; None: not kept.
    """

    report: LidarReport
    shift: tuple[ShiftRow, ...]
    listed: int
    map: Picture | None


def lidar_facts(workspace: Workspace) -> LidarFacts | None:
    """Return the LiDAR of a training; None: it has used none.

    Raises:
        InputError: record or map cannot be read.
    """
    if not (workspace.root / LIDAR).is_file():
        return None
    report, drawn = load_json(LidarReport, workspace.root / LIDAR), workspace.root / LIDAR_MAP
    registration = report.registration
    rows = zip(("east", "north", "up"), registration.shift_m, registration.sigma_m, strict=True)
    return LidarFacts(
        report,
        tuple(ShiftRow(axis, shift, sigma, abs(shift) > 3 * sigma) for axis, shift, sigma in rows),
        min(len(report.areas), _LISTED),
        picture_of(limited(read_picture(drawn), _MAP_PX)) if drawn.is_file() else None,
    )
