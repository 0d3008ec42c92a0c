"""The measurements' errors, propagated to the trained survey: the basis of every predicted accuracy."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.errors import DegenerateGeometryError
from pipelines.evaluate.accuracy_map import AccuracyGrid, accuracy_grid
from pipelines.evaluate.prediction import Prediction
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.report import AccuracySummary
from pipelines.scene.restored import Restored, restore
from pipelines.scene.trained import Trained


@dataclass(frozen=True)
class ErrorPropagation:
    """Covariances of a trained survey that follow from its measurements.

    Attributes:
        restored: the geographic half of the training, solved.
        prediction: covariance of any point.
        grid: σ over the scene; None for a scene of too few points.
    """

    restored: Restored
    prediction: Prediction
    grid: AccuracyGrid | None


@dataclass(frozen=True)
class NoErrorPropagation:
    """The reason why the measurements do not determine the trained survey."""

    reason: str


def propagate_errors(
    trained: Trained, initial: InitialSimilarity, options: GeographicOptions
) -> ErrorPropagation | NoErrorPropagation:
    """Return the covariances of a trained survey, or why there are none.

    Args:
        trained: the model.
        initial: the similarity with which the training began.
        options: those of the training.
    """
    try:
        restored = restore(trained, initial, options)
        prediction = Prediction(restored)
        return ErrorPropagation(restored, prediction, accuracy_grid(restored, prediction))
    except DegenerateGeometryError as error:
        return NoErrorPropagation(str(error))


def accuracy_summary(propagation: ErrorPropagation | NoErrorPropagation, *, of_initial: bool) -> AccuracySummary:
    """Return the predicted accuracy over the scene in short.

    Args:
        propagation: of the trained survey.
        of_initial: whether the points are measured with the initial similarity.
    """
    if isinstance(propagation, NoErrorPropagation):
        return AccuracySummary(cells=0, reason=propagation.reason, cautions=())
    cautions = propagation.prediction.cautions
    if of_initial:
        cautions += ("measured with the initial similarity: the prediction is that of the trained one",)
    if propagation.grid is None:
        return AccuracySummary(cells=0, reason="the scene has too few points", cautions=cautions)
    return propagation.grid.summary(cautions)
