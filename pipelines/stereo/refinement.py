"""Refinement of a surface on finer pixels: each pixel compares hypotheses around its own prior only.

The scheme is that of cascaded cost volumes (Gu et al., doi 10.1109/CVPR42600.2020.00257). A window across the edge
of a roof then sees the roof where the roof is, and the ground where the ground is. A sweep of planes takes that
ground for roof.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.core.types import Float32Array
from pipelines.stereo.agreement import DepthEstimate
from pipelines.stereo.matching import UNSEEN, Matcher, MatchSettings, WinnerTakesAll
from pipelines.stereo.sweep import NormalMap, SweepResult, sweep_result
from pipelines.stereo.views import StereoCamera, StereoView

_REACH = 4  # steps on either side of the prior
_STEPS = 3  # for one step of the sweep that the prior is from
_SPECKLE_PX = 5  # parts smaller than half of this are chance where one view alone has depths


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
    matcher, search = Matcher(reference, neighbours, settings), WinnerTakesAll(reference.grey.shape)
    middle = prior.normals.depth(reference.camera, prior.offset_m).astype(np.float32)
    with np.errstate(divide="ignore"):
        step = (prior.step_m / prior.normals.offset_per_metre(reference.camera)).astype(np.float32)
    for number in range(-_REACH, _REACH + 1):
        search.add(matcher(middle + np.float32(number) * step))
    winner = search.winner()
    offset = prior.offset_m + (winner.hypothesis - _REACH) * prior.step_m
    refined = sweep_result(winner, prior.normals, offset, prior.step_m)
    return replace(refined, score=np.where(winner.inner, refined.score, np.float32(UNSEEN)))
