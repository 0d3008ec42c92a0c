"""Evaluation of solved cameras without a trained model, as `run --to init-sim3` and `status` tell it.

Nothing is written. The cameras measure the check points as they will after training, to within the changes of the
adjustment there.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipelines.core.errors import GeorefError
from pipelines.core.products import Remark, union
from pipelines.core.stages import MODEL, REPORT, SIM3
from pipelines.core.workspace import Workspace

if TYPE_CHECKING:
    from pipelines.survey.report import EvaluationReport

log = logging.getLogger(__name__)


def evaluated_cameras(workspace: Workspace, *, with_area: bool = True) -> EvaluationReport | None:
    """Return the evaluation of the cameras alone; without its area, which takes longest, where nobody shows it.

    None: a model is trained, there is a report of `georef evaluate`, or the cameras cannot be evaluated.
    """
    if workspace.has(MODEL) or workspace.has(REPORT) or not workspace.has(SIM3):
        return None
    from pipelines.adjust.solution import posterior_of
    from pipelines.evaluate.options import EvaluateOptions
    from pipelines.evaluate.stage import area_of_interest, evaluate
    from pipelines.survey.trained_survey import load_solved

    try:
        solved = load_solved(workspace)
        posterior, options = posterior_of(workspace, solved.model, solved.sfm), EvaluateOptions()
        area = area_of_interest(options, solved, workspace) if with_area else None
        return evaluate(solved, posterior, options, area=area)
    except GeorefError as error:  # The stages have succeeded all the same.
        log.debug("no evaluation of the cameras: %s", error)
        return None


def with_evaluation(
    cautions: Mapping[str, tuple[Remark, ...]], solved: EvaluationReport | None
) -> dict[str, tuple[Remark, ...]]:
    """Return the cautions by stage, with those that the evaluation of the cameras adds."""
    if solved is None:
        return dict(cautions)
    carried = union(*cautions.values())
    added = tuple(caution for caution in solved.cautions if caution not in carried)
    return {**cautions, **({"evaluation": added} if added else {})}
