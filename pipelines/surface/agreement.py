"""Agreement between the depths of several views (geometric consistency), and their refinement on finer pixels.

Depths of one view alone are chance. In the refinement, each pixel compares hypotheses around its own prior only, as
in cascaded cost volumes (Gu et al., doi 10.1109/CVPR42600.2020.00257). A window across the edge of a roof then sees
the roof where the roof is, and the ground where the ground is. A sweep of planes takes that ground for roof.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.geometry.cameras import ViewPose
from pipelines.splat.kernel_cache import kernel
from pipelines.surface.matching import (
    UNSEEN,
    Matcher,
    MatchSettings,
    StereoView,
    WinnerTakesAll,
    camera_matrix,
    is_hypothesis,
)
from pipelines.surface.sweep import NormalMap, SweepResult, sweep_result

# ruff: noqa: PLR0917  (kernels take arrays, not objects)


_GRAZING = 0.1  # of the depth: a ray that grazes the planes moves further between them
LEAST_SCORE = 0.4  # correlation that counts
SAME_STEPS = 1.5  # largest difference of surfaces that agree, in steps of the sweep
LEAST_VIEWS = 2  # other ones, that must agree
FREE = 0.02  # a view looks through a place if its own surface lies further away by this part of its distance
MOST_THROUGH = 0.5  # views that look through a surface, as a part of the views that agree
_RIM = 0.01  # of the depth: a surface ends where the next pixel lies behind its plane by more
THRESHOLDS = (LEAST_SCORE, SAME_STEPS, LEAST_VIEWS, FREE, MOST_THROUGH, _RIM)


@kernel(nogil=True, error_model="numpy")
def compare_depths(
    depth: FloatArray,  # (H, W) float64
    ray_from_pixel: FloatArray,  # (3, 3) float64
    center: FloatArray,  # (3,) float64
    other_center: FloatArray,  # (3,) float64
    pixel_from_model: FloatArray,  # (3, 3) float64
    other: Float32Array,  # (4, h, w) float32
    other_index: ByteArray,  # (h, w) uint8
    other_normals: FloatArray,  # (F, 3) float64
    sums: FloatArray,  # (2, H, W) float64
    counts: NDArray[np.int32],  # (2, H, W) int32
) -> None:
    """Compare the points of a view with the surface of one other view, without the GIL, and add up what it says.

    Args:
        depth: (H, W) float64 along the optical axis of the view; 0: no point.
        ray_from_pixel: (3, 3), from pixel (column, row, 1) to a ray of length one along the axis.
        center: (3,) of the view in `model`.
        other_center: (3,) of the other view.
        pixel_from_model: (3, 3) homogeneous pixel in the other view of a place relative to its centre.
        other: (4, h, w) float32: offset, score, step and sharpness of the other view.
        other_index: (h, w) rows of `other_normals`.
        other_normals: (F, 3).
        sums: (2, H, W) float64; grows by the weighted differences of the depth, and by their weights.
        counts: (2, H, W) int32; grows by one where the other view agrees, and where it looks through the point.
    """
    rows, columns = other.shape[1], other.shape[2]
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            length = depth[v, u]
            if length <= 0:
                continue
            x, y = u + 0.5, v + 0.5
            r0 = ray_from_pixel[0, 0] * x + ray_from_pixel[0, 1] * y + ray_from_pixel[0, 2]
            r1 = ray_from_pixel[1, 0] * x + ray_from_pixel[1, 1] * y + ray_from_pixel[1, 2]
            r2 = ray_from_pixel[2, 0] * x + ray_from_pixel[2, 1] * y + ray_from_pixel[2, 2]
            p0, p1, p2 = center[0] + length * r0, center[1] + length * r1, center[2] + length * r2
            q0, q1, q2 = p0 - other_center[0], p1 - other_center[1], p2 - other_center[2]
            z = pixel_from_model[2, 0] * q0 + pixel_from_model[2, 1] * q1 + pixel_from_model[2, 2] * q2
            if z <= 0:
                continue
            across = (pixel_from_model[0, 0] * q0 + pixel_from_model[0, 1] * q1 + pixel_from_model[0, 2] * q2) / z
            down = (pixel_from_model[1, 0] * q0 + pixel_from_model[1, 1] * q1 + pixel_from_model[1, 2] * q2) / z
            if not (across >= 0 and across < columns and down >= 0 and down < rows):
                continue
            column, row = int(across), int(down)
            if not other[1, row, column] > LEAST_SCORE:
                continue
            which = other_index[row, column]
            n0, n1, n2 = other_normals[which, 0], other_normals[which, 1], other_normals[which, 2]
            offset = p0 * n0 + p1 * n1 + p2 * n2
            residual = np.float64(other[0, row, column]) - offset
            seen_at = offset - (n0 * other_center[0] + n1 * other_center[1] + n2 * other_center[2])
            if residual / seen_at > FREE:
                counts[1, v, u] += 1
            if abs(residual) < SAME_STEPS * other[2, row, column]:
                along = r0 * n0 + r1 * n1 + r2 * n2
                longer = residual / along
                if abs(longer) < _GRAZING * length:
                    weight = (along * other[3, row, column]) ** 2
                    sums[0, v, u] += weight * longer
                    sums[1, v, u] += weight
                    counts[0, v, u] += 1


def agreed_depth(own: SweepResult, others: list[SweepResult]) -> Float32Array:
    """Return depths (H, W) along the optical axis of `own`, the mean of the views that agree; 0 if few do.

    1. Each point of `own` is reprojected into each other view. The residual is the distance to the surface of that
       view along its normal: on a plane, pixels need not coincide.
    2. Views weigh by the square of the sharpness of their peaks, because noise of the score moves a blunt peak
       further. A view without a baseline agrees with any depth.
    3. Where too many views look through a point, the point is no surface, even if others agree: all views from one
       side of a roof take the ground beside it for roof.
    """
    camera, depth = own.camera, own.depth()
    good = (own.score > LEAST_SCORE) & np.isfinite(depth) & (depth > 0)
    length = np.where(good, depth, 0.0)
    per_metre = own.normals.offset_per_metre(camera)
    sums, counts = np.zeros((2, *depth.shape)), np.zeros((2, *depth.shape), np.int32)
    sums[1] = (per_metre * own.sharpness) ** 2
    for other in others:
        compare_depths(
            *(length, camera.cam_from_model.T @ np.linalg.inv(camera_matrix(camera.pinhole))),
            *(camera.center_in_model, other.camera.center_in_model),
            camera_matrix(other.camera.pinhole) @ other.camera.cam_from_model,
            np.stack([other.offset_m, other.score, other.step_m, other.sharpness]),
            *(other.normals.index, other.normals.normals_in_model, sums, counts),
        )
    views, through = counts
    agreed = good & (views >= LEAST_VIEWS) & (through < MOST_THROUGH * views)
    mean = length + np.divide(sums[0], sums[1], out=np.zeros_like(length), where=agreed)
    return np.where(agreed, mean, 0.0).astype(np.float32)


_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # down and right: to one of each two opposite neighbours


def bends(
    depth: Float32Array, reach_px: int, directions: Sequence[tuple[int, int]] = _DIRECTIONS
) -> Iterator[Float32Array]:
    """Yield for each direction z/z₁ + z/z₂ − 2 (H, W) of a depth z between z₁ and z₂, `reach_px` to either side.

    It is 0 on a plane, at any angle of view, as the inverse depth of a plane is linear on the image, and negative
    where a surface ends before another. NaN: one of the three is not known (0), or outside.
    """
    height, width = depth.shape
    inverse = np.where(depth > 0, 1 / np.maximum(depth, np.float32(1e-9)), np.float32(np.nan))
    around = np.pad(inverse, reach_px, constant_values=np.nan)
    for down, right in np.multiply(directions, reach_px).tolist():
        ahead = around[reach_px + down :, reach_px + right :][:height, :width]
        behind = around[reach_px - down :, reach_px - right :][:height, :width]
        yield (ahead + behind) * depth - np.float32(2)


def without_rims(depth: Float32Array, reach_px: int) -> Float32Array:
    """Return a depth map (H, W) with 0 where a surface ends before another within `reach_px`.

    Foreground fattening is the reason: the contrast of an edge dominates the windows across it, so that the ground
    beside a roof matches as roof. The outermost half window of a surface is therefore none.
    """
    ends = np.zeros(depth.shape, dtype=np.bool_)
    for reach in range(1, reach_px + 1):
        for bend in bends(depth, reach):
            ends |= bend < -_RIM
    return np.where(ends, np.float32(0), depth)


_REACH = 4  # steps on either side of the prior
_SPECKLE_PX = 5  # parts smaller than half of this are chance where one view alone has depths


@dataclass(frozen=True)
class SurfacePrior:
    """Rough surface to start a refinement from: offsets (H, W), and the steps (H, W) between two hypotheses."""

    normals: NormalMap
    offset_m: Float32Array
    step_m: Float32Array


def surface_prior(coarse: SweepResult, agreed: Float32Array, camera: ViewPose, steps: float) -> SurfacePrior:
    """Return the prior at the pixels of a finer camera: the agreed depths (H, W), else the own ones.

    Between two hypotheses of `coarse` there will be so many `steps`.
    """
    normals, own = coarse.normals, coarse.depth()
    own = np.where(np.isfinite(own) & (own > 0), own, 0).astype(np.float32)
    own = np.asarray(cv2.medianBlur(own, _SPECKLE_PX), np.float32)
    offset = normals.offset(coarse.camera, np.where(agreed > 0, agreed, own))
    size = (camera.pinhole.width, camera.pinhole.height)
    finer = [
        # Interpolation between roof and ground would make offsets at which nothing lies.
        cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        for image in (normals.index, offset.astype(np.float32), coarse.step_m / np.float32(steps))
    ]
    which = np.asarray(finer[0], np.uint8)
    return SurfacePrior(
        NormalMap(normals.normals_in_model, which),
        np.asarray(finer[1], np.float32),
        np.asarray(finer[2], np.float32),
    )


def refine(
    reference: StereoView, neighbours: list[StereoView], prior: SurfacePrior, settings: MatchSettings
) -> SweepResult:
    """Compare a view with its neighbours at offsets around a prior, and keep the best; a ValueError: no neighbours.

    A best match at either end of the range means that the surface lies outside of it: its score becomes −1.
    """
    if not neighbours:
        raise ValueError("no neighbours to compare with")
    matcher, search = Matcher(reference, neighbours, settings), WinnerTakesAll(reference.grey.shape)
    middle = prior.normals.depth(reference.camera, prior.offset_m).astype(np.float32)
    with np.errstate(divide="ignore"):
        step = (prior.step_m / prior.normals.offset_per_metre(reference.camera)).astype(np.float32)
    for number in range(-_REACH, _REACH + 1):
        depth = middle + np.float32(number) * step
        search.add(matcher(depth), is_hypothesis(depth))
    winner = search.winner()
    offset = prior.offset_m + (winner.hypothesis - _REACH) * prior.step_m
    refined = sweep_result(winner, reference.camera, prior.normals, offset, prior.step_m)
    return replace(refined, score=np.where(winner.inner, refined.score, np.float32(UNSEEN)))
