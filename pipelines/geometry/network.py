"""Network of photographs: image observations, their derivatives, and their normal equations without the points.

The points are eliminated from the normal matrix (Schur complement). Two cameras stay coupled only if they see a
common point, so that the memory grows with the number of cameras and not with its square.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix, hstack

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, parameter_derivative, project, project_each
from pipelines.geometry.rotations import skew
from pipelines.geometry.similarity import jacobian_at

_STEP = 1e-6
_CHUNK = 2**19  # observations that are linearised together
_RIDGE = 1e-14  # small: what it adds to each point fixes the similarity of the whole as well


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

    jacobian_pose: FloatArray  # (M, 2, 6), by (δω, δc) of the camera, as in `geometry.bundle.BundleInformation`
    jacobian_point: FloatArray  # (M, 2, 3)
    jacobian_intrinsics: FloatArray  # (M, 2, P), P the longest parameter list; zero beyond a shorter one


@dataclass(frozen=True)
class MoreColumns:
    """Further columns of the derivatives of M observations, in pixels."""

    of_photograph: FloatArray  # (M, 2, k), of unknowns that each photograph has beside its pose
    shared: FloatArray  # (M, 2), of all photographs, such as the residuals: its products are the gradient


@dataclass(frozen=True)
class EliminatedPoints:
    """Normal equations of n poses and L lens parameters, with the points eliminated."""

    poses: bsr_matrix  # (6 n, 6 n) sparse, in blocks (6, 6)
    cross: FloatArray  # (6 n, L)
    lens: FloatArray  # (L, L)
    pose_modes: FloatArray  # (6 n, 7) of the poses on the points' similarity
    lens_modes: FloatArray  # (L, 7) of the lens on it
    modes: FloatArray  # (7, 7) information on it

    def scaled(self, factor: float) -> EliminatedPoints:
        return EliminatedPoints(*(factor * value for value in vars(self).values()))


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


def points_of_network(network: Network, rows: IntArray) -> Network:
    """Return the network of some points (P,), which are different ones, each with its whole track."""
    row_of = np.full(len(network.point_in_world), -1)
    row_of[rows] = np.arange(len(rows))
    kept = np.flatnonzero(row_of[network.obs_point] >= 0)
    kept = kept[np.argsort(row_of[network.obs_point[kept]], kind="stable")]
    return replace(
        network,
        point_in_world=network.point_in_world[rows],
        obs_point=row_of[network.obs_point[kept]],
        obs_image=network.obs_image[kept],
        obs_xy_px=network.obs_xy_px[kept],
    )


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


def eliminate_points(
    network: Network,
    root_weight: FloatArray,
    surveyed: FloatArray | None = None,
    *,
    ridge: float = _RIDGE,
    more: MoreColumns | None = None,
) -> EliminatedPoints:
    """Return the normal equations of poses and lens of a network, chunk by chunk of its points.

    Each of M ≥ 1 observations lies in front of its camera, and has an inverse σ (M,) in 1/px. Points may have
    information (N, 3, 3) beyond their observations, in 1/m². The ridge, relative to the trace of the information on
    a point, is for a point that its rays leave open. With `more`, a photograph has 6 + k unknowns, and
    the last of L + 1 of the lens is the further column.
    """
    total: EliminatedPoints | None = None
    for part, points, rows in chunks_of_points(network, _CHUNK):
        columns = None if more is None else MoreColumns(more.of_photograph[rows], more.shared[rows])
        sums = _eliminated(part, root_weight[rows], None if surveyed is None else surveyed[points], ridge, columns)
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
    network: Network,
    root_weight: FloatArray,
    surveyed: FloatArray | None,
    ridge: float,
    more: MoreColumns | None,
) -> EliminatedPoints:
    n, points = len(network.camera_id), len(network.point_in_world)
    linearised, scaled = linearise_bundle(network), root_weight[:, None, None]
    by_pose, by_point = linearised.jacobian_pose * scaled, linearised.jacobian_point * scaled
    intrinsics = sparse_jacobian(linearised.jacobian_intrinsics * scaled, lens_slots(network), len(network.cameras))
    if more is not None:
        by_pose = np.concatenate([by_pose, more.of_photograph * scaled], axis=2)
        intrinsics = hstack([intrinsics, (more.shared * root_weight[:, None]).reshape(-1, 1)], format="csr")
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
    pose_pose = _blocks(transposed @ by_pose, network.obs_image, network.obs_image, (n, n))
    pose = sparse_jacobian(by_pose, network.obs_image, n)
    intrinsics_point = intrinsics.T @ sparse_jacobian(white, network.obs_point, points)
    by_similarity = jacobian_at(network.point_in_world, network.cam_center_in_world.mean(axis=0))
    moved = (np.swapaxes(root, 1, 2) @ by_similarity).reshape(3 * points, 7)
    return EliminatedPoints(
        pose_pose - pose_point @ pose_point.T,
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
