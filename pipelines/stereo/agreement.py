"""Agreement between the depths of several views: what other views see too is a surface, the rest is chance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.products import FloatArray
from pipelines.stereo.sweep import FloatImage, Planes, StereoCamera, Swept


@dataclass(frozen=True)
class Surface:
    """The surface that a sweep found in a view."""

    camera: StereoCamera
    planes: Planes
    swept: Swept


@dataclass(frozen=True)
class AgreementSettings:
    """When views agree.

    Attributes:
        least_score: correlation that counts.
        steps: largest difference, in steps of the sweep.
        least_views: other views that must agree.
        rim: a surface ends where what follows lies further away than its plane goes on by this part of the depth.
    """

    least_score: float = 0.4
    steps: float = 1.5
    least_views: int = 2
    rim: float = 0.01


def agreed_depth(reference: Surface, others: list[Surface], settings: AgreementSettings) -> FloatImage:
    """Depth (H, W) along the optical axis of `reference`, the mean of the views that agree; 0 where too few do.

    A point of the reference is looked up in each other view. The difference is taken along the normal of the
    other view's planes: on a surface that these follow, it does not matter that pixels do not coincide. Views weigh
    by the square of the sharpness of their peaks, since noise of the score moves a blunt one further: a view
    without a baseline agrees with anything.
    """
    rays = reference.camera.rays()
    depth = reference.planes.depth(reference.camera, reference.swept.offset_m)
    good = (reference.swept.score > settings.least_score) & np.isfinite(depth) & (depth > 0)
    rows, columns = np.nonzero(good)
    total, weight, count = np.zeros(depth.shape), np.ones(depth.shape), np.zeros(depth.shape, dtype=np.int64)
    own = rays[rows, columns] @ reference.planes.normal_in_world
    weight[rows, columns] = (own * reference.swept.sharpness[rows, columns]) ** 2
    point = reference.camera.center_in_world + depth[rows, columns, None] * rays[rows, columns]
    for other in others:
        seen, missed, sharpness = _missed(point, other, settings)
        along = rays[rows[seen], columns[seen]] @ other.planes.normal_in_world
        with np.errstate(divide="ignore"):
            longer = missed / along
        fits = np.abs(longer) < 0.1 * depth[rows[seen], columns[seen]]  # not where the ray grazes the planes
        place, of_view = (rows[seen][fits], columns[seen][fits]), ((along * sharpness) ** 2)[fits]
        total[place] += of_view * longer[fits]
        weight[place] += of_view
        count[place] += 1
    agreed = count >= settings.least_views
    return np.where(agreed, depth + total / weight, 0.0).astype(np.float32)


def _missed(
    point: FloatArray, other: Surface, settings: AgreementSettings
) -> tuple[NDArray[np.int64], FloatArray, FloatImage]:
    """Indices of the points (P, 3) that lie on another view's surface, how far from it along its normal, and how
    sharply that was found."""
    camera = other.camera.pinhole
    in_cam = (point - other.camera.center_in_world) @ other.camera.cam_from_world.T
    ahead = np.flatnonzero(in_cam[:, 2] > 0)
    column = np.floor(camera.fx * in_cam[ahead, 0] / in_cam[ahead, 2] + camera.cx)
    row = np.floor(camera.fy * in_cam[ahead, 1] / in_cam[ahead, 2] + camera.cy)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    ahead, place = ahead[inside], (row[inside].astype(np.int64), column[inside].astype(np.int64))
    missed = other.swept.offset_m[place] - point[ahead] @ other.planes.normal_in_world
    near = np.abs(missed) < settings.steps * other.swept.step_m[place]
    near &= other.swept.score[place] > settings.least_score
    return ahead[near], np.asarray(missed[near]), other.swept.sharpness[place][near]


def without_rims(depth: FloatImage, reach_px: int, rim: float) -> FloatImage:
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
