"""Training of Gaussians alone: similarity, cameras, lens and exposures are those of the solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pipelines.core.products import load_json
from pipelines.core.stages import SIM3, SOLUTION, SPARSE
from pipelines.core.types import IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.georef.problem import GeoProblem
from pipelines.scene.calibrated import load_survey
from pipelines.scene.frozen_solution import exposures_of, held_problem
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene, initial_scene
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import FrozenSolution
from pipelines.splat.exposure import HeldExposures


@dataclass(frozen=True)
class SolvedScene:
    """Scene of a survey, or of some of its cameras, with the solution that its training holds.

    Attributes:
        survey: the measurements.
        scene: cameras and SfM points.
        solution: of the same cameras.
    """

    survey: Survey
    scene: Scene
    solution: FrozenSolution

    def of_images(self, images: IntArray) -> SolvedScene:
        """Return the scene of some cameras (K,), in ascending order."""
        cameras = tuple(self.solution.cameras[index] for index in sorted(set(images.tolist())))
        solution = self.solution.model_copy(update={"cameras": cameras})
        return SolvedScene(self.survey, self.scene.of_images(images), solution)

    def trained_on(self, train: IntArray) -> SolvedScene:
        """Return the scene with other training images (T,), ascending."""
        return replace(self, scene=replace(self.scene, train=train))

    def problem(self) -> GeoProblem:
        """Return the problem that holds the solution."""
        return held_problem(self.scene, self.solution)

    def exposures(self, device: torch.device) -> HeldExposures | None:
        """Return the exposures of the solution; None: it has none."""
        exposures = exposures_of(self.solution)
        return None if exposures is None else HeldExposures(torch.from_numpy(exposures).float().to(device))


def load_solved_scene(workspace: Workspace) -> SolvedScene:
    """Return the scene of the whole survey with its solution.

    Raises:
        GeorefError: a product does not exist or cannot be read.
    """
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    survey = initial.weighted(load_survey(workspace))
    scene = initial_scene(read_sparse(workspace.path(SPARSE)), survey, initial)
    return SolvedScene(survey, scene, load_json(FrozenSolution, workspace.path(SOLUTION)))
