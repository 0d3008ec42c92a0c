"""A scene for stereo that is known exactly: a step in level ground, seen from a ring."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.surface.matching import MatchSettings, StereoView
from pipelines.surface.sweep import NormalMap, SweepPlanes, SweepResult, plane_sweep

CAMERA = Pinhole(120, 90, 110.0, 110.0, 60.0, 45.0)
GROUND_M, ROOF_M, ROOF_SIDE_M = 0.0, 6.0, 8.0
TEXEL_M = 0.1
LEVEL = SweepPlanes(np.array([0.0, 0.0, 1.0]), np.arange(-4.0, 10.0, 0.5))
# A pixel is 0.36 m wide on the ground, neighbours are 20° apart: a tenth of a pixel is 0.1 m of height.
TENTH_PX_M = 0.1


def looking_at_origin(azimuth_deg: float, height_m: float = 30.0, radius_m: float = 25.0) -> tuple[np.ndarray, ...]:
    azimuth = np.radians(azimuth_deg)
    center = np.array([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), height_m])
    axis = -center / np.linalg.norm(center)
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis]), center


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(60, 200, (800, 800)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 3.0) * 4 - 390


def painted(seed: int, right_m: np.ndarray, up_m: np.ndarray) -> np.ndarray:
    """Return the texture at places on a plane."""
    column, row = ((along / TEXEL_M + 400).astype(np.float32) for along in (right_m, up_m))
    return np.asarray(cv2.remap(texture(seed), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def photographed(camera: ViewPose, grey: np.ndarray) -> StereoView:
    """Return a view of grey levels (H, W), rounded and clipped to 1 … 255."""
    return StereoView(camera, np.clip(np.rint(grey), 1, 255).astype(np.uint8))


def true_depth(camera: ViewPose) -> np.ndarray:
    """Return the depth (H, W) of the first surface along each ray: the square roof, or the ground."""
    rays, center = camera.rays(), camera.center_in_model
    roof = (ROOF_M - center[2]) / rays[..., 2]
    on_roof = center + roof[..., None] * rays
    hit = (np.abs(on_roof[..., :2]) < ROOF_SIDE_M / 2).all(axis=-1)
    return np.where(hit, roof, (GROUND_M - center[2]) / rays[..., 2])


def shot(azimuth_deg: float, brightness: float = 1.0, pinhole: Pinhole = CAMERA) -> StereoView:
    rotation, center = looking_at_origin(azimuth_deg)
    camera = ViewPose(pinhole, rotation, center)
    place = center + true_depth(camera)[..., None] * camera.rays()
    ground, roof = (painted(seed, place[..., 0], place[..., 1]) for seed in (1, 2))
    return photographed(camera, brightness * np.where(place[..., 2] > 0.5 * ROOF_M, roof, ground))


def level_normals(pinhole: Pinhole = CAMERA) -> NormalMap:
    """Return the normal map of level planes at all pixels."""
    return NormalMap(LEVEL.normal_in_model[None], np.zeros((pinhole.height, pinhole.width), np.uint8))


def ring_of_views(pinhole: Pinhole = CAMERA) -> list[StereoView]:
    """Return views of different brightness, as the exposure of a flight varies."""
    return [shot(azimuth, 1 + 0.1 * (index % 3), pinhole) for index, azimuth in enumerate(range(0, 120, 20))]


def neighbours_of(ring: list[StereoView], index: int) -> list[StereoView]:
    """Return the four views next to one."""
    return [view for place, view in enumerate(ring) if 0 < abs(place - index) <= 2]


def depth_estimate(ring: list[StereoView], index: int) -> SweepResult:
    """Return the depths that a sweep of level planes gives a view of the ring."""
    return plane_sweep(ring[index], neighbours_of(ring, index), [LEVEL], MatchSettings())
