"""Summary of the report: key figures, traffic lights, cautions."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.cautions import Caution
from pipelines.report.evaluated import EvaluatedSurvey
from pipelines.report.lenses import LensesFacts
from pipelines.report.overlap import OverlapFacts
from pipelines.report.record import RecordFacts
from pipelines.report.verdicts import Measured, Verdict, verdicts


@dataclass(frozen=True)
class SummaryFacts:
    """Summary of an evaluated survey.

    Attributes:
        verdicts: traffic lights.
        cautions: limits of the result.
        check_points: number of check points that were measured by camera.
        has_cells: whether σ is predicted over the scene.
        statement: ASPRS statement, by camera; None without check points.
    """

    verdicts: tuple[Verdict, ...]
    cautions: tuple[Caution, ...]
    check_points: int
    has_cells: bool
    statement: str | None


def summary_facts(
    evaluated: EvaluatedSurvey,
    cautions: tuple[Caution, ...],
    overlap: OverlapFacts,
    lenses: LensesFacts,
    record: RecordFacts,
) -> SummaryFacts:
    """Return the summary of an evaluated survey.

    Args:
        evaluated: the survey.
        cautions: of its products.
        overlap, lenses, record: facts of those sections.
    """
    survey, report = evaluated.trained.survey, evaluated.report
    measured = Measured(
        photographs=len(survey.images),
        registered=lenses.photographs,
        enough_share=overlap.enough_share,
        enough=overlap.enough,
        parts=overlap.parts,
        rmse_px=lenses.rmse_px,
        fixes=report.fit.gnss.count + report.fit.gnss.outliers,
        fix_outliers=report.fit.gnss.outliers,
        control_points=len(survey.control_points) - report.fit.gcp.outliers,
        control_outliers=report.fit.gcp.outliers,
        check_points=len(survey.check_points),
        stale=tuple(stage.name for stage in record.stages if stage.state in ("stale", "damaged")),
        workspace=str(evaluated.workspace.root),
    )
    return SummaryFacts(
        verdicts=verdicts(report, measured, cautions),
        cautions=cautions,
        check_points=report.checkpoints.camera.count,
        has_cells=report.accuracy.cells > 0,
        statement=report.checkpoints.camera.asprs.statement,
    )
