"""Refinement of a surface on finer pixels: only what lies near to what is known of it is compared.

As in cascades of cost volumes (Gu et al., doi 10.1109/CVPR42600.2020.00257): each pixel starts from its own guess.
A window across the edge of a roof sees the roof where the roof is, and the ground beside it where the ground is; a
sweep of planes takes that ground for roof.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.core.types import Float32Array, FloatArray
from pipelines.stereo.agreement import DepthEstimate
from pipelines.stereo.matching import UNSEEN, Matcher, MatchSettings, Peak
from pipelines.stereo.sweep import NormalMap, StereoCamera, StereoView, SweepResult, calibration, sweep_result

_REACH = 4  # steps on either side of the guess
_STEPS = 3  # to one of the sweep that the guess is from
_SPECKLE_PX = 5  # of what only one view has found, smaller parts than half of this are chance
_LEAST_DEPTH = 1e-3
_OUTSIDE = -10.0


@dataclass(frozen=True)
class Guess:
    """Where a surface is, roughly.

    Attributes:
        facing: directions that offsets are counted along.
        offset_m: (H, W) of the surface at each pixel of a view.
        step_m: (H, W) between two places to be compared.
    """

    normals: NormalMap
    offset_m: Float32Array
    step_m: Float32Array


def guess_from(estimate: DepthEstimate, agreed: Float32Array, camera: StereoCamera) -> Guess:
    """What views agree on (H, W), and elsewhere what the view itself found, at the pixels of a finer camera."""
    normals, own = estimate.sweep.normals, estimate.depth()
    own = np.where(np.isfinite(own) & (own > 0), own, 0).astype(np.float32)
    own = np.asarray(cv2.medianBlur(own, _SPECKLE_PX), np.float32)
    offset = normals.offset(estimate.camera, np.where(agreed > 0, agreed, own))
    size = (camera.pinhole.width, camera.pinhole.height)
    finer = [
        # Between roof and ground is nothing that an interpolated offset could mean.
        cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        for image in (normals.index, offset.astype(np.float32), estimate.sweep.step_m / np.float32(_STEPS))
    ]
    which = np.asarray(finer[0], np.uint8)
    return Guess(
        NormalMap(normals.normals_in_world, which),
        np.asarray(finer[1], np.float32),
        np.asarray(finer[2], np.float32),
    )


def refine(
    reference: StereoView, neighbours: list[StereoView], guess: Guess, settings: MatchSettings
) -> SweepResult:
    """Compare a view with its neighbours at offsets around a guess.

    A best match at either end of these says only that the surface is elsewhere: its score is −1.

    Args:
        reference: view to find the surface of.
        neighbours: one or more views of the same place from elsewhere.
        guess: where it is, roughly, at the pixels of `reference`.
        settings: how to compare.

    Raises:
        ValueError: no neighbours.
    """
    if not neighbours:
        raise ValueError("no neighbours to compare with")
    matcher, peak = Matcher(reference.grey, settings), Peak(reference.grey.shape)
    rays = reference.camera.rays()
    sights = [_Sight(rays, reference.camera.center_in_world, view) for view in neighbours]
    middle = guess.normals.depth(reference.camera, guess.offset_m).astype(np.float32)
    with np.errstate(divide="ignore"):
        step = (guess.step_m / guess.normals.offset_per_metre(reference.camera)).astype(np.float32)
    for number in range(-_REACH, _REACH + 1):
        depth = middle + np.float32(number) * step
        score = matcher(sight.shown(depth) for sight in sights)
        score[~(depth > 0)] = UNSEEN
        peak.add(score)
    found = peak.found()
    offset = guess.offset_m + (found.place - _REACH) * guess.step_m
    refined = sweep_result(found, guess.normals, offset, guess.step_m)
    return replace(refined, score=np.where(found.inner, refined.score, np.float32(UNSEEN)))


class _Sight:
    """What a neighbour shows along rays (H, W, 3) from a centre (3,), at any depth of each."""

    def __init__(self, rays: FloatArray, center_in_world: FloatArray, other: StereoView) -> None:
        pixel_from_world = calibration(other.camera.pinhole) @ other.camera.cam_from_world
        by_depth = (rays @ pixel_from_world.T).astype(np.float32)
        self._by_depth = [np.ascontiguousarray(by_depth[..., axis]) for axis in range(3)]
        start = pixel_from_world @ (center_in_world - other.camera.center_in_world)
        self._start = start.astype(np.float32)
        self._grey = other.grey
        self._place = [np.empty_like(by_depth) for by_depth in self._by_depth]

    def shown(self, depth: Float32Array) -> Float32Array:
        """Picture (H, W) of the neighbour; 0 where it shows nothing of depths (H, W)."""
        for place, by_depth, start in zip(self._place, self._by_depth, self._start, strict=True):
            np.add(np.multiply(depth, by_depth, out=place), start, out=place)
        x, y, z = self._place
        behind = ~(z > _LEAST_DEPTH)
        z[behind] = 1.0
        x /= z
        y /= z
        x[behind] = _OUTSIDE
        y[behind] = _OUTSIDE
        found = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(found, np.float32)
