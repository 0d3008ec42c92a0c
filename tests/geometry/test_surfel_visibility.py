"""Visibility of discs against the geometry that they sample."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.cameras import Pinhole
from pipelines.surface.crossings import Surfels, seen_surfels

CAMERA = Pinhole(96, 72, 80.0, 80.0, 48.0, 36.0)
STEP_M = 0.1


def plane(half_m: float, depth_m: float, tilt_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) of a square ahead of the camera, turned about the vertical, and their normals."""
    side = np.arange(-half_m, half_m + STEP_M / 2, STEP_M)
    u, v = (axis.ravel() for axis in np.meshgrid(side, side))
    cos, sin = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    points = np.stack([u * cos, v, depth_m + u * sin], axis=1)
    return points, np.broadcast_to([-sin, 0.0, cos], points.shape)


def seen(*planes: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Whether each point is seen from the origin, in the order of the planes."""
    position, normal = (np.concatenate(parts) for parts in zip(*planes, strict=True))
    surfels = Surfels(position, normal, np.full(len(position), 0.8 * STEP_M))
    mask = np.zeros(len(position), dtype=bool)
    mask[seen_surfels(surfels, np.eye(3), np.zeros(3), CAMERA).rows] = True
    return mask


def test_a_square_hides_what_lies_in_its_shadow_and_nothing_else() -> None:
    near, far = plane(1.0, 5.0), plane(3.0, 10.0)
    mask = seen(near, far)
    assert mask[: len(near[0])].all()
    # The shadow of ±1 m at 5 m is ±2 m at 10 m. Discs and pixels blur its edge by 0.16 m and 0.125 m.
    reach = np.abs(far[0][:, :2]).max(axis=1)
    behind = mask[len(near[0]) :]
    assert not behind[reach < 2.0 - 0.2].any()
    assert behind[reach > 2.0 + 0.45].all()


@pytest.mark.parametrize("tilt_deg", [0.0, 60.0, 75.0])
def test_a_plane_does_not_hide_itself(tilt_deg: float) -> None:
    points = plane(2.0, 10.0, tilt_deg)
    assert seen(points).all()


def test_what_lies_behind_the_camera_or_beside_the_image_is_not_seen() -> None:
    behind, beside = plane(1.0, -5.0), plane(1.0, 5.0)
    beside[0][:, 0] += 10.0
    assert not seen(behind, beside).any()
