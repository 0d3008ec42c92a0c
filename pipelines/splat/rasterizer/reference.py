"""Rasteriser in plain torch, as close to the equations as possible: the oracle of the fast backends.

Every Gaussian is evaluated at every pixel, in the dtype of the inputs, and differentiated by autograd. Use it for
tests and small images only: memory grows as Gaussians × pixels.
"""

import math

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.rasterizer.api import (
    ALPHA_MAX,
    ALPHA_MIN,
    DEPTH_REACH,
    SLOPE_DILATION,
    TRANSMITTANCE_MIN,
    RasterSettings,
    Render,
    ScreenStats,
)

# Margin around the image, in half widths, within which the projection is linearised at the point itself.
FRUSTUM_MARGIN = 0.3


def render_reference(
    gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
) -> Render:
    """Render N Gaussians as `Rasterizer.render` does, in their dtype, by autograd through dense tensors."""
    dtype = gaussians.means.dtype
    pose = cam_from_model.to(dtype)
    mean_in_cam = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    front = torch.nonzero(mean_in_cam[:, 2] >= settings.near_m).squeeze(1)
    front = front[torch.argsort(mean_in_cam[front, 2].detach(), stable=True)]
    sorted_gaussians, mean_in_cam = gaussians.select(front), mean_in_cam[front]

    mean_px, cov_px2 = project_gaussians(sorted_gaussians, mean_in_cam, pose, camera, settings.dilation_px2)
    colours = view_colours(sorted_gaussians, pose, settings.sh_degree)
    rows, columns = (torch.arange(count, dtype=dtype) + 0.5 for count in (camera.height, camera.width))
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    offset_px = torch.stack([u.reshape(-1), v.reshape(-1)], dim=-1) - mean_px[:, None]
    opacity = torch.sigmoid(sorted_gaussians.logit_opacities)
    if settings.mip_filter:
        opacity = opacity * compensation(cov_px2, settings.dilation_px2)
    alpha = _alpha(offset_px, cov_px2, opacity)

    after = torch.cumprod(1 - alpha, dim=0)
    counted = after > TRANSMITTANCE_MIN
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = torch.where(counted, alpha * before, 0.0)
    final = torch.where(counted, 1 - alpha, 1.0).prod(dim=0)
    background = torch.tensor(settings.background, dtype=dtype)
    colour = torch.einsum("gp,gc->pc", weight, colours) + final[:, None] * background
    size = (camera.height, camera.width)
    expected, variance, median = None, None, None
    if settings.depth:
        quats_wxyz, log_scales = sorted_gaussians.quats_wxyz, sorted_gaussians.log_scales
        axes = projected_axes(quats_wxyz, log_scales, mean_in_cam, pose, camera)
        slope = depth_slopes(axes, mean_in_cam[:, 2], settings.dilation_px2)
        depth = mean_in_cam[:, 2:] + (slope[:, None] * offset_px).sum(dim=-1)
        opaque = final < 1
        depth_sum = (depth * weight).sum(dim=0)
        total = torch.where(opaque, 1 - final, 1.0)
        mean = torch.where(opaque, depth_sum / total, 0.0)
        variance = (((depth - mean).square() * weight).sum(dim=0) / total).view(size)
        expected = mean.view(size)
        if settings.median:
            crossing = counted & (before > 0.5) & (after <= 0.5)
            median = torch.where(crossing, depth.detach(), 0.0).sum(dim=0).view(size)
    normal = None
    if settings.normal:
        normal = torch.einsum("gp,gc->pc", weight, facing_normals(sorted_gaussians, pose)).view(*size, 3)
    stats = _screen_stats(front, mean_px, cov_px2, opacity, camera)
    view = Render(colour.view(*size, 3), (1 - final).view(size), stats, expected, variance, median, normal)
    return view if settings.window is None else settings.window.cut(view)


def project_gaussians(
    gaussians: Gaussians, mean_in_cam: Tensor, cam_from_model: Tensor, camera: Pinhole, dilation_px2: float
) -> tuple[Tensor, Tensor]:
    """Return screen means (N, 2) in px and dilated screen covariances (N, 2, 2) in px²."""
    x, y, z = mean_in_cam.unbind(-1)
    axes = projected_axes(gaussians.quats_wxyz, gaussians.log_scales, mean_in_cam, cam_from_model, camera)[:, :2]
    cov_px2 = axes @ axes.mT + dilation_px2 * torch.eye(2, dtype=z.dtype)
    mean_px = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    return mean_px, cov_px2


def compensation(cov_px2: Tensor, dilation_px2: float) -> Tensor:
    """Return the factors (N,) of the opacity that make up for the dilation of screen covariances (N, 2, 2)."""
    xx, xy, yy = cov_px2[:, 0, 0], cov_px2[:, 0, 1], cov_px2[:, 1, 1]
    before = (xx - dilation_px2) * (yy - dilation_px2) - xy * xy
    # A root has no slope at zero: what is seen edge-on is invisible.
    return torch.where(before > 0, before, 1e-12).sqrt() / (xx * yy - xy * xy).sqrt()


def depth_slopes(axes: Tensor, depth: Tensor, dilation_px2: float) -> Tensor:
    """Return ∂z/∂(u, v) of Gaussians (N, 2) in m/px, shortened if z would leave `DEPTH_REACH` of the centre's,
    `depth`.

    By Cauchy and Schwarz |q · d| ≤ √(q · C q) √(d · C⁻¹ d), with C as the image dilates it. The `axes` are those of
    `projected_axes`.
    """
    u, v, z = axes.unbind(dim=1)
    xx, xy, yy, xz, yz = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1), (u * z).sum(-1), (v * z).sum(-1)
    narrow_xx, narrow_yy = xx + SLOPE_DILATION * dilation_px2, yy + SLOPE_DILATION * dilation_px2
    free = torch.stack([narrow_yy * xz - xy * yz, narrow_xx * yz - xy * xz], dim=-1)
    free = free / (narrow_xx * narrow_yy - xy * xy)[:, None]
    x, y = free.unbind(-1)
    spread2 = (xx + dilation_px2) * x * x + 2 * xy * x * y + (yy + dilation_px2) * y * y
    spread_m = torch.sqrt(spread2.clamp_min(torch.finfo(spread2.dtype).tiny))
    most_m = DEPTH_REACH / math.sqrt(-2 * math.log(ALPHA_MIN)) * depth
    return free * (most_m / torch.maximum(spread_m, most_m))[:, None]


def projected_axes(
    quats_wxyz: Tensor, log_scales: Tensor, mean_in_cam: Tensor, cam_from_model: Tensor, camera: Pinhole
) -> Tensor:
    """Return principal axes (N, 3, 3), a standard deviation long, along (u, v, z): an axis a column; px, px and m.

    The perspective is linearised at the centre (EWA, doi 10.1109/TVCG.2002.1021576), but no further out than
    `FRUSTUM_MARGIN` beyond the image, as in gsplat.
    """
    x, y, z = mean_in_cam.unbind(-1)
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    slope_x = (x / z).clamp(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    slope_y = (y / z).clamp(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    rows = [
        camera.fx / z, zero, -camera.fx * slope_x / z,
        zero, camera.fy / z, -camera.fy * slope_y / z,
        zero, zero, one,
    ]  # fmt: skip
    jacobian = torch.stack(rows, dim=-1).view(-1, 3, 3)
    axes = rotation_matrices(quats_wxyz) * torch.exp(log_scales)[:, None, :]
    return jacobian @ cam_from_model[:3, :3] @ axes


def view_colours(gaussians: Gaussians, cam_from_model: Tensor, sh_degree: int) -> Tensor:
    """Return colours (N, 3) of the Gaussians seen from the camera's centre, not negative."""
    center_in_model = -torch.linalg.solve(cam_from_model[:3, :3], cam_from_model[:3, 3])
    return (sh.evaluate_sh(gaussians.sh, gaussians.means - center_in_model, sh_degree) + 0.5).clamp_min(0.0)


def facing_normals(gaussians: Gaussians, cam_from_model: Tensor) -> Tensor:
    """Return unit normals (N, 3) in `model`: the shortest principal axes, on the side of the camera's centre."""
    pose = cam_from_model.detach().to(gaussians.means)
    shortest = gaussians.log_scales.argmin(dim=1)
    rotation = rotation_matrices(gaussians.quats_wxyz)
    normal = rotation.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    ray = gaussians.means.detach() + pose[:3, :3].T @ pose[:3, 3]
    return torch.where(((normal * ray).sum(dim=1) > 0)[:, None], -normal, normal)


def _alpha(offset_px: Tensor, cov_px2: Tensor, opacity: Tensor) -> Tensor:
    """Return opacities (N, H·W) at each pixel centre, cut off below ALPHA_MIN and above ALPHA_MAX."""
    dx, dy = offset_px.unbind(-1)
    xx, xy, yy = cov_px2[:, 0, 0, None], cov_px2[:, 0, 1, None], cov_px2[:, 1, 1, None]
    sigma = 0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    alpha = opacity[:, None] * torch.exp(-sigma)
    return torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), 0.0)


def _screen_stats(rows: Tensor, mean_px: Tensor, cov_px2: Tensor, opacity: Tensor, camera: Pinhole) -> ScreenStats:
    with torch.no_grad():
        # alpha ≥ ALPHA_MIN is an ellipse: 2 ln(opacity / ALPHA_MIN) is its squared Mahalanobis radius.
        level = 2 * (torch.log(opacity) - math.log(ALPHA_MIN))
        extent = torch.sqrt(level.clamp_min(0)[:, None] * torch.diagonal(cov_px2, dim1=1, dim2=2))
        size = torch.tensor([camera.width, camera.height], dtype=mean_px.dtype)
        first = torch.ceil(mean_px - extent - 0.5).clamp_min(0)
        last = torch.minimum(torch.floor(mean_px + extent - 0.5), size - 1)
        seen = (level >= 0) & (first <= last).all(dim=1)
        order = torch.argsort(rows[seen])
    stats = ScreenStats(rows[seen][order])
    if mean_px.requires_grad:

        def keep_gradient(gradient: Tensor) -> None:
            stats.mean_gradient = gradient[seen][order].float()

        mean_px.register_hook(keep_gradient)
    return stats
