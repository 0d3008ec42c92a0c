"""Information that bundle adjustment leaves in the camera poses, as a sparse matrix.

The points are eliminated from the normal matrix of the bundle (Schur complement). Two cameras stay coupled only if
they see a common point, so that the memory grows with the number of cameras and not with its square. Two dense
parts of low rank complete the sparse one: the lens, which all its cameras share, and the seven movements of a
similarity, which no observation resists.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_matrix
from scipy.special import exp1

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.bundle import (
    Network,
    lens_slots,
    linearise_bundle,
    projection_residuals,
    similarity_modes,
    sparse_jacobian,
    with_positive_depths,
)
from pipelines.geometry.rotations import skew
from pipelines.robust.kernels import CAUCHY_SCALE2, cauchy_weight
from pipelines.robust.statistics import rayleigh_sigma

_CHUNK = 2**19  # observations that are linearised together
_RIDGE = 1e-9
# A camera with few observations is held to a tenth of its distance from the scene.
_LOOSEST_RELATIVE_SIGMA = 0.1
# Means of the weight w and of w r²/2 under Gaussian noise of σ = 1, where r²/2 is exponentially distributed. Robust
# weights lower the sum of squares of pure noise: without these means the stated σ would be a fifth too small.
_HALF_SCALE2 = CAUCHY_SCALE2[2] / 2
_MEAN_WEIGHT = float(_HALF_SCALE2 * np.exp(_HALF_SCALE2) * exp1(_HALF_SCALE2))
_MEAN_WEIGHTED_SQUARE = _HALF_SCALE2 * (1 - _MEAN_WEIGHT)


@dataclass(frozen=True)
class BundleInformation:
    """Information of the image observations on corrections x = (δω, δc) (6 n,) of all cameras, lens eliminated.

    The information is `by_poses` − `lens_follows`ᵀ `lens` `lens_follows`. Axes and signs of (δω, δc) are those of
    `geometry.correction_basis.CorrectionBasis`.

    Attributes:
        by_poses: (6 n, 6 n) sparse, in blocks (6, 6); points eliminated, lens held.
        lens_follows: (L, 6 n) expected change of the lens parameters, in the order of `geometry.lens.Lenses`.
        lens: (L, L) information on the lens parameters about that expectation; zero for unused parameters.
        lens_cov: (L, L) its inverse; zero likewise.
        points_follow: (7, 6 n) mean similarity of the points that follow the cameras, weighted by their
            information.
        similarity_modes: (6 n, 7) as `geometry.bundle.similarity_modes`.
        unit: (6 n,) corrections that count as one metre at the scene.
        loosest_sigma_m: σ in these units to which even a camera without observations is held.
        sigma_px: σ of an image coordinate, estimated from the residuals.
    """

    by_poses: bsr_matrix
    lens_follows: FloatArray
    lens: FloatArray
    lens_cov: FloatArray
    points_follow: FloatArray
    similarity_modes: FloatArray
    unit: FloatArray
    loosest_sigma_m: float
    sigma_px: float


def bundle_information(network: Network, *, lens_follows: bool = True) -> BundleInformation:
    """Return the information of a bundle on its cameras.

    1. Cauchy's kernel weights the observations.
    2. The lens is uncertain: its parameters are eliminated from the information, like the points.
    3. Chunks of points are eliminated one after the other, so that memory holds the derivatives of one chunk.

    Args:
        network: the bundle at its minimum.
        lens_follows: whether the points follow through the lens that follows the cameras. Otherwise they follow
            through the lens as it is.

    Raises:
        DegenerateGeometryError: fewer observations than unknowns.
    """
    network = with_positive_depths(network)
    n, points, observations = len(network.camera_id), len(network.point_in_world), len(network.obs_point)
    redundancy = 2 * observations - 6 * n - 3 * points
    if redundancy <= 0:
        raise DegenerateGeometryError(
            f"{observations} observations do not determine {n} cameras and {points} points"
        )
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    typical_m = float(np.median(np.linalg.norm(ray, axis=1)))
    residual = projection_residuals(network)
    weight = _robust_weights(residual)
    variance = float((weight[:, None] * residual**2).sum() / (_MEAN_WEIGHTED_SQUARE * redundancy))
    sums = eliminate_points(network, np.sqrt(weight / (_MEAN_WEIGHT * variance)))
    follows, lens, lens_cov = _lens_elimination(sums)
    pull = sums.pose_pull + follows.T @ sums.lens_pull if lens_follows else sums.pose_pull
    return BundleInformation(
        by_poses=sums.poses,
        lens_follows=follows,
        lens=lens,
        lens_cov=lens_cov,
        points_follow=np.asarray(-np.linalg.solve(sums.modes, pull.T)),
        similarity_modes=similarity_modes(network.cam_center_in_world).reshape(-1, 7),
        unit=np.tile([1 / typical_m] * 3 + [1.0] * 3, n),  # rotations in metres at the scene, so that units agree
        loosest_sigma_m=_LOOSEST_RELATIVE_SIGMA * typical_m,
        sigma_px=float(np.sqrt(variance)),
    )


def _robust_weights(residual: FloatArray) -> FloatArray:
    length = np.linalg.norm(residual, axis=1)
    scale = max(rayleigh_sigma(length), 1e-9)
    return cauchy_weight((length / scale) ** 2, 2)


@dataclass(frozen=True)
class EliminatedPoints:
    """Normal equations of n poses and L lens parameters, with the points eliminated.

    Attributes:
        poses: (6 n, 6 n) sparse, in blocks (6, 6).
        cross: (6 n, L).
        lens: (L, L).
        pose_pull: (6 n, 7) of the poses on the points' similarity.
        lens_pull: (L, 7) of the lens on it.
        modes: (7, 7) information on it.
    """

    poses: bsr_matrix
    cross: FloatArray
    lens: FloatArray
    pose_pull: FloatArray
    lens_pull: FloatArray
    modes: FloatArray

    def __add__(self, other: EliminatedPoints) -> EliminatedPoints:
        return EliminatedPoints(
            self.poses + other.poses,
            self.cross + other.cross,
            self.lens + other.lens,
            self.pose_pull + other.pose_pull,
            self.lens_pull + other.lens_pull,
            self.modes + other.modes,
        )


def eliminate_points(
    network: Network, root_weight: FloatArray, surveyed: FloatArray | None = None, *, ridge: float = _RIDGE
) -> EliminatedPoints:
    """Return the normal equations of poses and lens of a network, chunk by chunk of its points.

    Args:
        network: N points and M observations, each in front of its camera; at least one.
        root_weight: (M,) inverse σ of the observations, 1/px.
        surveyed: (N, 3, 3) information on the points beyond their observations, 1/m²; None: there is none.
        ridge: added to the information on a point, relative to its trace, for a point that its rays leave open.
    """
    total: EliminatedPoints | None = None
    for part, points, rows in _chunks_of_points(network):
        sums = _eliminated(part, root_weight[rows], None if surveyed is None else surveyed[points], ridge)
        total = sums if total is None else total + sums
    assert total is not None
    return total


def _chunks_of_points(network: Network) -> Iterator[tuple[Network, slice, IntArray]]:
    """Yield networks with a part of the points each, with the rows of these points and of their observations."""
    order = np.argsort(network.obs_point, kind="stable")
    last = np.cumsum(np.bincount(network.obs_point, minlength=len(network.point_in_world)))
    first_point = first = 0
    while first_point < len(last):
        next_point = max(int(np.searchsorted(last, first + _CHUNK, side="right")), first_point + 1)
        rows = order[first : last[next_point - 1]]
        yield (
            replace(
                network,
                point_in_world=network.point_in_world[first_point:next_point],
                obs_point=network.obs_point[rows] - first_point,
                obs_image=network.obs_image[rows],
                obs_xy_px=network.obs_xy_px[rows],
            ),
            slice(first_point, next_point),
            rows,
        )
        first_point, first = next_point, int(last[next_point - 1])


def _eliminated(
    network: Network, root_weight: FloatArray, surveyed: FloatArray | None, ridge: float
) -> EliminatedPoints:
    """Eliminate the points of a chunk."""
    n, points = len(network.camera_id), len(network.point_in_world)
    linearised, scaled = linearise_bundle(network), root_weight[:, None, None]
    by_pose, by_point = linearised.jacobian_pose * scaled, linearised.jacobian_point * scaled
    intrinsics = sparse_jacobian(linearised.jacobian_intrinsics * scaled, lens_slots(network), len(network.cameras))
    normal = np.zeros((points, 3, 3))
    np.add.at(normal, network.obs_point, np.swapaxes(by_point, 1, 2) @ by_point)
    if surveyed is not None:
        normal += surveyed
    normal += ridge * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    root = np.linalg.cholesky(normal)
    inverse_root = np.swapaxes(np.linalg.inv(root), 1, 2)
    white = by_point @ inverse_root[network.obs_point]
    transposed = np.swapaxes(by_pose, 1, 2)
    pose_point = _blocks(transposed @ white, network.obs_image, network.obs_point, (n, points))
    own = _blocks(transposed @ by_pose, network.obs_image, network.obs_image, (n, n))
    pose = sparse_jacobian(by_pose, network.obs_image, n)
    intrinsics_point = intrinsics.T @ sparse_jacobian(white, network.obs_point, points)
    moved = (np.swapaxes(root, 1, 2) @ _point_similarity_modes(network)).reshape(3 * points, 7)
    return EliminatedPoints(
        own - pose_point @ pose_point.T,
        (pose.T @ intrinsics - pose_point.tocsr() @ intrinsics_point.T).toarray(),
        (intrinsics.T @ intrinsics - intrinsics_point @ intrinsics_point.T).toarray(),
        pose_point @ moved,
        intrinsics_point @ moved,
        moved.T @ moved,
    )


def _blocks(blocks: FloatArray, row: IntArray, column: IntArray, shape: tuple[int, int]) -> bsr_matrix:
    """Return the sparse matrix of blocks (M, h, w) at block rows and columns (M,); those at one place add up."""
    order = np.lexsort((column, row))
    pointer = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=shape[0]))])
    height, width = blocks.shape[1:]
    size = (shape[0] * height, shape[1] * width)
    matrix = bsr_matrix((blocks[order], column[order], pointer), shape=size)
    matrix.sum_duplicates()
    return matrix


def _lens_elimination(sums: EliminatedPoints) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how the lens follows the poses (L, 6 n), its information about that (L, L), and the covariance."""
    diagonal = np.diag(sums.lens)
    used = np.flatnonzero(diagonal > 0)  # shorter parameter lists leave empty columns
    scale = 1.0 / np.sqrt(diagonal[used])
    block = sums.lens[np.ix_(used, used)] * scale[:, None] * scale + 1e-9 * np.eye(len(used))
    follows = np.zeros((len(diagonal), len(sums.cross)))
    information, cov = np.zeros_like(sums.lens), np.zeros_like(sums.lens)
    follows[used] = -scale[:, None] * np.linalg.solve(block, (sums.cross[:, used] * scale).T)
    information[np.ix_(used, used)] = block / scale[:, None] / scale
    cov[np.ix_(used, used)] = scale[:, None] * np.linalg.solve(block, np.eye(len(used))) * scale
    return follows, information, cov


def _point_similarity_modes(network: Network) -> FloatArray:
    """Return the movements (N, 3, 7) of points under an infinitesimal similarity about the mean camera centre."""
    arm = network.point_in_world - network.cam_center_in_world.mean(axis=0)
    return np.concatenate([arm[:, :, None], -skew(arm), np.tile(np.eye(3), (len(arm), 1, 1))], axis=2)
