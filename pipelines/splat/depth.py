"""Depth of a render: choice of the depth map to measure in, and sampling of it at rays."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from pipelines.geometry.cameras import Pinhole

_SOLID = 0.5  # least opacity of a surface
_ONE_SURFACE = 0.003  # of the depth: largest spread of the Gaussians of one surface


def depth_at(depth_m: Tensor, alpha: Tensor, xy: Tensor, camera: Pinhole) -> tuple[Tensor, Tensor]:
    """Return depths (K,) at rays, and whether they count (K,), as 0 and 1.

    Depths are bilinear between pixel centres, and differentiable. Rays outside the image or through pixels without
    a surface do not count.

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
    sampled = functional.grid_sample(
        maps, place.to(maps.dtype)[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].to(xy.dtype)
    seen = ((place.abs() < 1).all(dim=1) & (sampled[1] > _SOLID)).to(xy.dtype)
    return sampled[0], seen


def measured_depth(median_m: Tensor, expected_m: Tensor, variance_m2: Tensor) -> Tensor:
    """Return the depth (H, W) to measure in, 0 without a surface.

    The median selects the surface that a pixel shows, whatever haze lies before and behind it. If all Gaussians of
    the pixel lie on one surface, the mean is less noisy than the median.

    Args:
        median_m, expected_m: (H, W) depths of a render.
        variance_m2: (H, W) of its depth.
    """
    one_surface = variance_m2 < (_ONE_SURFACE * median_m).square()
    return torch.where(one_surface, expected_m, median_m)
