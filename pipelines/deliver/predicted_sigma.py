"""Predicted σ of the georeference over the scene, for files that state it."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.error_propagation import NoErrorPropagation, propagate_errors
from pipelines.core.cautions import is_checked
from pipelines.core.workspace import Workspace
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class PredictedSigma:
    """Predicted σ over the scene, or the reason why there is none.

    Attributes:
        grid: σ; None: not known.
        reason: why not, as the end of a sentence; empty if it is known.
    """

    grid: AccuracyGrid | None
    reason: str = ""


def predicted_sigma(workspace: Workspace, trained: TrainedSurvey) -> PredictedSigma:
    """Return the predicted σ of a trained survey. Nothing is stated where nothing checks it.

    Raises:
        MissingProductError: init-sim3 has not been run.
        InputError: a product is damaged.
    """
    if not is_checked(trained.model.cautions):
        return PredictedSigma(None, "nothing checks the σ of the positions")
    propagation = propagate_errors(workspace, trained)
    if isinstance(propagation, NoErrorPropagation):
        return PredictedSigma(None, propagation.reason)
    if propagation.grid is None:
        return PredictedSigma(None, "the scene has too few points")
    return PredictedSigma(propagation.grid)
