"""Depth to read off a render: which of its depths to measure in, and that at a ray."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from pipelines.geometry.cameras import Pinhole

_SOLID = 0.5  # of the opacity: below, there is no surface yet
_ONE_SURFACE = 0.003  # of the depth, that what lies on one surface spreads over


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


def measured_depth(median_m: Tensor, expected_m: Tensor, variance_m2: Tensor) -> Tensor:
    """Depth (H, W) to measure in, 0 where there is no surface, of a render's depths and their variance.

    The median says which surface a pixel shows, through whatever haze there is before and behind it; where all that
    is seen lies on one surface, the mean is the less noisy of the two.
    """
    one_surface = variance_m2 < (_ONE_SURFACE * median_m).square()
    return torch.where(one_surface, expected_m, median_m)
