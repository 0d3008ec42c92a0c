"""Bundle adjustment of raw image measurements: cameras and points from pixels and surveyed points alone.

SfM delivers a bundle at its minimum. Measurements of another program come without that minimum: Gauss–Newton steps
find it, with the program's own normal equations. The points are eliminated (`geometry.bundle`), the cameras solved
(`adjust.system.NormalMatrix`), the points follow (`adjust.posterior`). All observations have their stated weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipelines.adjust.system import NormalMatrix
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.intersection import IntersectionJacobian, intersection_jacobian
from pipelines.geometry.network import (
    Network,
    eliminate_points,
    has_positive_depth,
    linearise_bundle,
    projection_residuals,
)
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import jacobian_at

_STEPS = 30
_CONVERGED_SIGMAS = 1e-6  # the steps end when no residual changes by more
_COLLINEAR = 1e-6  # width of the control points' layout over its length, below which they lie on one line


@dataclass(frozen=True)
class SurveyedPoints:
    """Surveyed points: rows (J,) in `point_in_world`, positions (J, 3) in metres, covariances (J, 3, 3) in m²."""

    point: IntArray
    position_in_world: FloatArray
    cov_in_world: FloatArray


@dataclass(frozen=True)
class AdjustedBundle:
    """Adjusted network with its covariances, which take the lens as exactly known.

    Attributes:
        residual_px: (M, 2) projected minus observed.
        sigma0: root of the weighted sum of squares over the redundancy; 1 where all σ are true.
        points: derivatives of the points by the camera poses.
    """

    network: Network
    residual_px: FloatArray
    sigma0: float
    redundancy: int
    normal: NormalMatrix
    points: IntersectionJacobian

    @cached_property
    def camera_cov(self) -> FloatArray:
        """Covariances (n, 6, 6) of (δω [rad], δc [m]) along the axes of `world`, at the stated σ."""
        count = len(self.network.camera_id)
        return self.normal.of_each_camera(
            np.arange(count), np.tile(np.eye(6), (count, 1, 1)), np.zeros((count, 6, 0))
        )

    @cached_property
    def point_cov(self) -> FloatArray:
        """Covariances (N, 3, 3) of the points in m², at the stated σ."""
        none = np.zeros((3 * len(self.network.point_in_world), 0))
        return self.normal.covariances(self.points.by_poses, none, 3) + self.points.cov_of_marks


def adjust_bundle(network: Network, sigma_px: FloatArray, surveyed: SurveyedPoints) -> AdjustedBundle:
    """Return the least-squares adjustment of a network, from its approximate cameras and points.

    The lens is frozen; σ (M,) are of the observations; a network needs three or more control points.

    Raises:
        InputError: a point lies behind a camera that observes it.
        ConvergenceError: the steps do not converge.
        DegenerateGeometryError: fewer than three control points, or all on one line.
    """
    information = np.zeros((len(network.point_in_world), 3, 3))
    information[surveyed.point] = np.linalg.inv(surveyed.cov_in_world)
    target = network.point_in_world.copy()
    target[surveyed.point] = surveyed.position_in_world
    _refuse_open_layouts(surveyed)
    before = np.full((len(sigma_px), 2), np.inf)
    for _ in range(_STEPS):
        if not has_positive_depth(network).all():
            raise InputError("point-behind-camera", "A point lies behind a camera that observes it.")
        residual = projection_residuals(network)
        apart = network.point_in_world - target
        gradient = np.einsum("nij,nj->ni", information, apart)
        sums = eliminate_points(network, 1.0 / sigma_px, information)
        normal = NormalMatrix(
            sums.poses, np.zeros((0, sums.poses.shape[0])), np.zeros((0, 0)), network.cam_center_in_world
        )
        points = intersection_jacobian(network, sigma_px, information)
        if (np.abs(residual - before) / sigma_px[:, None]).max() < _CONVERGED_SIGMAS:
            observed = 2 * len(sigma_px) + 3 * len(surveyed.point)
            redundancy = observed - 6 * len(network.camera_id) - 3 * len(network.point_in_world)
            squares = float(((residual / sigma_px[:, None]) ** 2).sum() + (apart * gradient).sum())
            return AdjustedBundle(network, residual, np.sqrt(squares / redundancy), redundancy, normal, points)
        # Slopes of half the weighted squares: by the points, and by the poses that the points follow.
        lin, weighted = linearise_bundle(network), residual / sigma_px[:, None] ** 2
        slope, pose_slope = gradient.copy(), np.zeros((len(network.camera_id), 6))
        np.add.at(slope, network.obs_point, np.einsum("mij,mi->mj", lin.jacobian_point, weighted))
        np.add.at(pose_slope, network.obs_image, np.einsum("mij,mi->mj", lin.jacobian_pose, weighted))
        right = -(pose_slope.ravel() + points.by_poses.T @ slope.ravel())
        step, _ = normal.solve(right[:, None], np.zeros((0, 1)))
        network, before = _moved(network, step[:, 0], points, slope), residual
    raise ConvergenceError(
        "bundle-not-converged",
        f"The bundle adjustment has not converged after {_STEPS} steps. Start with better cameras and points.",
    )


def _refuse_open_layouts(surveyed: SurveyedPoints) -> None:
    position = surveyed.position_in_world
    by_similarity = jacobian_at(position, position.mean(axis=0) if len(position) else np.zeros(3)).reshape(-1, 7)
    if np.linalg.matrix_rank(by_similarity, tol=_COLLINEAR * np.abs(by_similarity).max(initial=1.0)) < 7:
        raise DegenerateGeometryError(
            "similarity-open",
            f"{len(position)} control points do not determine the frame: at least three that are not on one line "
            "are needed.",
        )


def _moved(network: Network, step: FloatArray, points: IntersectionJacobian, slope: FloatArray) -> Network:
    """Return the network after a step (6 n,) of the cameras; the points move to their minimum by `slope` (N, 3)."""
    turn, shift = np.split(step.reshape(-1, 6), 2, axis=1)
    followed = (points.by_poses @ step).reshape(-1, 3) - np.einsum("nij,nj->ni", points.cov_of_marks, slope)
    return replace(
        network,
        cam_from_world=network.cam_from_world @ exp_so3(-turn),
        cam_center_in_world=network.cam_center_in_world + shift,
        point_in_world=network.point_in_world + followed,
    )
