"""Geographic problem of a trained survey: set up again from its products, and solved."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.adjust.geographic import geo_problem
from pipelines.adjust.posterior import minimise
from pipelines.adjust.problem import GeoProblem
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.geometry.similarity import Similarity
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene, make_scene
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class SolvedSurvey:
    """Trained survey with the solved problem of its measurements.

    Attributes:
        trained: the trained survey.
        scene: scene at the start of the training.
        problem: similarity, cameras and measurements, at the minimum of the whitened loss.
        options: options of the training.
    """

    trained: TrainedSurvey
    scene: Scene
    problem: GeoProblem
    options: GeographicOptions


def geographic_options_of(workspace: Workspace) -> GeographicOptions:
    """Return the options with which a workspace's model was trained; the defaults for a model put there by hand."""
    manifest = workspace.manifest(BY_NAME["train"])
    recorded = {} if manifest is None else manifest.config
    return GeographicOptions.model_validate(
        {name: recorded[name] for name in GeographicOptions.model_fields if name in recorded}
    )


def solve_survey(trained: TrainedSurvey, initial: InitialSimilarity, options: GeographicOptions) -> SolvedSurvey:
    """Return the trained survey with its measurements solved anew, from the result of the training.

    The problem has the measurements of the training, and no photographs. Two things differ from the training: L_rel
    is left out, because its distances repeat the fixes; and the residuals are whitened also where the training used
    plain mean squares.

    Args:
        trained: the trained survey.
        initial: similarity of `init-sim3`.
        options: options of the training.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
        InputError: a constant error is to be estimated, but its measurements were not recorded.
    """
    model_from_local = Similarity.from_record(trained.model.model_from_local)
    start = Similarity.from_record(initial.geo_from_local) @ model_from_local.inverse()
    scene = make_scene(trained.sfm, trained.survey, model_from_local, start.translation)
    # The distances are functions of the fixes and have no part in the posterior.
    changed: dict[str, object] = {"rel_loss": False}
    if options.weighting != "whitened":  # A training with plain mean squares estimates no constant errors.
        changed |= {"weighting": "whitened", "estimate": ()}
    if options.solve == "joint":  # The photographs have no part here.
        changed["solve"] = "auto"
    solving = options.model_copy(update=changed).without_photographs(len(scene.sparse.image_name))
    problem = geo_problem(scene, trained.survey, initial, solving)
    problem.similarity.place(trained.geo_from_model)
    minimise(problem)
    return SolvedSurvey(trained, scene, problem, options)
