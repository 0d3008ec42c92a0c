"""Agreement between the depths of several views (geometric consistency): depths of one view alone are chance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import Float32Array, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.stereo.agreement_kernel import compare_depths
from pipelines.stereo.sweep import SweepResult
from pipelines.stereo.views import StereoCamera


@dataclass(frozen=True)
class DepthEstimate:
    """Depths of one view, estimated by a sweep or its refinement."""

    camera: StereoCamera
    sweep: SweepResult

    def depth(self) -> FloatArray:
        """Return the depth (H, W) along the optical axis."""
        return self.sweep.normals.depth(self.camera, self.sweep.offset_m)


@dataclass(frozen=True)
class AgreementSettings:
    """Thresholds of agreement.

    Attributes:
        least_score: smallest correlation that counts.
        steps: largest difference, in steps of the sweep.
        least_views: number of other views that must agree.
        free: a view looks through a place if its own surface lies further away by this part of its distance.
        most_through: largest number of views that look through a surface, as a part of the views that agree.
        rim: a surface ends where the next pixel lies behind its plane by this part of the depth.
    """

    least_score: float = 0.4
    steps: float = 1.5
    least_views: int = 2
    free: float = 0.02
    most_through: float = 0.5
    rim: float = 0.01


def agreed_depth(
    reference: DepthEstimate, others: list[DepthEstimate], settings: AgreementSettings
) -> Float32Array:
    """Return depths (H, W) along the optical axis of `reference`, the mean of the views that agree; 0 if few do.

    1. Each point of the reference is reprojected into each other view. The residual is the distance to the surface
       of that view along its normal: on a plane, pixels need not coincide.
    2. Views weigh by the square of the sharpness of their peaks, because noise of the score moves a blunt peak
       further. A view without a baseline agrees with any depth.
    3. Where too many views look through a point, the point is no surface, even if others agree: all views from one
       side of a roof take the ground beside it for roof.
    """
    own, depth = reference.sweep, reference.depth()
    good = (own.score > settings.least_score) & np.isfinite(depth) & (depth > 0)
    length = np.where(good, depth, 0.0)
    per_metre = own.normals.offset_per_metre(reference.camera)
    sums, counts = np.zeros((2, *depth.shape)), np.zeros((2, *depth.shape), np.int32)
    sums[1] = (per_metre * own.sharpness) ** 2
    limits = np.array([settings.least_score, settings.steps, settings.free])
    camera = reference.camera
    for other in others:
        surface = other.sweep
        compare_depths(
            *(length, camera.cam_from_world.T @ np.linalg.inv(_camera_matrix(camera.pinhole))),
            *(camera.center_in_world, other.camera.center_in_world),
            _camera_matrix(other.camera.pinhole) @ other.camera.cam_from_world,
            np.stack([surface.offset_m, surface.score, surface.step_m, surface.sharpness]),
            *(surface.normals.index, surface.normals.normals_in_world, limits, sums, counts),
        )
    views, through = counts
    agreed = good & (views >= settings.least_views) & (through < settings.most_through * views)
    mean = length + np.divide(sums[0], sums[1], out=np.zeros_like(length), where=agreed)
    return np.where(agreed, mean, 0.0).astype(np.float32)


def _camera_matrix(camera: Pinhole) -> FloatArray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def without_rims(depth: Float32Array, reach_px: int, rim: float) -> Float32Array:
    """Return a depth map (H, W) with 0 where a surface ends before another within `reach_px`.

    Foreground fattening is the reason: the contrast of an edge dominates the windows across it, so that the ground
    beside a roof matches as roof. The outermost half window of a surface is therefore none. The test compares
    inverse depths, which are linear on a plane however steep the view.

    Args:
        depth: along the optical axis, 0 where unknown.
        reach_px: half the window's side.
        rim: see `AgreementSettings`.
    """
    height, width = depth.shape
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-9), np.nan)
    ends = np.zeros(depth.shape, dtype=np.bool_)
    for reach in range(1, reach_px + 1):
        around = np.pad(inverse, reach, constant_values=np.nan)
        for down, right in itertools.product((-reach, 0, reach), repeat=2):
            ahead = around[reach + down :, reach + right :][:height, :width]
            behind = around[reach - down :, reach - right :][:height, :width]
            ends |= ahead < (2 - rim) * inverse - behind
    return np.where(ends, np.float32(0), depth)
