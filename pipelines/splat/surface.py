"""Surfaces in a splat: losses that make Gaussians lie on them, discs that are one, and the depth to measure in.

1. The rendered depth is compared with the depth of the points that a view observes (as in DS-NeRF,
   doi 10.1109/CVPR52688.2022.01254).
2. Each Gaussian is flattened towards a disc (as in PGSR, doi 10.1109/TVCG.2024.3494046, eq. 1).
3. The normals of the discs are compared with the normals of the rendered depth (2D Gaussian Splatting,
   doi 10.1145/3641519.3657428, eq. 14).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Render
from pipelines.splat.sh import coefficient_count, sh_from_rgb

# In spacings. Wider discs hide more of the places behind them, so that a reader of depths meets a centre too near.
# Narrower ones leave gaps. Between four discs, the transmittance is (1 − 0.9 exp(−1/4 / 0.5²))⁴ = 0.2.
_SIGMA = 0.5
_THICKNESS = 0.05  # in spacings
_OPACITY = 0.9


def surface_discs(
    point_in_model: FloatArray, normal_in_model: FloatArray, rgb: ByteArray, spacing_m: float, sh_degree: int
) -> Gaussians:
    """Return a disc of one colour (P, 3) at each point (P, 3) of a surface, about `spacing_m` apart.

    Normals are unit vectors (P, 3); harmonics above degree 0 are zero.
    """
    count = len(point_in_model)
    aside = np.eye(3)[np.abs(normal_in_model).argmin(axis=1)]
    first = np.cross(aside, normal_in_model)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal_in_model, first), normal_in_model], axis=2)
    sh = torch.zeros(count, coefficient_count(sh_degree), 3)
    sh[:, 0] = sh_from_rgb(torch.from_numpy(rgb).float() / 255)
    sigmas_m = spacing_m * np.array([_SIGMA, _SIGMA, _THICKNESS])
    return Gaussians(
        means=torch.from_numpy(point_in_model).float(),
        quats_wxyz=torch.from_numpy(np.roll(quat_xyzw_from_matrix(axes), 1, axis=1)).float(),
        log_scales=torch.from_numpy(np.log(sigmas_m)).float().repeat(count, 1),
        logit_opacities=torch.full((count,), float(np.log(_OPACITY / (1 - _OPACITY)))),
        sh=sh,
    )


_SOLID = 0.5  # least opacity of a surface
_ONE_SURFACE = 0.003  # of the depth: largest spread of the Gaussians of one surface


def depth_at(depth_m: Tensor, alpha: Tensor, xy: Tensor, camera: Pinhole) -> tuple[Tensor, Tensor]:
    """Return depths (K,) at rays, and whether they count (K,), as 0 and 1, of a render's depth and alpha (H, W).

    The rays are x/z and y/z (K, 2) in the camera of H × W pixels. Depths are bilinear between pixel centres, and
    differentiable. Rays outside the image or through pixels without a surface do not count.
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


def measured_depth(view: Render) -> Tensor:
    """Return the depth (H, W) to measure in, 0 without a surface, of a render with depth.

    The median selects the surface that a pixel shows, whatever haze lies before and behind it. If all Gaussians of
    the pixel lie on one surface, the mean is less noisy than the median.
    """
    assert view.median_depth is not None and view.expected_depth is not None and view.depth_variance is not None
    one_surface = view.depth_variance < (_ONE_SURFACE * view.median_depth).square()
    return torch.where(one_surface, view.expected_depth, view.median_depth)


_SPREAD = 0.005  # of the depth: the loss of a smaller spread grows with its square
_NEAR = 0.002  # of the depth
_FIRMNESS = 9.0  # additional slope of the loss of depths that near to their point


@dataclass(frozen=True)
class SurfaceSettings:
    """Weights of the losses."""

    depth: float = 1.0  # of the mean relative difference of depth at the points of the surface, see `depth_loss`
    compactness: float = 0.01  # of the logarithm that bounds the loss of haze before and behind a surface
    flatness: float = 1.0  # of the mean smallest standard deviation, in scene extents
    normals: float = 0.01  # of the depth–normal consistency
    normals_from: float = 0.5  # fraction of the training from which it counts
    normals_every: int = 4  # iterations between two that count it, by which its weight is multiplied
    # depth steps between neighbouring pixels above this fraction of the depth are edges, without a normal
    edge: float = 0.05


@dataclass(frozen=True)
class ObservedPoints:
    """Points (K, 3) that a view observes, and their weights (K,) in the depth loss; None: 1."""

    point_in_model: Tensor
    weight: Tensor | None = None


def depth_loss(
    depth_m: Tensor, alpha: Tensor, points: ObservedPoints, cam_from_model: Tensor, camera: Pinhole
) -> Tensor:
    """Return the mean of w (r + F s (1 − exp(−r/s))), r = |z_rendered / z − 1|, over points that the view observes.

    1. Gaussians are blended in the order of their centres. On a slanted surface the nearer Gaussians hide the
       others. A surface behind the true one, by a part of the Gaussians' size, then matches the photographs best.
    2. Within s of a point its loss is 1 + F times as steep as further away, and withstands that bias.
    3. Further away the point is more likely to be wrong, and the photographs prevail.

    Points outside the image do not count, nor do points where the render is nearly transparent: there is no surface
    yet. The pose (4, 4) gets no gradient, because cameras must not follow the surface.
    """
    pose = cam_from_model.detach()
    in_cam = points.point_in_model @ pose[:3, :3].T + pose[:3, 3]
    z = in_cam[:, 2].clamp_min(1e-3)
    rendered_m, seen = depth_at(depth_m, alpha, in_cam[:, :2] / z[:, None], camera)
    counts = seen * (in_cam[:, 2] > 1e-3)
    off = (rendered_m / z - 1).abs()
    loss = off + _FIRMNESS * _NEAR * (1 - torch.exp(-off / _NEAR))
    loss = loss if points.weight is None else points.weight * loss
    return (loss * counts).sum() / counts.sum().clamp_min(1)


def compactness_loss(depth_m: Tensor, variance_m2: Tensor, alpha: Tensor) -> Tensor:
    """Return the mean of α ln(1 + σ²/s²), σ the spread of depth in a pixel, and s a two-hundredth of the depth.

    The mean depth can be right in a haze without any surface: the spread cannot. The logarithm bounds the loss of
    pixels at edges, which rightly show surfaces before and behind the edge.
    """
    allowed = (_SPREAD * depth_m.detach()).clamp_min(1e-6)
    return (alpha.detach() * torch.log1p(variance_m2 / allowed.square())).mean()


def flatness_loss(gaussians: Gaussians, visible: Tensor, extent_m: float) -> Tensor:
    """Return the mean smallest standard deviation of the visible Gaussians, in scene extents; 0 if none is."""
    # A mask: the gradient of an index is added up row after row.
    counts = torch.zeros_like(gaussians.log_scales[:, 0])
    counts[visible] = 1
    smallest = gaussians.log_scales.amin(dim=1).exp()
    return (smallest * counts).sum() / (max(len(visible), 1) * extent_m)


def depth_normals(depth_m: Tensor, camera: Pinhole) -> Tensor:
    """Return normals (H − 1, W − 1, 3) in `cam`, towards the camera, of a depth map (H, W) along z."""
    v, u = torch.meshgrid(
        torch.arange(camera.height, device=depth_m.device) + 0.5,
        torch.arange(camera.width, device=depth_m.device) + 0.5,
        indexing="ij",
    )
    point = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], dim=-1)
    point = point * depth_m[..., None]
    right, down = point[:-1, 1:] - point[:-1, :-1], point[1:, :-1] - point[:-1, :-1]
    return functional.normalize(torch.linalg.cross(down, right), dim=-1)


def normal_loss(render: Render, cam_from_model: Tensor, camera: Pinhole, edge: float) -> Tensor:
    """Return the mean of α · (1 − n · n_depth) over the pixels that are not at a depth edge.

    The render has depth and normals; the pose (4, 4) gets no gradient by the turn of its normals.
    """
    depth, alpha = render.expected_depth, render.alpha
    assert depth is not None and render.normal is not None
    blended = render.normal[:-1, :-1] @ cam_from_model[:3, :3].detach().T.to(depth.dtype)
    # Pixels that lie on one surface with their neighbours to the right and below.
    z, solid = depth.detach(), alpha.detach() > _SOLID
    step = torch.maximum((z[:-1, 1:] - z[:-1, :-1]).abs(), (z[1:, :-1] - z[:-1, :-1]).abs())
    on_one = (step < edge * z[:-1, :-1]) & solid[:-1, :-1] & solid[:-1, 1:] & solid[1:, :-1]
    smooth = on_one.to(depth.dtype)
    agreement = (blended * depth_normals(depth, camera)).sum(dim=-1)
    return ((alpha[:-1, :-1] - agreement) * smooth).sum() / smooth.sum().clamp_min(1)
