"""The geographic half of a training, restored from its products and brought to its minimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.georef.posterior import minimise
from pipelines.georef.problem import GeoProblem
from pipelines.georef.similarity import LearnableSimilarity
from pipelines.scene.geographic import geo_problem
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene, make_scene
from pipelines.scene.trained import Trained


@dataclass(frozen=True)
class Restored:
    """A trained survey with what was measured of it.

    Attributes:
        trained: the product.
        scene: as at the start of the training.
        problem: similarity, cameras and measurements, at the minimum of the whitened loss.
        options: what it was trained with.
    """

    trained: Trained
    scene: Scene
    problem: GeoProblem
    options: GeographicOptions


def geographic_options_of(workspace: Workspace) -> GeographicOptions:
    """What a workspace's model was trained with; the defaults for one that was put there by hand."""
    manifest = workspace.manifest(BY_NAME["train"])
    known = {} if manifest is None else manifest.config
    return GeographicOptions.model_validate(
        {key: known[key] for key in GeographicOptions.model_fields if key in known}
    )


def restore(trained: Trained, initial: InitialSimilarity, options: GeographicOptions) -> Restored:
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
        changed |= {"weighting": "whitened", "estimate": ()}
    problem = geo_problem(scene, trained.survey, initial, options.model_copy(update=changed))
    _place(problem.similarity, trained.geo_from_model)
    minimise(problem)
    return Restored(trained, scene, problem, options)


def _place(similarity: LearnableSimilarity, at: Similarity) -> None:
    """Give a similarity its value."""
    away = at @ similarity.base.inverse()
    shift = away.apply(similarity.pivot_in_geo) - similarity.pivot_in_geo
    delta = np.array([np.log(away.scale), *log_so3(away.rotation), *shift])
    y = np.linalg.solve(similarity.root.numpy(), delta)
    with torch.no_grad():
        similarity.y.copy_(torch.from_numpy(y))
