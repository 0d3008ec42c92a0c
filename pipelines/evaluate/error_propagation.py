"""Propagation of the measurements' errors to the trained survey: the basis of every predicted accuracy."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.errors import DegenerateGeometryError
from pipelines.evaluate.accuracy_map import AccuracyGrid, accuracy_grid
from pipelines.evaluate.prediction import AccuracyPrediction
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.report import AccuracySummary
from pipelines.scene.solved_survey import SolvedSurvey, solve_survey
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class ErrorPropagation:
    """Covariances of a trained survey, from those of its measurements.

    Attributes:
        solved: the survey with its measurements solved, without photographs.
        prediction: gives the covariance of any point.
        grid: predicted σ over the scene; None: the scene has too few points.
    """

    solved: SolvedSurvey
    prediction: AccuracyPrediction
    grid: AccuracyGrid | None


@dataclass(frozen=True)
class NoErrorPropagation:
    """Reason why the measurements do not determine the trained survey."""

    reason: str


def propagate_errors(
    trained: TrainedSurvey, initial: InitialSimilarity, options: GeographicOptions
) -> ErrorPropagation | NoErrorPropagation:
    """Return the covariances of a trained survey, or the reason why there are none.

    Args:
        trained: the trained survey.
        initial: similarity at the start of the training.
        options: options of the training.

    Raises:
        InputError: a constant error is to be estimated, but its measurements were not recorded.
    """
    try:
        solved = solve_survey(trained, initial, options)
        prediction = AccuracyPrediction(solved)
        return ErrorPropagation(solved, prediction, accuracy_grid(solved, prediction))
    except DegenerateGeometryError as error:
        return NoErrorPropagation(str(error))


def accuracy_summary(propagation: ErrorPropagation | NoErrorPropagation) -> AccuracySummary:
    """Return the summary of the predicted accuracy over the scene.

    Args:
        propagation: gives the grid of σ, or the reason why there is none.
    """
    if isinstance(propagation, NoErrorPropagation):
        return AccuracySummary(cells=0, reason=propagation.reason)
    if propagation.grid is None:
        return AccuracySummary(cells=0, reason="the scene has too few points")
    return propagation.grid.summary()
