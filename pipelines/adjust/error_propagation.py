"""Propagation of the measurements' errors to the trained survey: the basis of every predicted accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from pipelines.adjust.accuracy_grid import AccuracyGrid, accuracy_grid
from pipelines.adjust.prediction import AccuracyPrediction
from pipelines.adjust.solved_survey import SolvedSurvey, geographic_options_of, solve_survey
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.stages import SIM3
from pipelines.core.workspace import Workspace
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.report import AccuracySummary
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class ErrorPropagation:
    """Covariances of a trained survey, from those of its measurements.

    Attributes:
        solved: the survey with its measurements solved, without photographs.
        prediction: gives the covariance of any point.
    """

    solved: SolvedSurvey
    prediction: AccuracyPrediction

    @cached_property
    def grid(self) -> AccuracyGrid | None:
        """Predicted σ over the scene; None: the scene has too few points."""
        return accuracy_grid(self.solved, self.prediction)


@dataclass(frozen=True)
class NoErrorPropagation:
    """Reason why the measurements do not determine the trained survey."""

    reason: str


def propagate_errors(workspace: Workspace, trained: TrainedSurvey) -> ErrorPropagation | NoErrorPropagation:
    """Return the covariances of the trained survey of a workspace, or the reason why there are none.

    Args:
        workspace: has the initial similarity and the options of the training.
        trained: the trained survey.

    Raises:
        MissingProductError: init-sim3 has not been run.
        InputError: a product is damaged, or a constant error is to be estimated whose measurements were not
            recorded.
    """
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    try:
        solved = solve_survey(trained, initial, geographic_options_of(workspace))
        return ErrorPropagation(solved, AccuracyPrediction(solved))
    except (ConvergenceError, DegenerateGeometryError) as error:
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
