"""Control points through the rendered depth: each image mark is projected onto the Gaussians' surface."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.adjust.estimate import TensorSimilarity


@dataclass(frozen=True)
class ControlByDepth:
    """Image marks of the control points, K in all, each projected onto the rendered surface on its own.

    Attributes:
        camera: (K,) int64 index into the cameras.
        xy: (K, 2) float64, x/z and y/z of the marks' rays.
        position_in_geo: (K, 3) float64 metres, surveyed.
        root_information: (K, 3, 3) float64 of survey, mark and surface together, in 1/m.
        share: (K,) float64, one over the number of marks of the same point.
        views: number of training views, all rendered equally often.
        rows: slice of the K marks, by camera.
        xy_by_lens: (K, 2, L) float64, derivative of `xy` by the lens parameters, as in `ControlTerm`.
    """

    camera: Tensor
    xy: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    share: Tensor
    views: int
    rows: dict[int, slice]
    xy_by_lens: Tensor | None = None

    def rays(self, rows: slice, lens: Tensor) -> Tensor:
        """Return the rays x/z and y/z (K', 2) of a slice of the marks, to first order in the lens change (L,)."""
        if self.xy_by_lens is None or not len(lens):
            return self.xy[rows]
        return self.xy[rows] + self.xy_by_lens[rows] @ lens


def depth_residuals(
    pose: tuple[Tensor, Tensor],
    geo_from_model: TensorSimilarity,
    position_in_geo: Tensor,
    xy: Tensor,
    depth_m: Tensor,
) -> Tensor:
    """Return T(c_i + R_iᵀ z (x, y, 1)) − X_j (K, 3) in metres, of the K marks of one camera.

    Args:
        pose: rotation cam ← model (3, 3) and centre (3,) of that camera.
        geo_from_model: the similarity T.
        position_in_geo: (K, 3) metres, surveyed, of each mark.
        xy: (K, 2) x/z and y/z of the marks' rays.
        depth_m: (K,) rendered depth along the camera's z axis at the marks.
    """
    rotation, center = pose
    ray = torch.nn.functional.pad(xy, (0, 1), value=1.0)
    point = center + (depth_m[:, None] * ray) @ rotation
    return geo_from_model.apply(point) - position_in_geo
