"""Depth of a render at image marks."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from pipelines.geometry.cameras import Pinhole

_SOLID = 0.5  # of the opacity: below, there is no surface yet


def depth_at(depth_m: Tensor, alpha: Tensor, xy: Tensor, camera: Pinhole) -> tuple[Tensor, Tensor]:
    """Depths (K,) at rays, bilinear between pixel centres and differentiable; and which count (K,), as 0 and 1.

    Args:
        depth_m: (H, W) expected depth, along the camera's z axis.
        alpha: (H, W).
        xy: (K, 2) x/z and y/z of the rays.
        camera: of H × W pixels.
    """
    x = (camera.fx * xy[:, 0] + camera.cx) / camera.width
    y = (camera.fy * xy[:, 1] + camera.cy) / camera.height
    place = 2 * torch.stack([x, y], dim=1) - 1
    maps = torch.stack([depth_m, alpha.detach()])[None]
    found = functional.grid_sample(
        maps, place.to(maps.dtype)[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].to(xy.dtype)
    seen = ((place.abs() < 1).all(dim=1) & (found[1] > _SOLID)).to(xy.dtype)
    return found[0], seen
