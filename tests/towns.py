"""A town of boxes, its exact depth maps and LiDAR clouds of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from pipelines.geometry.rotations import geo_from_cam
from pipelines.surface.lidar_cloud import LidarCloud, planes_of
from pipelines.surface.visibility import DepthViews

SIZE, FOCAL_PX = (96, 72), 80.0
SIGMA_M, SPACING_M = 0.02, 0.5
PIXEL_M = 60.0 / FOCAL_PX
# Boxes: low and high corner.
HOUSES = (
    (np.array([-14.0, -10.0, 0.0]), np.array([-2.0, 2.0, 8.0])),
    (np.array([6.0, 4.0, 0.0]), np.array([16.0, 18.0, 11.0])),
)
EXTRA = (np.array([4.0, -18.0, 0.0]), np.array([18.0, -6.0, 9.0]))


V, U = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
RAYS = np.stack([U - SIZE[0] / 2, V - SIZE[1] / 2, np.full_like(U, FOCAL_PX)], axis=-1).reshape(-1, 3) / FOCAL_PX


@dataclass(frozen=True, eq=False)
class Town:
    """Ground at zero height and boxes."""

    boxes: tuple[tuple[np.ndarray, np.ndarray], ...]

    def distance(self, origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
        """Distances (N,) along rays (N, 3) to the first surface; infinite: none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            nearest = np.where(ray[:, 2] < 0, -origin[..., 2] / ray[:, 2], np.inf)
            for low, high in self.boxes:
                near = np.minimum((low - origin) / ray, (high - origin) / ray).max(axis=1)
                far = np.maximum((low - origin) / ray, (high - origin) / ray).min(axis=1)
                nearest = np.where((near <= far) & (near > 0), np.minimum(nearest, near), nearest)
        return nearest


@cache
def views_of(town: Town) -> DepthViews:
    """Depth maps of twelve photographs on a circle, 45° down."""
    turns = np.arange(12) * np.pi / 6
    centers = np.stack([45 * np.cos(turns), 45 * np.sin(turns), np.full(12, 42.0)], axis=1)
    yaw = np.degrees(np.arctan2(-centers[:, 0], -centers[:, 1]))
    rotations = geo_from_cam(np.stack([yaw, np.full(12, -43.0), np.zeros(12)], axis=1)).transpose(0, 2, 1)
    depths = [town.distance(center, RAYS @ rotation) for center, rotation in zip(centers, rotations, strict=True)]
    depth = np.concatenate(depths)
    return DepthViews(
        rotations, centers, np.tile([FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2], (12, 1)),
        np.tile(SIZE, (12, 1)),
        np.arange(12) * len(RAYS), np.where(np.isfinite(depth), depth, 0.0).astype(np.float32),
    )  # fmt: skip


@cache
def surface_of(town: Town) -> np.ndarray:
    """Points of the depth maps."""
    views = views_of(town)
    depth = views.depth_m.reshape(12, -1)
    points = [views.center_in_world[i] + depth[i][:, None] * RAYS @ views.cam_from_world[i] for i in range(12)]
    return np.concatenate(points)[depth.ravel() > 0]


def scanned(town: Town, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0) -> LidarCloud:
    """Cloud of strips at 60 m height, beams up to 40° to all sides."""
    rng = np.random.default_rng(seed)
    scanner = np.concatenate([rng.uniform(-40, 40, (24_000, 2)), np.full((24_000, 1), 60.0)], axis=1)
    slope, turn = np.sqrt(rng.random(24_000)) * np.tan(np.radians(40)), rng.uniform(0, 2 * np.pi, 24_000)
    beam = np.stack([slope * np.cos(turn), slope * np.sin(turn), -np.ones(24_000)], axis=1)
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    range_m = town.distance(scanner, beam) + rng.normal(0, SIGMA_M, len(beam))
    place = scanner + range_m[:, None] * beam
    kept = (np.abs(place[:, :2]) < 24).all(axis=1)
    planes = planes_of(place[kept] + shift, np.ones(kept.sum(), np.uint8), SPACING_M)
    return replace(planes, scanner_in_model=scanner[kept] + shift)


TOWN, WITH_EXTRA = Town(HOUSES), Town((*HOUSES, EXTRA))
