"""Exact depth maps of level ground with a box on it, by intersection of rays with planes."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.cameras import Pinhole
from pipelines.surface.visibility import DepthViews

CAMERA = Pinhole(96, 72, 60.0, 60.0, 48.0, 36.0)
UP = np.array([0.0, 0.0, 1.0])
BOX_M = 4.0  # half width and height of the box around the origin
DOWN = np.diag([1.0, -1.0, -1.0])  # camera that looks straight down, its image's top to the north


def looking_down(count: int) -> list[np.ndarray]:
    """Return the centres of cameras that look straight down, on a grid 36 m above the ground."""
    rng = np.random.default_rng(9)
    return [np.array([*rng.uniform(-8, 8, 2), 36.0]) for _ in range(count)]


def depth_map(center: np.ndarray, camera: Pinhole = CAMERA, *, box: bool = True) -> np.ndarray:
    """Return the exact depths (H, W) of ground and box from a camera that looks straight down."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = camera.rays(np.stack([u, v], axis=-1)) @ DOWN
    depth = np.where(ray[..., 2] < 0, -center[2] / ray[..., 2], np.inf)
    if box:
        # Slab test: where a ray is inside all three pairs of planes.
        with np.errstate(divide="ignore"):
            low, high = (
                (np.array([-BOX_M, -BOX_M, 0.0]) - center) / ray,
                (np.array([BOX_M, BOX_M, BOX_M]) - center) / ray,
            )
        enters, leaves = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
        depth = np.where(enters < leaves, np.minimum(enters, depth), depth)
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def depth_views(centers: list[np.ndarray], camera: Pinhole = CAMERA, *, box: bool = True) -> DepthViews:
    """Return the exact depth maps from cameras that look straight down."""
    count = len(centers)
    maps = [depth_map(center, camera, box=box) for center in centers]
    return DepthViews(
        np.tile(DOWN, (count, 1, 1)),
        np.array(centers),
        np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (count, 1)),
        np.tile([camera.width, camera.height], (count, 1)),
        np.arange(count) * camera.width * camera.height,
        np.concatenate([depth.ravel() for depth in maps]),
    )
