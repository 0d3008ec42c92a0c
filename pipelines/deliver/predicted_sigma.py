"""Predicted σ of the georeference over the scene, for files that state it."""

from __future__ import annotations

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.solution import posterior_of
from pipelines.core.cautions import is_checked
from pipelines.core.workspace import Workspace
from pipelines.scene.trained_survey import SolvedSurvey


def predicted_sigma(workspace: Workspace, solved: SolvedSurvey) -> tuple[AccuracyGrid | None, str]:
    """Return the predicted σ over the scene; None, with the reason as the end of a sentence, if it is not known.

    Nothing is stated where nothing checks it.

    Raises:
        MissingProductError: the solution was stored without its covariances.
        InputError: a product is damaged.
    """
    if not is_checked(solved.model.cautions):
        return None, "nothing checks the σ of the positions"
    grid = posterior_of(workspace, solved.model, solved.sfm).grid
    return grid, "" if grid is not None else "the scene has too few points"
