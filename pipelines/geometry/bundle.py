"""Bundle of photographs: observations, their derivatives, and the information that they leave in the camera poses.

The normal equations (`geometry.network`) have a sparse part, and two dense ones of low rank complete it: the lens,
which all its cameras share, and the seven movements of a similarity, which no observation resists.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix
from scipy.special import exp1

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.network import (
    EliminatedPoints,
    Network,
    eliminate_points,
    projection_residuals,
    with_positive_depths,
)
from pipelines.geometry.rotations import skew
from pipelines.geometry.row_motion import RowMotion, with_row_motion
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.statistics import CAUCHY_SCALE2, cauchy_weight, rayleigh_sigma


def similarity_modes(cam_center_in_world: FloatArray) -> FloatArray:
    """Return the movements (n, 6, 7) of the cameras under an infinitesimal similarity about their mean centre.

    Rows (δω, δc) as in `BundleInformation`, columns (ln s, rotation, translation).
    """
    arm = cam_center_in_world - cam_center_in_world.mean(axis=0)
    modes = np.zeros((len(arm), 6, 7))
    modes[:, :3, 1:4] = np.eye(3)
    modes[:, 3:, 0] = arm
    modes[:, 3:, 1:4] = -skew(arm)
    modes[:, 3:, 4:] = np.eye(3)
    return modes


_SHARED_GRIDS = ((3, 2), (5, 4), (8, 6))  # columns and rows of the cells of a photograph
_IN_A_CELL = 20.0  # least mean number of observations: fewer show chance, and share little
_BY_CHANCE = 5.0  # σ of the factor of independent errors, which is 1
# A camera with few observations has a prior σ of a tenth of its distance from the scene.
_LOOSEST_RELATIVE_SIGMA = 0.1
# Means of the weight w and of w r²/2 under Gaussian noise of σ = 1, where r²/2 is exponentially distributed. Robust
# weights lower the sum of squares of pure noise: without these means the stated σ would be a fifth too small.
_HALF_SCALE2 = CAUCHY_SCALE2[2] / 2
_MEAN_WEIGHT = float(_HALF_SCALE2 * np.exp(_HALF_SCALE2) * exp1(_HALF_SCALE2))
_MEAN_WEIGHTED_SQUARE = _HALF_SCALE2 * (1 - _MEAN_WEIGHT)


# No feature of a photograph is located better; σ of a model without residuals, as a renderer computes it.
LEAST_SIGMA_PX = 0.01


@dataclass(frozen=True)
class BundleInformation:
    """Information of the image observations on corrections x = (δω, δc) (6 n,) of cameras and ℓ (L,) of the lens.

    The points are eliminated: the observations, which SfM has left at their minimum, cost
    ½ (x, ℓ)ᵀ [poses, cross; crossᵀ, lens] (x, ℓ).
    `δω` [rad] turns a camera about its centre, axes of the world: `R' = R Exp(−δω)`; `δc` [m] moves the centre. The
    order of ℓ is that of `geometry.cameras.Lenses`. The points follow cameras and lens; `followed` is their mean
    similarity, weighted by their information.
    """

    sums: EliminatedPoints  # the information
    similarity_modes: FloatArray  # (6 n, 7) as `similarity_modes`
    unit: FloatArray  # (6 n,) corrections that count as one metre at the scene
    loosest_sigma_m: float  # σ in these units that the prior gives even a camera without observations
    sigma_px: float  # σ of an image coordinate, estimated from the residuals
    row_motion: RowMotion | None = None  # what moves the rows of photographs, and is part of the information

    @cached_property
    def followed(self) -> FloatArray:
        """Mean similarity (7, 6 n + L) of the points that follow cameras and lens."""
        cross = np.concatenate([self.sums.pose_modes, self.sums.lens_modes])
        return np.asarray(-np.linalg.solve(self.sums.modes, cross.T))

    def turned(self, new_from_old: Similarity, cam_center_in_new: FloatArray) -> BundleInformation:
        """Return the same information in another frame, whose cameras have centres (n, 3)."""
        turn, scale = new_from_old.rotation, new_from_old.scale
        # Inverse transposed derivatives of the new corrections by the old ones, and of their mean similarity.
        by_correction = block_diag(turn, turn / scale)
        by_similarity = block_diag(1.0, turn, turn / scale)
        sums, count = self.sums, len(cam_center_in_new)

        def of_poses(values: FloatArray) -> FloatArray:
            return np.asarray(by_correction @ values.reshape(count, 6, -1)).reshape(values.shape)

        poses = sums.poses
        blocks = by_correction @ poses.data @ by_correction.T
        return BundleInformation(
            sums=EliminatedPoints(
                poses=bsr_matrix((blocks, poses.indices, poses.indptr), shape=poses.shape),
                cross=of_poses(sums.cross),
                lens=sums.lens,
                pose_modes=of_poses(sums.pose_modes) @ by_similarity.T,
                lens_modes=sums.lens_modes @ by_similarity.T,
                modes=by_similarity @ sums.modes @ by_similarity.T,
            ),
            similarity_modes=similarity_modes(cam_center_in_new).reshape(-1, 7),
            unit=self.unit * np.tile([1 / scale] * 3 + [1.0] * 3, count),
            loosest_sigma_m=scale * self.loosest_sigma_m,
            sigma_px=self.sigma_px,
            row_motion=self.row_motion,
        )


def bundle_information(network: Network) -> BundleInformation:
    """Return the information of a bundle on its cameras.

    1. Cauchy's kernel weights the observations, whose σ is estimated from the residuals.
    2. Errors that neighbours in a photograph share enlarge the variance (`shared_error_factor`).
    3. Rows that move, as of a rolling shutter, add to the covariance of the poses (`geometry.row_motion`).
    4. Chunks of points are eliminated one after the other, so that memory holds the derivatives of one chunk.

    Raises:
        DegenerateGeometryError: fewer observations than unknowns.
    """
    network = with_positive_depths(network)
    n, points, observations = len(network.camera_id), len(network.point_in_world), len(network.obs_point)
    redundancy = 2 * observations - 6 * n - 3 * points
    if redundancy <= 0:
        message = f"{observations} observations do not determine {n} cameras and {points} points."
        raise DegenerateGeometryError("network-undetermined", message)
    typical_m = float(np.median(np.linalg.norm(network.rays(), axis=1)))
    residual = projection_residuals(network)
    length = np.linalg.norm(residual, axis=1)
    weight = cauchy_weight((length / max(rayleigh_sigma(length), 1e-9)) ** 2, 2)
    variance = float((weight[:, None] * residual**2).sum() / (_MEAN_WEIGHTED_SQUARE * redundancy))
    # A computed model has no residuals at all, which is no infinite information; rounding has no pattern of a lens.
    has_noise = variance > LEAST_SIGMA_PX**2
    variance = max(variance, LEAST_SIGMA_PX**2)
    root_weight, motion = np.sqrt(weight / (_MEAN_WEIGHT * variance)), None
    if has_noise:
        sums, motion = with_row_motion(network, root_weight, residual)
        factor = shared_error_factor(network, weight[:, None] * residual)
        sums = sums.scaled(1.0 / factor) if motion is None else motion.considered(sums, factor)
    else:
        sums = eliminate_points(network, root_weight)
    return BundleInformation(
        sums=sums,
        similarity_modes=similarity_modes(network.cam_center_in_world).reshape(-1, 7),
        unit=np.tile([1 / typical_m] * 3 + [1.0] * 3, n),  # rotations in metres at the scene, so that units agree
        loosest_sigma_m=_LOOSEST_RELATIVE_SIGMA * typical_m,
        sigma_px=float(np.sqrt(variance)),
        row_motion=motion,
    )


def shared_error_factor(network: Network, residual: FloatArray) -> float:
    """Return the factor by which errors that neighbours in a photograph share enlarge the variance of a bundle.

    A lens that its model cannot express, or a rolling shutter, moves all observations of a part of a photograph
    alike: they do not average out as independent ones do. The factor is the sum of the squared sums of the
    residuals (M, 2) in the cells of a grid over that of their squares (the design effect of clustered samples), of
    the grid with the largest; 1 where chance explains it. The pose of a photograph has absorbed six of the sums.
    """
    factor = 1.0
    size = np.array([(camera.width, camera.height) for camera in network.cameras.values()], dtype=np.float64)
    row_of = dict(zip(network.cameras, range(len(size)), strict=True))
    of_image = size[[row_of[key] for key in network.camera_id.tolist()]]
    part = np.clip(network.obs_xy_px / of_image[network.obs_image], 0.0, 1.0 - 1e-9)
    total = float((residual**2).sum())
    for columns, rows in _SHARED_GRIDS:
        cell = (network.obs_image * columns + (part[:, 0] * columns).astype(np.int64)) * rows
        cell = cell + (part[:, 1] * rows).astype(np.int64)
        count = 2 * int((np.bincount(cell) > 0).sum())
        free = count - 6 * int((np.bincount(network.obs_image) > 0).sum())
        if free < count / 3 or total <= 0 or 2 * len(residual) < _IN_A_CELL * count:
            continue
        sums = sum(float((np.bincount(cell, values) ** 2).sum()) for values in residual.T)
        effect = sums / total * count / free
        if effect > 1.0 + _BY_CHANCE * (2.0 / free) ** 0.5:
            factor = max(factor, effect)
    return factor
