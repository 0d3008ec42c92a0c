"""State that a training starts from, in a solution, and the solution of the state that it ends with."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from pipelines.adjust.measurements import problem_of, rejected_of
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import adjusted
from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.system import Problem
from pipelines.adjust.terms import Planes
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.splat.exposure import FrozenExposures
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import Solution
from pipelines.survey.survey import MOUNT_PARAMETERS, Survey


def frozen_exposures(solution: Solution, device: torch.device) -> FrozenExposures | None:
    """Return the exposures of a solution, the identity for cameras without one; None: nobody has one."""
    exposures = [camera.exposure for camera in solution.cameras]
    if all(exposure is None for exposure in exposures):
        return None
    every = np.array([np.eye(3, 4) if exposure is None else exposure for exposure in exposures])
    return FrozenExposures(torch.from_numpy(every).float().to(device))


def measured_problem(
    solution: Solution,
    survey: Survey,
    scene: SparseScene,
    *,
    control_points: bool = True,
    planes: Planes | None = None,
) -> Problem:
    """Return the measurements that a solution uses, with the systematic errors that it has estimated.

    Planes are those of a LiDAR whose shift is a systematic error.
    """
    survey = solution.in_use(survey)
    if not control_points:
        survey = survey.model_copy(update={"control_points": ()})
    known = {error.name for error in solution.estimated_errors}
    return problem_of(
        scene,
        survey,
        estimate=tuple(name for name in MOUNT_PARAMETERS if name in known),
        with_attitudes=any(one.kind == "attitude" for one in solution.measurements),
        planes=planes,
    )


def state_of(solution: Solution, scene: SparseScene, errors: SystematicErrors) -> State:
    """Return a solution as corrections of SfM's cameras and lens, with values of systematic errors."""
    sfm, poses, lenses = scene.poses, solution.poses, scene.sparse.lenses
    turn = -log_so3(np.swapaxes(sfm.cam_from_model, 1, 2) @ poses.cam_from_model)
    moved = poses.cam_center_in_model - sfm.cam_center_in_model
    return State(
        solution.similarity,
        np.concatenate([turn, moved], axis=1),
        lenses.change_to(solution.with_lenses(scene.sparse).lenses),
        error_estimates(solution, errors)[0],
    )


def error_estimates(solution: Solution, errors: SystematicErrors) -> tuple[FloatArray, FloatArray]:
    """Return the values (p,) of systematic errors in a solution, and their σ (p,), in metres and radians.

    An error that it does not have is zero, with the σ of its prior.
    """
    sigma = np.array([block.sigma for block in errors.blocks], dtype=np.float64).reshape(-1)
    value = np.zeros(len(errors))
    # Every error as it was solved. The estimates, which have σ, leave out the drift of the fixes and the common
    # rotation of the attitudes.
    solved = {one.name: one.residual for one in solution.measurements if one.kind == "systematic error"}
    for row, block in enumerate(errors.blocks):
        value[3 * row : 3 * row + 3] = solved.get(block.label, (0.0, 0.0, 0.0))
    for estimate in solution.estimated_errors:
        columns = errors.columns(estimate.name, estimate.session)
        if columns is not None:
            sigma[columns] = np.array(estimate.sigma) * (np.radians(1.0) if estimate.unit == "deg" else 1.0)
    return value, sigma


def solved_at(solution: Solution, survey: Survey, scene: SparseScene, problem: Problem, state: State) -> Posterior:
    """Return a state of the measurements, which must be determined, as a solution with its covariances.

    The verdict of the solution before it on each measurement stands.
    """
    return adjusted(scene, problem, state, solution, rejected_of(scene, survey, solution))


def figures_of(solution: Solution) -> dict[str, Any]:
    """Return what the summary of a training says of its solution."""
    sigma = np.sqrt(np.diag(np.array(solution.geo_from_model.covariance)))
    return {
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(solution.gnss_outliers),
        "control_outliers": list(solution.control_outliers),
        "estimated_errors": [error.model_dump() for error in solution.estimated_errors],
    }


def with_exposures(solution: Solution, exposure: FloatArray) -> Solution:
    """Return a solution with the exposures (n, 3, 4) of its cameras."""
    cameras = tuple(
        camera.model_copy(update={"exposure": tuple(map(tuple, affine.tolist()))})
        for camera, affine in zip(solution.cameras, exposure, strict=True)
    )
    return solution.model_copy(update={"cameras": cameras})
