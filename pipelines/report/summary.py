"""Summary of the report: key figures, traffic lights, cautions."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.cautions import Caution
from pipelines.core.figures import Headline
from pipelines.report.evaluated import EvaluatedSurvey
from pipelines.report.lenses import LensesFacts
from pipelines.report.overlap import OverlapFacts
from pipelines.report.record import RecordFacts
from pipelines.report.verdicts import Measured, Verdict, verdicts

_NOTES = {
    "measured": "RMSE of the triangulated check points, their survey's error included",
    "predicted": "no check points: root mean square of the predicted σ over the scene",
    "unknown": "neither measured nor predicted",
}


@dataclass(frozen=True)
class SummaryFacts:
    """Summary of an evaluated survey.

    Attributes:
        verdicts: traffic lights.
        cautions: limits of the result.
        headline: accuracy of the result.
        accuracy_note: what its figures are.
        statement: ASPRS statement of the triangulated check points; None without any.
    """

    verdicts: tuple[Verdict, ...]
    cautions: tuple[Caution, ...]
    headline: Headline
    accuracy_note: str
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
    survey, report = evaluated.solved.survey, evaluated.report
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
        headline=report.headline,
        accuracy_note=_NOTES[report.headline.kind],
        statement=report.checkpoints.camera.asprs.statement,
    )
