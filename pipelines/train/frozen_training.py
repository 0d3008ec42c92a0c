"""Training of Gaussians alone: similarity, cameras, lens and exposures are those of the solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pipelines.adjust.frozen_solution import exposures_of, held_problem
from pipelines.adjust.problem import GeoProblem
from pipelines.core.products import load_json
from pipelines.core.stages import SOLUTION
from pipelines.core.types import IntArray
from pipelines.core.workspace import Workspace
from pipelines.scene.photographs import ImageCache
from pipelines.scene.pinholes import Pinholes
from pipelines.scene.scene import Scene, load_initial_scene
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import FrozenSolution
from pipelines.splat.exposure import HeldExposures
from pipelines.splat.rasterizer.api import Rasterizer
from pipelines.train.region import RegionViews


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

    def views(self, images: ImageCache, indices: IntArray, rasterizer: Rasterizer) -> RegionViews:
        """Return views (T,), under the lenses of the solution, in which a region can be looked for."""
        pinholes = Pinholes(images, self.scene.sparse.lenses)
        pinholes.renew(self.solution.with_lenses(self.scene.sparse).lenses)
        return RegionViews(indices, self.solution.poses, pinholes, rasterizer)

    def exposures(self, device: torch.device) -> HeldExposures | None:
        """Return the exposures of the solution; None: it has none."""
        exposures = exposures_of(self.solution)
        return None if exposures is None else HeldExposures(torch.from_numpy(exposures).float().to(device))


def load_solved_scene(workspace: Workspace) -> SolvedScene:
    """Return the scene of the whole survey with its solution.

    Raises:
        GeorefError: a product does not exist or cannot be read.
    """
    _, survey, scene = load_initial_scene(workspace)
    return SolvedScene(survey, scene, load_json(FrozenSolution, workspace.path(SOLUTION)))
