"""Rasteriser on a GPU: gsplat behind the common interface.

gsplat (doi 10.48550/arXiv.2409.06765) blends by the rules of `api`, but has no depth at the pixel. The expected
depth comes from blending the Gaussians' planes, the median depth from gsplat's pixel–Gaussian intersections.
"""

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from pipelines.core.progress import SILENT, Progress
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import ALPHA_MAX, BackendName, RasterSettings, Render, ScreenStats
from pipelines.splat.rasterizer.cuda_kernels import load_gsplat
from pipelines.splat.rasterizer.reference import depth_slopes, facing_normals, projected_axes

_EVERY_BATCH = 2**31 - 1


_Meta = dict[str, Any]  # what gsplat returns beside the image, by its names


class CudaRasterizer:
    """Backend of gsplat ≥ 1.5.3. The tensors must be on the CUDA device.

    Raises:
        BackendUnavailableError: gsplat is missing, or cannot be compiled; `progress` shows the compilation of its
            kernels before their first use on a machine.
    """

    name: BackendName = "cuda"
    device = torch.device("cuda")

    def __init__(self, progress: Progress = SILENT) -> None:
        self._gsplat = load_gsplat(progress)

    def candidates(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> None:
        """See `Rasterizer.candidates`; to count them, the processor would wait for the GPU."""

    def render(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Render:
        """See `Rasterizer.render`; the render and its statistics stay on the device."""
        device, pose = gaussians.means.device, cam_from_model.float()
        image, alpha, meta = self._gsplat.rasterization(
            gaussians.means,
            gaussians.quats_wxyz,
            torch.exp(gaussians.log_scales),
            torch.sigmoid(gaussians.logit_opacities),
            self._colours(gaussians, pose, settings.sh_degree),
            pose[None],
            _row((camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0), device).view(1, 3, 3),
            camera.width,
            camera.height,
            near_plane=settings.near_m,
            eps2d=settings.dilation_px2,
            packed=True,
            rasterize_mode="antialiased" if settings.mip_filter else "classic",
        )
        # gsplat refuses a background for packed Gaussians.
        colour = image[0] + (1 - alpha[0]) * _row(settings.background, device)
        view = Render(colour, alpha[0, ..., 0], _screen_stats(meta))
        if settings.depth:
            slope = _depth_slope(gaussians, cam_from_model, camera, meta, settings.dilation_px2)
            view.expected_depth, view.depth_variance = self._depth_moments(meta, slope, camera, view.alpha)
            view.median_depth = self._median_depth(meta, slope, camera) if settings.median else None
        if settings.normal:
            normals = facing_normals(gaussians.select(meta["gaussian_ids"].long()), cam_from_model)
            view.normal = self._blended(meta, normals, camera)
        return view if settings.window is None else settings.window.cut(view)

    def _colours(self, gaussians: Gaussians, pose: Tensor, degree: int) -> Tensor:
        """Return the colours (N, 3) that Gaussians show to a camera, as gsplat has them.

        gsplat itself takes the camera's place by an index for each Gaussian. The gradient of such an index adds up
        one after the other, and took four fifths of an iteration of a million Gaussians on an H200.
        """
        centre = -pose[:3, :3].T @ pose[:3, 3]
        harmonics = self._gsplat.spherical_harmonics(degree, gaussians.means - centre, gaussians.sh)
        return torch.clamp_min(harmonics + 0.5, 0.0)

    def _depth_moments(self, meta: _Meta, slope: Tensor, camera: Pinhole, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance (H, W) of z = z₀ + q · (p − middle of the image), with the weights of blending.

        The three numbers of each Gaussian are blended, and their six products that make z². Planes are stated about
        the middle of the image: their depths at (0, 0) can be far from those in their pixels.
        """
        middle = 0.5 * _row((float(camera.width), float(camera.height)), slope.device)
        z = meta["depths"] + (slope * (middle - meta["means2d"])).sum(dim=-1)
        by_u, by_v = slope.unbind(-1)
        of_square = (z * z, 2 * z * by_u, 2 * z * by_v, by_u * by_u, 2 * by_u * by_v, by_v * by_v)
        planes = self._blended(meta, torch.stack([z, by_u, by_v, *of_square], dim=-1), camera)
        u = torch.arange(camera.width, device=slope.device) + 0.5 * (1 - camera.width)
        v = (torch.arange(camera.height, device=slope.device) + 0.5 * (1 - camera.height))[:, None]
        z, by_u, by_v, zz, zu, zv, uu, uv, vv = planes.unbind(-1)
        total = alpha.clamp(min=1e-10)
        mean = (z + by_u * u + by_v * v) / total
        square = (zz + zu * u + zv * v + uu * u * u + uv * u * v + vv * v * v) / total
        return mean, (square - mean.square()).clamp_min(0.0)

    def _blended(self, meta: _Meta, values: Tensor, camera: Pinhole) -> Tensor:
        """Return values (M, C) of the visible Gaussians, blended to (H, W, C) with the weights of the render."""
        image, _ = self._gsplat.rasterize_to_pixels(
            meta["means2d"],
            meta["conics"],
            values,
            meta["opacities"],
            camera.width,
            camera.height,
            meta["tile_size"],
            meta["isect_offsets"],
            meta["flatten_ids"],
            packed=True,
        )
        blended: Tensor = image[0]
        return blended

    @torch.no_grad()
    def _median_depth(self, meta: _Meta, slope: Tensor, camera: Pinhole) -> Tensor:
        """Return z (H, W) of the Gaussian at which the transmittance falls to one half, 0 if it stays higher."""
        means_px, conics, opacities = meta["means2d"], meta["conics"], meta["opacities"]
        median = torch.zeros(camera.height * camera.width, device=means_px.device)
        if len(means_px) == 0:
            return median.view(camera.height, camera.width)
        # The intersections come grouped by pixel, nearest first.
        gaussian, pixel, _ = self._gsplat.rasterize_to_indices_in_range(
            0,
            _EVERY_BATCH,
            torch.ones((1, camera.height, camera.width), device=means_px.device),
            means_px[None],
            conics[None],
            opacities[None],
            camera.width,
            camera.height,
            meta["tile_size"],
            meta["isect_offsets"],
            meta["flatten_ids"],
        )
        dx = means_px[gaussian, 0] - (pixel % camera.width + 0.5)
        dy = means_px[gaussian, 1] - (pixel // camera.width + 0.5)
        xx, xy, yy = conics[gaussian].unbind(-1)
        sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alpha = (opacities[gaussian] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
        log_kept = torch.cumsum(torch.log1p(-alpha.double()), dim=0)
        count = torch.bincount(pixel, minlength=len(median))
        start = torch.cumsum(count, dim=0) - count
        before_pixel = torch.cat([log_kept.new_zeros(1), log_kept])[start[pixel]]
        half = torch.log(log_kept.new_tensor(0.5))
        reached = log_kept - before_pixel <= half
        first = reached.clone()
        first[1:] &= ~(reached[:-1] & (pixel[1:] == pixel[:-1]))
        at = torch.nonzero(first)[:, 0]
        front, to_mean_px = gaussian[at], torch.stack([dx[at], dy[at]], dim=-1)
        median[pixel[at]] = meta["depths"][front] - (slope[front] * to_mean_px).sum(dim=-1)
        return median.view(camera.height, camera.width)


# Small constants are made once: every copy to the device waits for all work that is queued there.
@lru_cache(maxsize=4096)
def _row(values: tuple[float, ...], device: torch.device) -> Tensor:
    # numpy's numbers, of cameras that COLMAP read, would make float64, which the kernels refuse.
    return torch.tensor([values], dtype=torch.float32, device=device)


def _depth_slope(
    gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, meta: _Meta, dilation_px2: float
) -> Tensor:
    """Return ∂z/∂(u, v) of the M visible Gaussians (M, 2), in m/px."""
    rows, pose = meta["gaussian_ids"].long(), cam_from_model.to(gaussians.means.dtype)
    mean_in_cam = gaussians.means[rows] @ pose[:3, :3].T + pose[:3, 3]
    axes = projected_axes(gaussians.quats_wxyz[rows], gaussians.log_scales[rows], mean_in_cam, pose, camera)
    return depth_slopes(axes, meta["depths"], dilation_px2)


def _screen_stats(meta: _Meta) -> ScreenStats:
    means_px = meta["means2d"]
    stats = ScreenStats(meta["gaussian_ids"].long())
    if means_px.requires_grad:

        def keep_gradient(gradient: Tensor) -> None:
            stats.mean_gradient = gradient

        means_px.register_hook(keep_gradient)
    return stats
