"""Errors of a report point by point, in one list for tables, files and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipelines.scene.report import (
    CrossValidation,
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
    crossed = report.cross_validation.points if isinstance(report.cross_validation, CrossValidation) else ()
    by_camera, by_model = report.checkpoints.camera.points, report.checkpoints.model.points
    return [
        *(
            line
            for camera, model in zip(by_camera, by_model, strict=True)
            for line in (PointLine("check", "camera", camera), PointLine("check", "model", model))
        ),
        *(PointLine("control", "left out", row) for row in crossed),
        *(PointLine("control", "fit", row) for row in report.fit.gcp.points),
    ]
