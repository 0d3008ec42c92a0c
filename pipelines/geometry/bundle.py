"""Bundle of photographs: observations, their derivatives, and the information that they leave in the camera poses.

The points are eliminated from the normal matrix of the bundle (Schur complement). Two cameras stay coupled only if
they see a common point, so that the memory grows with the number of cameras and not with its square. Two dense
parts of low rank complete the sparse one: the lens, which all its cameras share, and the seven movements of a
similarity, which no observation resists.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.special import exp1

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, parameter_derivative, project, project_each
from pipelines.geometry.rotations import skew
from pipelines.geometry.similarity import Similarity, jacobian_at
from pipelines.robust.statistics import CAUCHY_SCALE2, cauchy_weight, rayleigh_sigma

_STEP = 1e-6


@dataclass(frozen=True)
class Network:
    """Bundle of n cameras, N points and M observations in a metric frame `world`."""

    cameras: dict[int, Camera]  # intrinsics by camera id
    camera_id: IntArray  # (n,) keys of `cameras`
    cam_from_world: FloatArray  # (n, 3, 3) rotations
    cam_center_in_world: FloatArray  # (n, 3) metres
    point_in_world: FloatArray  # (N, 3) metres
    obs_point: IntArray  # (M,) indices
    obs_image: IntArray  # (M,) indices
    obs_xy_px: FloatArray  # (M, 2) pixels

    def rays(self) -> FloatArray:
        """Return the vectors (M, 3) from the camera's centre to the point of each observation."""
        ray = self.point_in_world[self.obs_point]
        ray -= self.cam_center_in_world[self.obs_image]
        return ray


@dataclass(frozen=True)
class LinearisedBundle:
    """Jacobians of M observations in pixels."""

    jacobian_pose: FloatArray  # (M, 2, 6), by (δω, δc) of the camera, as in `CorrectionBasis`
    jacobian_point: FloatArray  # (M, 2, 3)
    jacobian_intrinsics: FloatArray  # (M, 2, P), P the longest parameter list; zero beyond a shorter one


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
    return np.asarray(np.einsum("mj,mj->m", network.cam_from_world[network.obs_image, 2], network.rays()) > 0)


def projection_residuals(network: Network) -> FloatArray:
    """Return the residuals (M, 2) in pixels, projected minus observed; NaN for a point behind its camera."""
    in_cam = np.einsum("mij,mj->mi", network.cam_from_world[network.obs_image], network.rays())
    projected = project_each(network.cameras, network.camera_id[network.obs_image], in_cam)
    return np.asarray(projected - network.obs_xy_px)


def linearise_bundle(network: Network) -> LinearisedBundle:
    """Return the derivatives of the observations; all points lie in front of their cameras."""
    ray, rotation = network.rays(), network.cam_from_world[network.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, ray)
    count = len(ray)
    longest = max(len(camera.params) for camera in network.cameras.values())
    camera_of = network.camera_id[network.obs_image]
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
    return LinearisedBundle(jacobian_pose, jacobian_point, jacobian_intrinsics)


def _central_differences(function: Callable[[FloatArray], FloatArray], points: FloatArray) -> FloatArray:
    """Return central differences (M, 2, 3) of a function of points (M, 3), with steps relative to their depths."""
    step = _STEP * points[:, 2:3]
    columns = []
    for axis in range(3):
        shift = np.zeros((1, 3))
        shift[0, axis] = 1.0
        columns.append((function(points + step * shift) - function(points - step * shift)) / (2 * step))
    return np.stack(columns, axis=2)


def lens_slots(network: Network) -> IntArray:
    """Return the place (M,) of each observation's camera among `network.cameras`."""
    keys = list(network.cameras)
    return np.array([keys.index(int(key)) for key in network.camera_id], dtype=np.int64)[network.obs_image]


def sparse_jacobian(blocks: FloatArray, column_block: IntArray, count: int) -> csr_matrix:
    """Return the sparse matrix (2 M, w · count) with blocks (M, 2, w) in block columns (M,)."""
    rows, height, width = blocks.shape
    columns = column_block[:, None, None] * width + np.arange(width)[None, None, :]
    columns = np.broadcast_to(columns, blocks.shape)
    pointer = np.arange(0, rows * height * width + 1, width)
    return csr_matrix((blocks.ravel(), columns.ravel(), pointer), shape=(rows * height, width * count))


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


_CHUNK = 2**19  # observations that are linearised together
_RIDGE = 1e-14  # small: what it adds to each point fixes the similarity of the whole as well
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


@dataclass(frozen=True)
class EliminatedPoints:
    """Normal equations of n poses and L lens parameters, with the points eliminated."""

    poses: bsr_matrix  # (6 n, 6 n) sparse, in blocks (6, 6)
    cross: FloatArray  # (6 n, L)
    lens: FloatArray  # (L, L)
    pose_modes: FloatArray  # (6 n, 7) of the poses on the points' similarity
    lens_modes: FloatArray  # (L, 7) of the lens on it
    modes: FloatArray  # (7, 7) information on it


# No feature of a photograph is located better; σ of a model without residuals, as a renderer computes it.
LEAST_SIGMA_PX = 0.01


@dataclass(frozen=True)
class BundleInformation:
    """Information of the image observations on corrections x = (δω, δc) (6 n,) of cameras and ℓ (L,) of the lens.

    The points are eliminated: the observations, which SfM has left at their minimum, cost
    ½ (x, ℓ)ᵀ [poses, cross; crossᵀ, lens] (x, ℓ).
    Axes and signs of (δω, δc) are those of `CorrectionBasis`, the order of ℓ that of
    `geometry.cameras.Lenses`. The points follow cameras and lens; `followed` is their mean similarity, weighted by
    their information.
    """

    sums: EliminatedPoints  # the information
    similarity_modes: FloatArray  # (6 n, 7) as `similarity_modes`
    unit: FloatArray  # (6 n,) corrections that count as one metre at the scene
    loosest_sigma_m: float  # σ in these units that the prior gives even a camera without observations
    sigma_px: float  # σ of an image coordinate, estimated from the residuals

    @cached_property
    def followed(self) -> FloatArray:
        """Mean similarity (7, 6 n + L) of the points that follow cameras and lens."""
        cross = np.concatenate([self.sums.pose_modes, self.sums.lens_modes])
        return np.asarray(-np.linalg.solve(self.sums.modes, cross.T))

    @cached_property
    def lens_elimination(self) -> tuple[FloatArray, FloatArray]:
        """How the lens follows the poses (L, 6 n), and its information about that (L, L).

        Parameters that no observation reveals have rows of zeros.
        """
        diagonal = np.diag(self.sums.lens)
        used = np.flatnonzero(diagonal > 0)  # shorter parameter lists leave empty columns
        scale = 1.0 / np.sqrt(diagonal[used])
        block = self.sums.lens[np.ix_(used, used)] * scale[:, None] * scale + 1e-9 * np.eye(len(used))
        follows = np.zeros((len(diagonal), len(self.sums.cross)))
        information = np.zeros_like(self.sums.lens)
        follows[used] = -scale[:, None] * np.linalg.solve(block, (self.sums.cross[:, used] * scale).T)
        information[np.ix_(used, used)] = block / scale[:, None] / scale
        return follows, information

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
        )


def bundle_information(network: Network) -> BundleInformation:
    """Return the information of a bundle on its cameras.

    1. Cauchy's kernel weights the observations, whose σ is estimated from the residuals.
    2. Chunks of points are eliminated one after the other, so that memory holds the derivatives of one chunk.

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
    shared = variance * (shared_error_factor(network, weight[:, None] * residual) if has_noise else 1.0)
    return BundleInformation(
        sums=eliminate_points(network, np.sqrt(weight / (_MEAN_WEIGHT * shared))),
        similarity_modes=similarity_modes(network.cam_center_in_world).reshape(-1, 7),
        unit=np.tile([1 / typical_m] * 3 + [1.0] * 3, n),  # rotations in metres at the scene, so that units agree
        loosest_sigma_m=_LOOSEST_RELATIVE_SIGMA * typical_m,
        sigma_px=float(np.sqrt(variance)),
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
    place = dict(zip(network.cameras, range(len(size)), strict=True))
    of_image = size[[place[key] for key in network.camera_id.tolist()]]
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


def eliminate_points(
    network: Network,
    root_weight: FloatArray,
    surveyed: FloatArray | None = None,
    *,
    ridge: float = _RIDGE,
) -> EliminatedPoints:
    """Return the normal equations of poses and lens of a network, chunk by chunk of its points.

    Each of M ≥ 1 observations lies in front of its camera, and has an inverse σ (M,) in 1/px. Points may have
    information (N, 3, 3) beyond their observations, in 1/m². The ridge, relative to the trace of the information on
    a point, is for a point that its rays leave open.
    """
    total: EliminatedPoints | None = None
    for part, points, rows in chunks_of_points(network, _CHUNK):
        sums = _eliminated(part, root_weight[rows], None if surveyed is None else surveyed[points], ridge)
        if total is not None:
            sums = EliminatedPoints(*map(operator.add, vars(total).values(), vars(sums).values()))
        total = sums
    assert total is not None
    return total


def chunks_of_points(network: Network, size: int) -> Iterator[tuple[Network, slice, IntArray]]:
    """Yield networks of about `size` observations, with the rows of their points and of their observations."""
    order = np.argsort(network.obs_point, kind="stable")
    last = np.cumsum(np.bincount(network.obs_point, minlength=len(network.point_in_world)))
    first_point = first = 0
    while first_point < len(last):
        next_point = max(int(np.searchsorted(last, first + size, side="right")), first_point + 1)
        points, rows = slice(first_point, next_point), order[first : last[next_point - 1]]
        part = replace(
            network,
            point_in_world=network.point_in_world[points],
            obs_point=network.obs_point[rows] - first_point,
            obs_image=network.obs_image[rows],
            obs_xy_px=network.obs_xy_px[rows],
        )
        yield part, points, rows
        first_point, first = next_point, int(last[next_point - 1])


def _eliminated(
    network: Network, root_weight: FloatArray, surveyed: FloatArray | None, ridge: float
) -> EliminatedPoints:
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
    by_similarity = jacobian_at(network.point_in_world, network.cam_center_in_world.mean(axis=0))
    moved = (np.swapaxes(root, 1, 2) @ by_similarity).reshape(3 * points, 7)
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


_COPIES = 4  # information, its factor, the basis, and a Jacobian or a normal matrix of the same size


def predicted_basis_bytes(cameras: int) -> int:
    """Return the peak of memory of a dense basis and of the normal equations in it."""
    return _COPIES * 8 * (6 * cameras) ** 2


@dataclass(frozen=True)
class CorrectionBasis:
    """Whitened corrections: (δω, δc) of all cameras = matrix @ z, with z ~ N(0, I) a posteriori.

    A correction that costs the observations χ² = 1 has length one, and a similarity of the whole does not exist.

    `δω` [rad] turns a camera about its centre, axes of the world: `R' = R Exp(−δω)`; `δc` [m] moves the centre.

    The lens parameters correlate with the poses. Their error, (L,) in the order of `geometry.cameras.Lenses`, is
    lens_matrix @ z plus an error that is independent of z.
    """

    matrix: FloatArray  # (n, 6, k), rows (δω, δc), k = 6 n − 7
    lens_matrix: FloatArray  # (L, k)


def correction_basis(bundle: BundleInformation, *, lens_follows: bool = True) -> CorrectionBasis:
    """Return whitened, gauge-free coordinates of the camera corrections of a bundle at its minimum.

    The points define the gauge. Under each correction the points follow the cameras and their lens; the mean
    similarity of this movement, weighted by the information of each point, is zero.

    The uncertainty of the similarity is therefore that of the scene, not that of the cameras' mean. A wrong focal
    length or principal point shows as a common shift of the cameras against a scene that stays. That shift costs
    the images little, and fixes reveal it. Cost O((6 n)³).

    Unless the caller moves the lens by `lens_matrix` with the cameras (`lens_follows`), the lens is frozen, and the
    points follow the cameras alone.
    """
    follows, _ = bundle.lens_elimination
    root, complement = _root(bundle)
    flat = solve_triangular(root, complement.T, lower=True).T * bundle.unit[:, None]
    poses = len(bundle.unit)
    through_lens = bundle.followed[:, poses:] @ follows if lens_follows else 0.0
    held = flat - bundle.similarity_modes @ ((bundle.followed[:, :poses] + through_lens) @ flat)
    return CorrectionBasis(held.reshape(-1, 6, flat.shape[1]), follows @ flat)


def coordinates_of(bundle: BundleInformation, correction: FloatArray) -> FloatArray:
    """Return the coordinates z (k,) of corrections (n, 6) in the basis; their common similarity is dropped."""
    root, complement = _root(bundle)
    return np.asarray(root.T @ (complement.T @ (correction.ravel() / bundle.unit)))


def _root(bundle: BundleInformation) -> tuple[FloatArray, FloatArray]:
    """Return the Cholesky root (k, k) of the information orthogonal to the similarities, and its axes (6 n, k)."""
    follows, lens = bundle.lens_elimination
    information = bundle.sums.poses.toarray() - follows.T @ lens @ follows
    scaled = (information + information.T) / 2 * bundle.unit[:, None] * bundle.unit
    complement = np.linalg.qr(bundle.similarity_modes / bundle.unit[:, None], mode="complete")[0][:, 7:]
    reduced = complement.T @ scaled @ complement
    reduced += np.eye(len(reduced)) / bundle.loosest_sigma_m**2
    return np.asarray(np.linalg.cholesky(reduced)), complement
