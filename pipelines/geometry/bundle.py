"""Bundle of photographs: cameras, points, image observations, and the derivatives of the observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csr_matrix

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, project, project_each
from pipelines.geometry.lens import parameter_derivative
from pipelines.geometry.rotations import skew

_STEP = 1e-6


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
class LinearisedBundle:
    """Jacobians of M observations in pixels.

    Attributes:
        jacobian_pose: (M, 2, 6), by (δω, δc) of the camera, as in `geometry.correction_basis.CorrectionBasis`.
        jacobian_point: (M, 2, 3).
        jacobian_intrinsics: (M, 2, P), P the longest parameter list; zero beyond a shorter one.
    """

    jacobian_pose: FloatArray
    jacobian_point: FloatArray
    jacobian_intrinsics: FloatArray


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


def projection_residuals(network: Network) -> FloatArray:
    """Return the residuals (M, 2) in pixels, projected minus observed; all points lie in front of their cameras."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    in_cam = np.einsum("mij,mj->mi", network.cam_from_world[network.obs_image], ray)
    projected = project_each(network.cameras, network.camera_id[network.obs_image], in_cam)
    return np.asarray(projected - network.obs_xy_px)


def linearise_bundle(network: Network) -> LinearisedBundle:
    """Return the derivatives of the observations; all points lie in front of their cameras."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    rotation = network.cam_from_world[network.obs_image]
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


def similarity_modes(cam_center_in_world: FloatArray) -> FloatArray:
    """Return the movements (n, 6, 7) of the cameras under an infinitesimal similarity about their mean centre.

    Rows (δω, δc) as in
    `geometry.correction_basis.CorrectionBasis`, columns (ln s, rotation, translation).
    """
    arm = cam_center_in_world - cam_center_in_world.mean(axis=0)
    modes = np.zeros((len(arm), 6, 7))
    modes[:, :3, 1:4] = np.eye(3)
    modes[:, 3:, 0] = arm
    modes[:, 3:, 1:4] = -skew(arm)
    modes[:, 3:, 4:] = np.eye(3)
    return modes
