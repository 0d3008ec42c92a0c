"""The rasteriser in plain torch, as close to the equations as it gets: the oracle of the fast ones.

Dense (every Gaussian at every pixel), in the dtype of its inputs, differentiated by autograd. For tests and
small images only: memory grows as Gaussians × pixels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.raster.api import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    Pinhole,
    RasterSettings,
    Render,
    ScreenStats,
)

# How far outside the image, in half widths, the projection is still linearised at the point itself.
FRUSTUM_MARGIN = 0.3


def render_reference(
    gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
) -> Render:
    """Render as `Rasterizer.render` does, by autograd through dense tensors.

    Args:
        gaussians: N Gaussians, float32 or float64.
        cam_from_model: (4, 4) in the same dtype.
        camera: the image.
        settings: how to render.

    Returns:
        The view, in the dtype of the Gaussians.
    """
    dtype = gaussians.means.dtype
    pose = cam_from_model.to(dtype)
    mean_in_cam = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    front = torch.nonzero(mean_in_cam[:, 2] >= settings.near_m).squeeze(1)
    front = front[torch.argsort(mean_in_cam[front, 2].detach(), stable=True)]
    sorted_gaussians, mean_in_cam = gaussians.select(front), mean_in_cam[front]

    mean_px, cov_px2 = project(sorted_gaussians, mean_in_cam, pose, camera, settings.dilation_px2)
    colours = view_colours(sorted_gaussians, pose, settings.sh_degree)
    alpha = _alpha(mean_px, cov_px2, torch.sigmoid(sorted_gaussians.logit_opacities), camera)

    after = torch.cumprod(1 - alpha, dim=0)
    counted = after > TRANSMITTANCE_MIN
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = torch.where(counted, alpha * before, 0.0)
    final = torch.where(counted, 1 - alpha, 1.0).prod(dim=0)
    background = torch.tensor(settings.background, dtype=dtype)
    colour = torch.einsum("gp,gc->pc", weight, colours) + final[:, None] * background
    size = (camera.height, camera.width)
    expected, median = None, None
    if settings.depth:
        depth = mean_in_cam[:, 2]
        opaque = final < 1
        expected = torch.where(opaque, (depth @ weight) / torch.where(opaque, 1 - final, 1.0), 0.0).view(size)
        median = _median_depth(depth, before, after, counted).view(size)
    stats = _screen_stats(front, mean_px, cov_px2, sorted_gaussians.logit_opacities, camera)
    return Render(colour.view(*size, 3), (1 - final).view(size), expected, median, stats)


def project(
    gaussians: Gaussians, mean_in_cam: Tensor, cam_from_model: Tensor, camera: Pinhole, dilation_px2: float
) -> tuple[Tensor, Tensor]:
    """Screen means (N, 2) in px and dilated screen covariances (N, 2, 2) in px².

    The perspective is linearised at the centre (EWA, doi 10.1109/TVCG.2002.1021576), but no further out than
    `FRUSTUM_MARGIN` beyond the image, as in gsplat.
    """
    x, y, z = mean_in_cam.unbind(-1)
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    slope_x = (x / z).clamp(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    slope_y = (y / z).clamp(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / z, zero, -camera.fx * slope_x / z, zero, camera.fy / z, -camera.fy * slope_y / z], dim=-1
    ).view(-1, 2, 3)
    axes = rotation_matrices(gaussians.quats_wxyz) * torch.exp(gaussians.log_scales)[:, None, :]
    screen_axes = jacobian @ cam_from_model[:3, :3] @ axes
    cov_px2 = screen_axes @ screen_axes.mT + dilation_px2 * torch.eye(2, dtype=z.dtype)
    mean_px = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    return mean_px, cov_px2


def view_colours(gaussians: Gaussians, cam_from_model: Tensor, sh_degree: int) -> Tensor:
    """(N, 3) colours of the Gaussians seen from the camera's centre, not negative."""
    center_in_model = -torch.linalg.solve(cam_from_model[:3, :3], cam_from_model[:3, 3])
    return (sh.evaluate(gaussians.sh, gaussians.means - center_in_model, sh_degree) + 0.5).clamp_min(0.0)


def _alpha(mean_px: Tensor, cov_px2: Tensor, opacity: Tensor, camera: Pinhole) -> Tensor:
    """(N, H·W) opacity of each Gaussian at each pixel centre, cut off below ALPHA_MIN and above ALPHA_MAX."""
    v, u = torch.meshgrid(
        torch.arange(camera.height, dtype=mean_px.dtype) + 0.5,
        torch.arange(camera.width, dtype=mean_px.dtype) + 0.5,
        indexing="ij",
    )
    dx, dy = u.reshape(1, -1) - mean_px[:, :1], v.reshape(1, -1) - mean_px[:, 1:]
    xx, xy, yy = cov_px2[:, 0, 0, None], cov_px2[:, 0, 1, None], cov_px2[:, 1, 1, None]
    sigma = 0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    alpha = opacity[:, None] * torch.exp(-sigma)
    return torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), 0.0)


def _median_depth(depth: Tensor, before: Tensor, after: Tensor, counted: Tensor) -> Tensor:
    """(P,) z of the Gaussian at which the transmittance of each of P pixels falls to one half, else 0."""
    crossing = counted & (before > 0.5) & (after <= 0.5)
    return torch.where(crossing, depth.detach()[:, None], 0.0).sum(dim=0)


def _screen_stats(
    rows: Tensor, mean_px: Tensor, cov_px2: Tensor, logit_opacities: Tensor, camera: Pinhole
) -> ScreenStats:
    with torch.no_grad():
        # alpha ≥ ALPHA_MIN is an ellipse: 2 ln(opacity / ALPHA_MIN) is its squared Mahalanobis radius.
        level = 2 * (torch.nn.functional.logsigmoid(logit_opacities) - math.log(ALPHA_MIN))
        extent = torch.sqrt(level.clamp_min(0)[:, None] * torch.diagonal(cov_px2, dim1=1, dim2=2))
        size = torch.tensor([camera.width, camera.height], dtype=mean_px.dtype)
        first = torch.ceil(mean_px - extent - 0.5).clamp_min(0)
        last = torch.minimum(torch.floor(mean_px + extent - 0.5), size - 1)
        seen = (level >= 0) & (first <= last).all(dim=1)
        order = torch.argsort(rows[seen])
        radius = 3 * torch.sqrt(torch.linalg.eigvalsh(cov_px2[seen])[:, 1])
    stats = ScreenStats(visible=rows[seen][order], radius_px=radius[order].float())
    if mean_px.requires_grad:

        def keep_gradient(gradient: Tensor) -> None:
            stats.mean_gradient = gradient[seen][order].float()

        mean_px.register_hook(keep_gradient)
    return stats
