"""Agreement between the depths of several views (geometric consistency): depths of one view alone are chance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.stereo.sweep import StereoCamera, SweepResult


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
    rays = reference.camera.rays()
    depth = reference.depth()
    good = (reference.sweep.score > settings.least_score) & np.isfinite(depth) & (depth > 0)
    rows, columns = np.nonzero(good)
    length, ray = depth[rows, columns], rays[rows, columns]
    point = reference.camera.center_in_world + length[:, None] * ray
    own = reference.sweep.normals.offset_per_metre(reference.camera)
    weight = (own * reference.sweep.sharpness)[rows, columns] ** 2
    total, count, through = np.zeros(len(rows)), np.zeros(len(rows)), np.zeros(len(rows))
    for other in others:
        reprojection = _reproject(point, other, settings)
        along = np.einsum("ni,ni->n", ray[reprojection.near], reprojection.normal_in_world)
        with np.errstate(divide="ignore"):
            longer = reprojection.residual_m / along
        fits = np.abs(longer) < 0.1 * length[reprojection.near]  # not where the ray grazes the planes
        place, of_view = reprojection.near[fits], ((along * reprojection.sharpness) ** 2)[fits]
        total[place] += of_view * longer[fits]
        weight[place] += of_view
        count[place] += 1
        through[reprojection.through] += 1
    agreed = (count >= settings.least_views) & (through < settings.most_through * count)
    agreed_m = np.zeros(depth.shape, dtype=np.float32)
    agreed_m[rows[agreed], columns[agreed]] = length[agreed] + total[agreed] / weight[agreed]
    return agreed_m


@dataclass(frozen=True)
class _Reprojection:
    """Points of the reference, reprojected into another view.

    Attributes:
        near: indices (N,) of the points on the surface of that view.
        normal_in_world: (N, 3) of that surface.
        residual_m: (N,) distance from the point to that surface, along its normal.
        sharpness: (N,) of the match that gave the surface.
        through: indices of the points that the view looks through.
    """

    near: IntArray
    normal_in_world: FloatArray
    residual_m: FloatArray
    sharpness: Float32Array
    through: IntArray


def _reproject(point: FloatArray, other: DepthEstimate, settings: AgreementSettings) -> _Reprojection:
    """Compare points (P, 3) with the surface of another view."""
    camera, normals = other.camera.pinhole, other.sweep.normals
    in_cam = (point - other.camera.center_in_world) @ other.camera.cam_from_world.T
    ahead = np.flatnonzero(in_cam[:, 2] > 0)
    column = np.floor(camera.fx * in_cam[ahead, 0] / in_cam[ahead, 2] + camera.cx)
    row = np.floor(camera.fy * in_cam[ahead, 1] / in_cam[ahead, 2] + camera.cy)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    ahead, place = ahead[inside], (row[inside].astype(np.int64), column[inside].astype(np.int64))
    known = other.sweep.score[place] > settings.least_score
    ahead, place = ahead[known], (place[0][known], place[1][known])
    normal = normals.normals_in_world[normals.index[place]]
    offset = np.einsum("ni,ni->n", point[ahead], normal)
    residual = np.asarray(other.sweep.offset_m[place] - offset, np.float64)
    near = np.abs(residual) < settings.steps * other.sweep.step_m[place]
    with np.errstate(divide="ignore"):
        further = residual / (offset - normal @ other.camera.center_in_world)
    return _Reprojection(
        ahead[near],
        normal[near],
        residual[near],
        other.sweep.sharpness[place][near],
        ahead[further > settings.free],
    )


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
