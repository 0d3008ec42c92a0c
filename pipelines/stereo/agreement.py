"""Agreement between the depths of several views: what other views see too is a surface, the rest is chance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.stereo.sweep import StereoCamera, SweepResult


@dataclass(frozen=True)
class DepthEstimate:
    """The surface that a sweep found in a view."""

    camera: StereoCamera
    sweep: SweepResult

    def depth(self) -> FloatArray:
        """Depth (H, W) along the optical axis."""
        return self.sweep.normals.depth(self.camera, self.sweep.offset_m)


@dataclass(frozen=True)
class AgreementSettings:
    """When views agree.

    Attributes:
        least_score: correlation that counts.
        steps: largest difference, in steps of the sweep.
        least_views: other views that must agree.
        free: a view that sees a surface further away than a place by this part of its distance looks through it.
        most_through: views that look through, as a part of those that agree: with more there is nothing.
        rim: a surface ends where what follows lies further away than its plane goes on by this part of the depth.
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
    """Depth (H, W) along the optical axis of `reference`, the mean of the views that agree; 0 where too few do.

    A point of the reference is looked up in each other view. The difference is taken along the normal of the plane
    that was found there: on a surface that planes follow, it does not matter that pixels do not coincide. Views
    weigh by the square of the sharpness of their peaks, since noise of the score moves a blunt one further: a view
    without a baseline agrees with anything. Where views look through the point there is no surface, though others
    err alike: beside a roof all of those on one side take the ground for roof.
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
        seen = _look_up(point, other, settings)
        along = np.einsum("ni,ni->n", ray[seen.near], seen.normal_in_world)
        with np.errstate(divide="ignore"):
            longer = seen.missed_m / along
        fits = np.abs(longer) < 0.1 * length[seen.near]  # not where the ray grazes the planes
        place, of_view = seen.near[fits], ((along * seen.sharpness) ** 2)[fits]
        total[place] += of_view * longer[fits]
        weight[place] += of_view
        count[place] += 1
        through[seen.through] += 1
    agreed = (count >= settings.least_views) & (through < settings.most_through * count)
    found = np.zeros(depth.shape, dtype=np.float32)
    found[rows[agreed], columns[agreed]] = length[agreed] + total[agreed] / weight[agreed]
    return found


@dataclass(frozen=True)
class _Seen:
    """Points as another view sees them.

    Attributes:
        near: indices (N,) of those on its surface.
        normal_in_world: (N, 3) of that surface.
        missed_m: (N,) how far that surface is from them, along its normal.
        sharpness: (N,) with which it was found.
        through: indices of those that it looks through.
    """

    near: IntArray
    normal_in_world: FloatArray
    missed_m: FloatArray
    sharpness: Float32Array
    through: IntArray


def _look_up(point: FloatArray, other: DepthEstimate, settings: AgreementSettings) -> _Seen:
    """Points (P, 3) in another view."""
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
    missed = np.asarray(other.sweep.offset_m[place] - offset, np.float64)
    near = np.abs(missed) < settings.steps * other.sweep.step_m[place]
    with np.errstate(divide="ignore"):
        further = missed / (offset - normal @ other.camera.center_in_world)
    return _Seen(
        ahead[near], normal[near], missed[near], other.sweep.sharpness[place][near], ahead[further > settings.free]
    )


def without_rims(depth: Float32Array, reach_px: int, rim: float) -> Float32Array:
    """A depth map (H, W) with 0 where a surface ends before another within so many pixels.

    A window across an edge is compared by its contrast, and takes the ground beside a roof for roof: of a surface,
    the outermost half window is not one. On planes the inverse depth is linear, however steeply they are seen.

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
