"""A bundle with known truth: its pixels, their derivatives, and the effect of their noise after adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.bundle import BundleInformation, bundle_information
from pipelines.geometry.cameras import Camera, project
from pipelines.geometry.network import Network, eliminate_points
from pipelines.geometry.rotations import exp_so3
from tests.scenes import looking_at

LENS = Camera("SIMPLE_RADIAL", 600, 450, np.array([500.0, 300.0, 225.0, -0.05]))
SIGMA_PX = 0.5


def stated_information(network: Network, sigma_px: np.ndarray) -> BundleInformation:
    """Return the information of observations with stated σ (M,), all of them in front of their cameras."""
    return replace(bundle_information(network), sums=eliminate_points(network, 1.0 / sigma_px), sigma_px=1.0)


def adjuster(network: Network) -> np.ndarray:
    """Return the matrix (U, 2 M) of a free least-squares adjustment: unknowns by a change of the pixels."""
    design = jacobian(network)
    scale = 1.0 / np.linalg.norm(design, axis=0)
    value, vector = np.linalg.eigh((design * scale).T @ (design * scale))
    seen = vector[:, 7:] / np.sqrt(value[7:])  # all but the gauge
    return scale[:, None] * (seen @ seen.T) @ (design * scale).T


def exact_network(images: int = 6, points: int = 60, seed: int = 0, *, rolled: bool = True) -> Network:
    """Return two rings of cameras about points that all of them see, with exact pixels.

    Every other camera stands on its side, because only then is the principal point well determined. With `rolled`
    false, all cameras are level.
    """
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, images, endpoint=False)
    height = np.where(np.arange(images) % 2, 18.0, 36.0)
    center = np.column_stack([30 * np.cos(angle), 30 * np.sin(angle), height])
    rotation = np.swapaxes(looking_at(center, rng.normal(0, 1, center.shape)), 1, 2)
    rotation = exp_so3(rolled * np.arange(images)[:, None] * [0.0, 0.0, np.pi / 2]) @ rotation
    cloud = rng.uniform([-9, -9, -6], [9, 9, 9], (points, 3))
    network = Network(
        cameras={1: LENS},
        camera_id=np.ones(images, dtype=np.int64),
        cam_from_world=rotation,
        cam_center_in_world=center,
        point_in_world=cloud,
        obs_point=np.repeat(np.arange(points), images),
        obs_image=np.tile(np.arange(images), points),
        obs_xy_px=np.zeros((points * images, 2)),
    )
    return replace(network, obs_xy_px=pixels(network, np.zeros(size(network))))


def size(network: Network) -> int:
    """Return the number of unknowns: six for a camera, three for a point, and the lens."""
    lens = len(network.cameras[1].params)
    return 6 * len(network.camera_id) + 3 * len(network.point_in_world) + lens


def pixels(network: Network, change: np.ndarray) -> np.ndarray:
    """Return pixels (M, 2) after a change of all unknowns: poses as documented, then points, then the lens."""
    n, points = len(network.camera_id), len(network.point_in_world)
    pose = change[: 6 * n].reshape(n, 6)
    cloud = network.point_in_world + change[6 * n : 6 * n + 3 * points].reshape(-1, 3)
    lens = replace(network.cameras[1], params=network.cameras[1].params + change[6 * n + 3 * points :])
    rotation = network.cam_from_world @ exp_so3(-pose[:, :3])
    center = network.cam_center_in_world + pose[:, 3:]
    ray = cloud[network.obs_point] - center[network.obs_image]
    return project(lens, np.einsum("mij,mj->mi", rotation[network.obs_image], ray))


def jacobian(network: Network) -> np.ndarray:
    """Return ∂pixels/∂unknowns (2 M, U) by central differences, one unknown at a time."""
    steps = np.full(size(network), 1e-5)
    steps[-len(network.cameras[1].params) :] = 1e-5 * np.maximum(1.0, np.abs(network.cameras[1].params))
    columns = []
    for index, step in enumerate(steps):
        change = np.zeros(len(steps))
        change[index] = step
        columns.append((pixels(network, change) - pixels(network, -change)).ravel() / (2 * step))
    return np.array(columns).T


def units(network: Network) -> np.ndarray:
    """Return units (6 n,) in which rotations count as metres at the scene: 1 / median distance, and 1."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    return np.tile([1 / np.median(np.linalg.norm(ray, axis=1))] * 3 + [1.0] * 3, len(network.camera_id))


def noisy(network: Network, rng: np.random.Generator) -> Network:
    """Return the network with pixel noise of `SIGMA_PX`."""
    return replace(network, obs_xy_px=network.obs_xy_px + rng.normal(0, SIGMA_PX, network.obs_xy_px.shape))


def readjusted(network: Network, change: np.ndarray) -> Network:
    """Return the network after adjustment: unknowns changed, pixels as observed."""
    n, points = len(network.camera_id), len(network.point_in_world)
    pose = change[: 6 * n].reshape(n, 6)
    lens = network.cameras[1]
    return replace(
        network,
        cameras={1: replace(lens, params=lens.params + change[6 * n + 3 * points :])},
        cam_from_world=network.cam_from_world @ exp_so3(-pose[:, :3]),
        cam_center_in_world=network.cam_center_in_world + pose[:, 3:],
        point_in_world=network.point_in_world + change[6 * n : 6 * n + 3 * points].reshape(-1, 3),
    )
