"""Errors of a report point by point, in one list for tables, files and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipelines.scene.report import (
    EvaluationReport,
    PointError,
    PointResidual,
    PredictedPointError,
)

Way = Literal["camera", "model", "left out", "fit"]


@dataclass(frozen=True)
class PointLine:
    """Error of one point, measured in one way.

    Attributes:
        use: whether the point is a check point or entered the solution.
        way: triangulated, on the rendered surface, by a solution that left the point out, or as the residual of
            the fit.
        row: of the report.
    """

    use: Literal["check", "control"]
    way: Way
    row: PointResidual

    @property
    def error_m(self) -> tuple[float, float, float] | None:
        """Error east, north, up; None: the point was not measured."""
        east, north, up = self.row.de_m, self.row.dn_m, self.row.du_m
        return None if east is None or north is None or up is None else (east, north, up)

    @property
    def sigma_m(self) -> tuple[float, float, float] | None:
        """Predicted σ east, north, up; None: there is no prediction."""
        row = self.row
        if not isinstance(row, PredictedPointError):
            return None
        east, north, up = row.sigma_e_m, row.sigma_n_m, row.sigma_u_m
        return None if east is None or north is None or up is None else (east, north, up)

    @property
    def is_blunder(self) -> bool:
        """Whether the error exceeds three times the class that the other points meet."""
        return isinstance(self.row, PointError) and self.row.blunder


def point_lines(report: EvaluationReport) -> list[PointLine]:
    """Return the errors of all points: check points triangulated and on the rendered surface, then control points.

    The residual of a control point is no accuracy; its error in a solution without it is.
    """
    crossed = () if report.cross_validation is None else report.cross_validation.points
    ways = report.checkpoints.by_way
    return [
        *(
            line
            for rows in zip(*(errors.points for errors in ways.values()), strict=True)
            for line in (PointLine("check", way, row) for way, row in zip(ways, rows, strict=True))
        ),
        *(PointLine("control", "left out", row) for row in crossed),
        *(PointLine("control", "fit", row) for row in report.fit.gcp.points),
    ]
