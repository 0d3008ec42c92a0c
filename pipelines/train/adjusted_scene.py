"""Scene of a training with the adjustment that it starts from, and its solution without photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import torch

from pipelines.adjust.measurements import problem_of, rejected_of
from pipelines.adjust.options import EstimatedErrorName
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import adjusted
from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.system import Problem, linearised, posterior_weights
from pipelines.adjust.terms import Planes
from pipelines.core.stages import ADJUSTMENT
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import log_so3
from pipelines.splat.exposure import FrozenExposures
from pipelines.survey.adjustment import InitialSimilarity
from pipelines.survey.scene import Scene, load_adjusted_scene
from pipelines.survey.survey import Survey
from pipelines.survey.trained_model import Adjustment


@dataclass(frozen=True)
class AdjustedScene:
    """Scene of a survey, or of some of its cameras, with their adjustment."""

    initial: InitialSimilarity  # product of `init-sim3`; its verdict on each measurement stands
    survey: Survey  # the measurements, with the variance factors in their covariances
    scene: Scene  # cameras and points as SfM left them, in the frame of the adjustment
    adjustment: Adjustment  # of the same cameras

    @classmethod
    def load(cls, workspace: Workspace, product: str = ADJUSTMENT) -> AdjustedScene:
        """Return the scene of the whole survey; arguments and errors are those of `load_adjusted_scene`."""
        initial, adjustment, survey, scene = load_adjusted_scene(workspace, product)
        return cls(initial, survey, scene, adjustment)

    def of_images(self, images: IntArray) -> AdjustedScene:
        """Return the scene of some cameras (K,), in ascending order."""
        cameras = tuple(self.adjustment.cameras[index] for index in sorted(set(images.tolist())))
        adjustment = self.adjustment.model_copy(update={"cameras": cameras})
        return replace(self, scene=self.scene.of_images(images), adjustment=adjustment)

    def exposures(self, device: torch.device) -> FrozenExposures | None:
        """Return the exposures of the adjustment, the identity for cameras without one; None: nobody has one."""
        exposures = [camera.exposure for camera in self.adjustment.cameras]
        if all(exposure is None for exposure in exposures):
            return None
        every = np.array([np.eye(3, 4) if exposure is None else exposure for exposure in exposures])
        return FrozenExposures(torch.from_numpy(every).float().to(device))

    def measured(self, *, control_points: bool = True, planes: Planes | None = None) -> Problem:
        """Return the measurements in use, with the systematic errors that the adjustment has estimated.

        Planes are those of a LiDAR whose shift is a systematic error.
        """
        survey = self.initial.in_use(self.survey)
        if not control_points:
            survey = survey.model_copy(update={"control_points": ()})
        known = {error.name for error in self.adjustment.estimated_errors}
        return problem_of(
            self.scene,
            survey,
            estimate=tuple(name for name in get_args(EstimatedErrorName) if name in known),
            with_attitudes=self.initial.layout == "line",
            planes=planes,
        )

    def state(self, errors: SystematicErrors) -> State:
        """Return the adjustment as corrections of SfM's cameras and lens, with values of systematic errors."""
        sfm, poses, lenses = self.scene.poses, self.adjustment.poses, self.scene.sparse.lenses
        turn = -log_so3(np.swapaxes(sfm.cam_from_model, 1, 2) @ poses.cam_from_model)
        moved = poses.cam_center_in_model - sfm.cam_center_in_model
        return State(
            self.adjustment.similarity,
            np.concatenate([turn, moved], axis=1),
            lenses.change_to(self.adjustment.with_lenses(self.scene.sparse).lenses),
            self.error_estimates(errors)[0],
        )

    def error_estimates(self, errors: SystematicErrors) -> tuple[FloatArray, FloatArray]:
        """Return the values (p,) of systematic errors in the adjustment, and their σ (p,), in metres and radians.

        An error that it does not have is zero, with the σ of its prior.
        """
        sigma = np.array([block.sigma for block in errors.blocks], dtype=np.float64).reshape(-1)
        value = np.zeros(len(errors))
        for estimate in self.adjustment.estimated_errors:
            columns = errors.columns(estimate.name, estimate.session)
            if columns is not None:
                unit = np.radians(1.0) if estimate.unit == "deg" else 1.0
                value[columns], sigma[columns] = unit * np.array(estimate.value), unit * np.array(estimate.sigma)
        # The estimates leave out the rotation that all attitudes share, and the drift of the fixes.
        solved = {one.name: one.residual for one in self.adjustment.measurements if one.kind == "systematic error"}
        for row, block in enumerate(errors.blocks):
            if block.name in ("common", "drift") and block.label in solved:
                value[3 * row : 3 * row + 3] = solved[block.label]
        return value, sigma

    def require_determined(self, problem: Problem) -> None:
        """Refuse measurements that leave the similarity open, by a `DegenerateGeometryError`.

        A training could not state their adjustment at its end.
        """
        near = linearised(problem, self.state(problem.errors))
        near.normal(posterior_weights(near.residuals))

    def posterior(self, problem: Problem, state: State) -> Posterior:
        """Return a state of the measurements, which must be determined, as an adjustment with its covariances."""
        rejected = rejected_of(self.scene, self.survey, self.initial)
        return adjusted(self.scene, problem, state, self.initial, rejected)


def figures_of(adjustment: Adjustment) -> dict[str, Any]:
    """Return what the summary of a training says of its adjustment."""
    sigma = np.sqrt(np.diag(np.array(adjustment.geo_from_model.covariance)))
    return {
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(adjustment.gnss_outliers),
        "control_outliers": list(adjustment.control_outliers),
        "estimated_errors": [error.model_dump() for error in adjustment.estimated_errors],
    }


def with_exposures(adjustment: Adjustment, exposure: FloatArray) -> Adjustment:
    """Return an adjustment with the exposures (n, 3, 4) of its cameras."""
    cameras = tuple(
        camera.model_copy(update={"exposure": tuple(map(tuple, affine.tolist()))})
        for camera, affine in zip(adjustment.cameras, exposure, strict=True)
    )
    return adjustment.model_copy(update={"cameras": cameras})
