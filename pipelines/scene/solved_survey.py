"""The geographic half of a training: set up again from its products, and brought to its minimum."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.geometry.similarity import Similarity
from pipelines.georef.posterior import minimise
from pipelines.georef.problem import GeoProblem
from pipelines.scene.geographic import geo_problem
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene, make_scene
from pipelines.scene.trained_survey import TrainedSurvey


@dataclass(frozen=True)
class SolvedSurvey:
    """A trained survey with what was measured of it.

    Attributes:
        trained: the product.
        scene: as at the start of the training.
        problem: similarity, cameras and measurements, at the minimum of the whitened loss.
        options: what it was trained with.
    """

    trained: TrainedSurvey
    scene: Scene
    problem: GeoProblem
    options: GeographicOptions


def geographic_options_of(workspace: Workspace) -> GeographicOptions:
    """What a workspace's model was trained with; the defaults for one that was put there by hand."""
    manifest = workspace.manifest(BY_NAME["train"])
    recorded = {} if manifest is None else manifest.config
    return GeographicOptions.model_validate(
        {name: recorded[name] for name in GeographicOptions.model_fields if name in recorded}
    )


def solve_survey(trained: TrainedSurvey, initial: InitialSimilarity, options: GeographicOptions) -> SolvedSurvey:
    """Set up the measurements as for the training, and solve them without the photographs, from its result.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    model_from_local = Similarity.from_record(trained.model.model_from_local)
    start = Similarity.from_record(initial.geo_from_local) @ model_from_local.inverse()
    scene = make_scene(trained.sfm, trained.survey, model_from_local, start.translation)
    # Distances repeat what the fixes say, and have no part in the whitened residuals.
    changed: dict[str, object] = {"rel_loss": False}
    if options.weighting != "whitened":  # which estimates no constant errors
        changed |= {"weighting": "whitened", "estimate": "none"}
    problem = geo_problem(scene, trained.survey, initial, options.model_copy(update=changed))
    problem.similarity.place(trained.geo_from_model)
    minimise(problem)
    return SolvedSurvey(trained, scene, problem, options)
