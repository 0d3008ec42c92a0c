"""Information that bundle adjustment leaves in the camera poses, as whitened corrections of them.

The reduced normal matrix of the bundle (points and intrinsics eliminated) states how strongly the observations
resist each correction of the cameras. Its inverse square root gives coordinates with two properties:

1. A correction that costs the observations χ² = 1 has length one.
2. The seven movements that no observation resists, those of a similarity of the whole, do not exist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csr_matrix
from scipy.special import exp1

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, project, project_each
from pipelines.geometry.lens import parameter_derivative
from pipelines.geometry.rotations import skew
from pipelines.robust.kernels import CAUCHY_SCALE2, cauchy_weight
from pipelines.robust.statistics import rayleigh_sigma

# A camera with few observations is held to a tenth of its distance from the scene.
_LOOSEST_RELATIVE_SIGMA = 0.1
_STEP = 1e-6
# Means of the weight w and of w r²/2 under Gaussian noise of σ = 1, where r²/2 is exponentially distributed. Robust
# weights lower the sum of squares of pure noise: without these means the stated σ would be a fifth too small.
_HALF_SCALE2 = CAUCHY_SCALE2[2] / 2
_MEAN_WEIGHT = float(_HALF_SCALE2 * np.exp(_HALF_SCALE2) * exp1(_HALF_SCALE2))
_MEAN_WEIGHTED_SQUARE = _HALF_SCALE2 * (1 - _MEAN_WEIGHT)


@dataclass(frozen=True)
class Network:
    """Bundle of n cameras, N points and M observations in a metric frame `world`.

    Attributes:
        cameras: intrinsics by camera id.
        camera_id: (n,) keys of `cameras`.
        cam_from_world: (n, 3, 3) rotations.
        cam_center_in_world: (n, 3) metres.
        point_in_world: (N, 3) metres.
        obs_point, obs_image: (M,) indices.
        obs_xy_px: (M, 2) pixels.
    """

    cameras: dict[int, Camera]
    camera_id: IntArray
    cam_from_world: FloatArray
    cam_center_in_world: FloatArray
    point_in_world: FloatArray
    obs_point: IntArray
    obs_image: IntArray
    obs_xy_px: FloatArray


@dataclass(frozen=True)
class CorrectionBasis:
    """Whitened corrections: (δω, δc) of all cameras = matrix @ z, with z ~ N(0, I) a posteriori.

    `δω` [rad] turns a camera about its centre, axes of the world: `R' = R Exp(−δω)`; `δc` [m] moves the centre.

    The lens parameters correlate with the poses. Their error, (L,) in the order of `geometry.lens.Lenses`, is
    lens_matrix @ z plus an error with covariance `lens_cov` that is independent of z.

    Attributes:
        matrix: (n, 6, k), rows (δω, δc), k = 6 n − 7.
        sigma_px: σ of an image coordinate, estimated from the residuals.
        lens_matrix: (L, k).
        lens_cov: (L, L).
    """

    matrix: FloatArray
    sigma_px: float
    lens_matrix: FloatArray
    lens_cov: FloatArray


@dataclass(frozen=True)
class LinearisedBundle:
    """Residuals of M observations in pixels (projected minus observed), and their Jacobians.

    Attributes:
        residual: (M, 2).
        jacobian_pose: (M, 2, 6), by (δω, δc) of the camera, as in `CorrectionBasis`.
        jacobian_point: (M, 2, 3).
        jacobian_intrinsics: (M, 2, P), P the longest parameter list; zero beyond a shorter one.
    """

    residual: FloatArray
    jacobian_pose: FloatArray
    jacobian_point: FloatArray
    jacobian_intrinsics: FloatArray


def correction_basis(network: Network, *, lens_follows: bool = True) -> CorrectionBasis:
    """Return whitened, gauge-free coordinates of the camera corrections.

    1. Cauchy's kernel weights the observations.
    2. The lens is uncertain: its parameters are eliminated from the information, like the points.
    3. The points hold the gauge. Under each correction the points follow the cameras and their lens; the mean
       similarity of this movement, weighted by the information of each point, is zero.

    The uncertainty of the similarity is therefore that of the scene, not that of the cameras' mean. A wrong focal
    length or principal point shows as a common shift of the cameras against a scene that stays. That shift costs
    the images little, and fixes reveal it. Cost O((6 n)³).

    Args:
        network: the bundle at its minimum.
        lens_follows: whether the caller moves the lens by `lens_matrix` with the cameras. Otherwise the lens is
            held, and the points follow through it as it is.

    Raises:
        DegenerateGeometryError: fewer observations than unknowns.
    """
    network = with_positive_depths(network)
    linearised = linearise_bundle(network)
    n, points = len(network.camera_id), len(network.point_in_world)
    redundancy = 2 * len(linearised.residual) - 6 * n - 3 * points
    if redundancy <= 0:
        raise DegenerateGeometryError(
            f"{len(linearised.residual)} observations do not determine {n} cameras and {points} points"
        )
    weight = _robust_weights(linearised.residual)
    variance = (weight[:, None] * linearised.residual**2).sum() / (_MEAN_WEIGHTED_SQUARE * redundancy)
    reduced = _schur_complement(network, linearised, np.sqrt(weight / (_MEAN_WEIGHT * variance)), lens_follows)
    basis = _whitened_basis(network, reduced.information)
    flat = basis.reshape(-1, basis.shape[2])
    modes = similarity_modes(network.cam_center_in_world).reshape(-1, 7)
    held = flat - modes @ (reduced.points_follow @ flat)
    return CorrectionBasis(
        held.reshape(basis.shape), float(np.sqrt(variance)), reduced.lens_follows @ flat, reduced.lens_cov
    )


def with_positive_depths(network: Network) -> Network:
    """Return the network without observations of points behind their camera, which an imported model may hold."""
    positive = has_positive_depth(network)
    if positive.all():
        return network
    return replace(
        network,
        obs_point=network.obs_point[positive],
        obs_image=network.obs_image[positive],
        obs_xy_px=network.obs_xy_px[positive],
    )


def has_positive_depth(network: Network) -> BoolArray:
    """Return the mask (M,) of the observations whose points lie in front of their camera."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    return np.asarray(np.einsum("mj,mj->m", network.cam_from_world[network.obs_image, 2], ray) > 0)


def linearise_bundle(network: Network) -> LinearisedBundle:
    """Return the observations as linear functions of the unknowns; all points lie in front of their cameras."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    rotation = network.cam_from_world[network.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, ray)
    count = len(ray)
    longest = max(len(camera.params) for camera in network.cameras.values())
    camera_of = network.camera_id[network.obs_image]
    residual = project_each(network.cameras, camera_of, in_cam) - network.obs_xy_px
    jacobian_cam, jacobian_intrinsics = np.zeros((count, 2, 3)), np.zeros((count, 2, longest))
    for key, camera in network.cameras.items():
        rows = np.flatnonzero(camera_of == key)
        local = in_cam[rows]
        jacobian_cam[rows] = _central_differences(partial(project, camera), local)
        for index in range(len(camera.params)):
            jacobian_intrinsics[rows, :, index] = parameter_derivative(
                partial(project, point_in_cam=local), camera, index, _STEP
            )
    jacobian_point = jacobian_cam @ rotation
    jacobian_pose = np.concatenate([jacobian_point @ skew(ray), -jacobian_point], axis=2)
    return LinearisedBundle(residual, jacobian_pose, jacobian_point, jacobian_intrinsics)


def _central_differences(function: Callable[[FloatArray], FloatArray], points: FloatArray) -> FloatArray:
    """Return central differences (M, 2, 3) of a function of points (M, 3), with steps relative to their depths."""
    step = _STEP * points[:, 2:3]
    columns = []
    for axis in range(3):
        shift = np.zeros((1, 3))
        shift[0, axis] = 1.0
        columns.append((function(points + step * shift) - function(points - step * shift)) / (2 * step))
    return np.stack(columns, axis=2)


def _robust_weights(residual: FloatArray) -> FloatArray:
    length = np.linalg.norm(residual, axis=1)
    scale = max(rayleigh_sigma(length), 1e-9)
    return cauchy_weight((length / scale) ** 2, 2)


@dataclass(frozen=True)
class _ReducedSystem:
    information: FloatArray  # (6 n, 6 n) of the poses, points and intrinsics eliminated
    points_follow: FloatArray  # (7, 6 n) mean similarity of the points, by the poses (the lens following)
    lens_follows: FloatArray  # (L, 6 n) expected lens parameters, by the poses
    lens_cov: FloatArray  # (L, L) about that expectation


def _schur_complement(
    network: Network, linearised: LinearisedBundle, root_weight: FloatArray, lens_follows: bool
) -> _ReducedSystem:
    """Eliminate points and intrinsics (Schur complement); return how points and lens follow the poses, too."""
    n, points = len(network.camera_id), len(network.point_in_world)
    scaled = root_weight[:, None, None]
    slot = lens_slots(network)
    pose = sparse_jacobian(linearised.jacobian_pose * scaled, network.obs_image, n)
    intrinsics = sparse_jacobian(linearised.jacobian_intrinsics * scaled, slot, len(network.cameras))
    jacobian_point = linearised.jacobian_point * scaled
    normal = np.zeros((points, 3, 3))
    np.add.at(normal, network.obs_point, np.swapaxes(jacobian_point, 1, 2) @ jacobian_point)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    root = np.linalg.cholesky(normal)
    inverse_root = np.swapaxes(np.linalg.inv(root), 1, 2)
    point = sparse_jacobian(jacobian_point @ inverse_root[network.obs_point], network.obs_point, points)
    pose_point, intrinsics_point = pose.T @ point, intrinsics.T @ point
    cc = (pose.T @ pose - pose_point @ pose_point.T).toarray()
    ci = (pose.T @ intrinsics - pose_point @ intrinsics_point.T).toarray()
    ii = (intrinsics.T @ intrinsics - intrinsics_point @ intrinsics_point.T).toarray()
    used = np.flatnonzero(np.diag(ii) > 0)  # shorter parameter lists leave empty columns
    scale = 1.0 / np.sqrt(np.diag(ii)[used])
    block = ii[np.ix_(used, used)] * scale[:, None] * scale + 1e-9 * np.eye(len(used))
    cross = ci[:, used] * scale
    follows, cov = np.zeros((len(ii), 6 * n)), np.zeros_like(ii)
    follows[used] = -scale[:, None] * np.linalg.solve(block, cross.T)
    cov[np.ix_(used, used)] = scale[:, None] * np.linalg.solve(block, np.eye(len(used))) * scale
    cc += ci @ follows
    moved = (np.swapaxes(root, 1, 2) @ _point_similarity_modes(network)).reshape(3 * points, 7)
    pull = pose_point @ moved
    if lens_follows:
        pull = pull + follows.T @ (intrinsics_point @ moved)
    points_follow = -np.linalg.solve(moved.T @ moved, pull.T)
    return _ReducedSystem((cc + cc.T) / 2, points_follow, follows, cov)


def lens_slots(network: Network) -> IntArray:
    """Return the place (M,) of each observation's camera among `network.cameras`."""
    keys = list(network.cameras)
    return np.array([keys.index(int(key)) for key in network.camera_id], dtype=np.int64)[network.obs_image]


def _point_similarity_modes(network: Network) -> FloatArray:
    """Return the movements (N, 3, 7) of points under an infinitesimal similarity about the mean camera centre."""
    arm = network.point_in_world - network.cam_center_in_world.mean(axis=0)
    return np.concatenate([arm[:, :, None], -skew(arm), np.tile(np.eye(3), (len(arm), 1, 1))], axis=2)


def sparse_jacobian(blocks: FloatArray, column_block: IntArray, count: int) -> csr_matrix:
    """Return the sparse matrix (2 M, w · count) with one block (2, w) for each observation.

    Args:
        blocks: (M, 2, w).
        column_block: (M,) block column of each.
        count: number of block columns.
    """
    rows, height, width = blocks.shape
    columns = column_block[:, None, None] * width + np.arange(width)[None, None, :]
    columns = np.broadcast_to(columns, blocks.shape)
    pointer = np.arange(0, rows * height * width + 1, width)
    return csr_matrix((blocks.ravel(), columns.ravel(), pointer), shape=(rows * height, width * count))


def _whitened_basis(network: Network, information: FloatArray) -> FloatArray:
    center = network.cam_center_in_world
    n = len(center)
    distance = np.linalg.norm(network.point_in_world[network.obs_point] - center[network.obs_image], axis=1)
    typical = float(np.median(distance))
    unit = np.tile([1 / typical] * 3 + [1.0] * 3, n)  # rotations in metres at the scene, so that units agree
    scaled = information * unit[:, None] * unit
    gauge = similarity_modes(center).reshape(6 * n, 7) / unit[:, None]
    complement = np.linalg.qr(gauge, mode="complete")[0][:, 7:]
    reduced = complement.T @ scaled @ complement
    reduced += np.eye(len(reduced)) / (_LOOSEST_RELATIVE_SIGMA * typical) ** 2
    root = np.linalg.cholesky(reduced)
    basis = solve_triangular(root, complement.T, lower=True).T
    return np.asarray((basis * unit[:, None]).reshape(n, 6, -1))


def similarity_modes(cam_center_in_world: FloatArray) -> FloatArray:
    """Return the movements (n, 6, 7) of the cameras under an infinitesimal similarity about their mean centre.

    Rows (δω, δc) as in `CorrectionBasis`, columns (ln s, rotation, translation).
    """
    arm = cam_center_in_world - cam_center_in_world.mean(axis=0)
    modes = np.zeros((len(arm), 6, 7))
    modes[:, :3, 1:4] = np.eye(3)
    modes[:, 3:, 0] = arm
    modes[:, 3:, 1:4] = -skew(arm)
    modes[:, 3:, 4:] = np.eye(3)
    return modes
