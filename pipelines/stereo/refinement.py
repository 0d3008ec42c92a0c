"""Refinement of a surface on finer pixels: each pixel compares hypotheses around its own prior only.

The scheme is that of cascaded cost volumes (Gu et al., doi 10.1109/CVPR42600.2020.00257). A window across the edge
of a roof then sees the roof where the roof is, and the ground where the ground is. A sweep of planes takes that
ground for roof.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.core.types import Float32Array, FloatArray
from pipelines.stereo.agreement import DepthEstimate
from pipelines.stereo.matching import UNSEEN, Matcher, MatchSettings, WinnerTakesAll
from pipelines.stereo.sweep import (
    NormalMap,
    StereoCamera,
    StereoView,
    SweepResult,
    opencv_camera_matrix,
    sweep_result,
)

_REACH = 4  # steps on either side of the prior
_STEPS = 3  # for one step of the sweep that the prior is from
_SPECKLE_PX = 5  # parts smaller than half of this are chance where one view alone has depths
_LEAST_DEPTH = 1e-3
_OUTSIDE = -10.0


@dataclass(frozen=True)
class SurfacePrior:
    """Rough surface to start a refinement from.

    Attributes:
        normals: directions of the offsets.
        offset_m: (H, W) of the surface at each pixel of a view.
        step_m: (H, W) between two hypotheses.
    """

    normals: NormalMap
    offset_m: Float32Array
    step_m: Float32Array


def surface_prior(estimate: DepthEstimate, agreed: Float32Array, camera: StereoCamera) -> SurfacePrior:
    """Return the prior at the pixels of a finer camera: depths that views agree on, elsewhere the view's own.

    Args:
        estimate: the view's own depths, on coarse pixels.
        agreed: (H, W) depths that views agree on, on the same pixels; 0 elsewhere.
        camera: the finer camera.
    """
    normals, own = estimate.sweep.normals, estimate.depth()
    own = np.where(np.isfinite(own) & (own > 0), own, 0).astype(np.float32)
    own = np.asarray(cv2.medianBlur(own, _SPECKLE_PX), np.float32)
    offset = normals.offset(estimate.camera, np.where(agreed > 0, agreed, own))
    size = (camera.pinhole.width, camera.pinhole.height)
    finer = [
        # Interpolation between roof and ground would make offsets at which nothing lies.
        cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        for image in (normals.index, offset.astype(np.float32), estimate.sweep.step_m / np.float32(_STEPS))
    ]
    which = np.asarray(finer[0], np.uint8)
    return SurfacePrior(
        NormalMap(normals.normals_in_world, which),
        np.asarray(finer[1], np.float32),
        np.asarray(finer[2], np.float32),
    )


def refine(
    reference: StereoView, neighbours: list[StereoView], prior: SurfacePrior, settings: MatchSettings
) -> SweepResult:
    """Compare a view with its neighbours at offsets around a prior, and keep the best.

    A best match at either end of the range means that the surface lies outside of it: its score becomes −1.

    Args:
        reference: view whose surface is wanted.
        neighbours: one or more views of the same place from elsewhere.
        prior: rough surface at the pixels of `reference`.
        settings: of the comparison.

    Raises:
        ValueError: no neighbours.
    """
    if not neighbours:
        raise ValueError("no neighbours to compare with")
    matcher, search = Matcher(reference.grey, settings), WinnerTakesAll(reference.grey.shape)
    rays = reference.camera.rays()
    samplers = [_NeighbourSampler(rays, reference.camera.center_in_world, view) for view in neighbours]
    middle = prior.normals.depth(reference.camera, prior.offset_m).astype(np.float32)
    with np.errstate(divide="ignore"):
        step = (prior.step_m / prior.normals.offset_per_metre(reference.camera)).astype(np.float32)
    for number in range(-_REACH, _REACH + 1):
        depth = middle + np.float32(number) * step
        score = matcher(sampler.sample(depth) for sampler in samplers)
        score[~(depth > 0)] = UNSEEN
        search.add(score)
    winner = search.winner()
    offset = prior.offset_m + (winner.hypothesis - _REACH) * prior.step_m
    refined = sweep_result(winner, prior.normals, offset, prior.step_m)
    return replace(refined, score=np.where(winner.inner, refined.score, np.float32(UNSEEN)))


class _NeighbourSampler:
    """Samples a neighbour's image at points on rays (H, W, 3) from a centre (3,)."""

    def __init__(self, rays: FloatArray, center_in_world: FloatArray, other: StereoView) -> None:
        pixel_from_world = opencv_camera_matrix(other.camera.pinhole) @ other.camera.cam_from_world
        per_depth = (rays @ pixel_from_world.T).astype(np.float32)
        self._per_depth = [np.ascontiguousarray(per_depth[..., axis]) for axis in range(3)]
        start = pixel_from_world @ (center_in_world - other.camera.center_in_world)
        self._start = start.astype(np.float32)
        self._grey = other.grey
        self._in_image = [np.empty_like(per_depth) for per_depth in self._per_depth]

    def sample(self, depth: Float32Array) -> Float32Array:
        """Return the neighbour's grey levels (H, W) at depths (H, W) of the rays; 0 outside its image."""
        for in_image, per_depth, start in zip(self._in_image, self._per_depth, self._start, strict=True):
            np.add(np.multiply(depth, per_depth, out=in_image), start, out=in_image)
        x, y, z = self._in_image
        behind = ~(z > _LEAST_DEPTH)
        z[behind] = 1.0
        x /= z
        y /= z
        x[behind] = _OUTSIDE
        y[behind] = _OUTSIDE
        image = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(image, np.float32)
