"""Headline of a workspace: its accuracy as measured at check points, else as predicted.

Whoever states the accuracy of a result asks `headline_of`, so that terminal, pages and sidecars state the same.
"""

import contextlib
from dataclasses import dataclass
from typing import Literal

from pipelines.core.errors import GeorefError
from pipelines.core.figures import Headline, SurfaceAccuracy
from pipelines.core.manifest import Memo
from pipelines.core.products import Remark, is_checked
from pipelines.core.sentences import listed
from pipelines.core.stages import ADJUSTMENT, BY_NAME, MODEL, PIPELINE, REPORT, SPARSE
from pipelines.core.staleness import is_made_from
from pipelines.core.types import Vector3
from pipelines.core.workspace import Workspace
from pipelines.geodesy.vertical import MOST_GEOID_M
from pipelines.survey.report import (
    AccuracySummary,
    CheckPointErrors,
    EvaluationReport,
    PointError,
    PointResidual,
    PredictedPointError,
    read_report,
)

NOTHING_CHECKS = "nothing checks the σ of the positions"


def headline(
    triangulated: CheckPointErrors,
    scene: AccuracySummary,
    cautions: tuple[Remark, ...],
    surface: SurfaceAccuracy | None = None,
) -> Headline:
    """Return the accuracy as the triangulated check points outside vegetation measure it, else as σ predict it.

    `surface` is what the check points say of the surface.
    """
    total = triangulated.with_survey
    if total is None:
        return predicted(scene, cautions).model_copy(update={"surface": surface})
    under = triangulated.asprs.vegetated
    others = triangulated.with_survey_without_refuted
    return Headline(
        kind="measured",
        rmse_h_m=total.rmse_h_m,
        rmse_v_m=total.rmse_v_m,
        check_points=triangulated.asprs.points,
        vegetated=0 if under is None else under.count,
        beyond_class=len(set(triangulated.blunders) - set(triangulated.refuted)),
        blunders=() if others is None else triangulated.refuted,
        rmse_h_without_m=None if others is None else others.rmse_h_m,
        rmse_v_without_m=None if others is None else others.rmse_v_m,
        surface=surface,
    )


def predicted(scene: AccuracySummary, cautions: tuple[Remark, ...]) -> Headline:
    """Return the predicted accuracy: the root mean square of σ over the cells of the scene.

    Without anything that checks the σ of the positions, the accuracy is not known.
    """
    if not is_checked(cautions):
        return Headline(kind="unknown", reason=NOTHING_CHECKS)
    if scene.rms_sigma_h_m is None or scene.rms_sigma_v_m is None:
        return Headline(kind="unknown", reason=scene.reason or "no σ is predicted")
    # A σ beyond that of any datum says that the zero of the heights is unknown.
    vertical_m = scene.rms_sigma_v_m if scene.rms_sigma_v_m < MOST_GEOID_M else None
    return Headline(kind="predicted", rmse_h_m=scene.rms_sigma_h_m, rmse_v_m=vertical_m)


def headline_of(workspace: Workspace, memo: Memo | None = None) -> Headline | None:
    """Return the accuracy of a workspace: that of its evaluation, else the predicted one; None: neither exists.

    An evaluation of an earlier solution states none. Nor does a damaged report; `georef status` names it. The memo
    of hashes by path is extended.
    """
    if is_evaluated(workspace, memo):
        with contextlib.suppress(GeorefError):
            return read_report(workspace.path(REPORT)).headline
    return predicted_headline(workspace)


def is_evaluated(workspace: Workspace, memo: Memo | None = None) -> bool:
    """Return whether there is an evaluation of the solution that `read_solution` returns."""
    solution = (MODEL,) if workspace.has(MODEL) else (ADJUSTMENT, MODEL)
    hashed = {} if memo is None else memo
    return workspace.has(REPORT) and is_made_from(workspace, BY_NAME["evaluate"], solution, hashed)


def with_newest_solution(workspace: Workspace, memo: Memo | None = None) -> Workspace:
    """Return the workspace as if what a newer SfM model or `init-sim3` has outdated did not exist.

    That are a solution or a training of another SfM model, a training of another `init-sim3`, and the evaluation of
    another solution. The memo of hashes by path is extended.
    """
    memo = {} if memo is None else memo
    for stage, made_from in {"init-sim3": (SPARSE,), "train": (SPARSE, ADJUSTMENT)}.items():
        if not is_made_from(workspace, BY_NAME[stage], made_from, memo):
            workspace = workspace.without(BY_NAME[stage])
    return workspace if is_evaluated(workspace, memo) else workspace.without(BY_NAME["evaluate"])


def outdated(workspace: Workspace, newest: Workspace) -> dict[str, tuple[Remark, ...]]:
    """Return the caution that a workspace has more than its `newest` solution, under the first of the others."""
    hidden = [spec for spec in PIPELINE if spec.folder in newest.hidden and workspace.has(spec.product)]
    if not hidden:
        return {}
    names = listed([spec.name for spec in hidden])
    many = len(hidden) > 1
    caution = Remark(
        code="result-of-earlier-solution",
        sentence=f"{names} {'are' if many else 'is'} stale: an earlier stage has a newer result. "
        f"The accuracy stated here is not that of {'them' if many else 'it'}.",
        remedy=f"`georef run {(workspace.base or workspace).root}` makes {'them' if many else 'it'} again.",
    )
    return {hidden[0].name: (caution,)}


def predicted_headline(workspace: Workspace) -> Headline | None:
    """Return the accuracy that the adjustment of the training, else of init-sim3, predicts; None: there is neither.

    A damaged product states none; `georef status` names it.
    """
    from pipelines.survey.solution import read_solution

    with contextlib.suppress(GeorefError):
        solution = read_solution(workspace)
        return None if solution.accuracy is None else predicted(solution.accuracy, solution.cautions)
    return None


Way = Literal["triangulated", "surface", "left out", "fit"]


@dataclass(frozen=True)
class PointLine:
    """Error of one check or control point, measured in one way.

    Ways: triangulated, on the rendered surface, by a solution that left the point out, residual of the fit.
    """

    use: Literal["check", "control"]
    way: Way
    row: PointResidual

    @property
    def sigma_m(self) -> Vector3 | None:
        """Predicted σ east, north, up; None: there is no prediction."""
        return self.row.sigma_m if isinstance(self.row, PredictedPointError) else None

    @property
    def is_blunder(self) -> bool:
        """Whether the error exceeds three times the class that the other points meet."""
        return isinstance(self.row, PointError) and self.row.blunder


def point_lines(report: EvaluationReport) -> list[PointLine]:
    """Return the errors of all points: check points triangulated and on the rendered surface, then control points.

    A control point's error in a solution without it measures accuracy; its residual of the fit does not.
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
