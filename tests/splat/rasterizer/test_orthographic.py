"""The orthographic view against a plain sum over Gaussians at every pixel, and against a camera far above."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.rasterizer.api import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.rasterizer.orthographic import PlanSplats, render_orthographic
from pipelines.splat.sh import sh_from_rgb

WIDTH, HEIGHT = 45, 37


def scene(count: int = 60, seed: int = 0) -> tuple[PlanSplats, Gaussians]:
    """Return the same Gaussians over a plane of pixels, depth downwards, and as a splat with x right, y down."""
    random = np.random.default_rng(seed)
    mean = random.uniform([0, 0, 3], [WIDTH, HEIGHT, 30], (count, 3))
    quats, log_scales = random.normal(size=(count, 4)), random.normal(0.5, 0.6, (count, 3))
    opacity, colour = random.uniform(0.1, 0.95, count), random.uniform(0, 1, (count, 3))
    axes = rotation_matrices(torch.from_numpy(quats)).numpy() * np.exp(log_scales)[:, None]
    splats = PlanSplats(mean, axes @ np.swapaxes(axes, 1, 2), opacity, colour)
    gaussians = Gaussians(
        torch.from_numpy(mean),
        torch.from_numpy(quats),
        torch.from_numpy(log_scales),
        torch.logit(torch.from_numpy(opacity)),
        sh_from_rgb(torch.from_numpy(colour))[:, None],
    )
    return splats, gaussians


def plain(splats: PlanSplats, dilation_px2: float) -> tuple[np.ndarray, ...]:
    """Return colour, alpha, expected and median depth, pixel by pixel and Gaussian by Gaussian."""
    colour, depth_sum = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
    transmittance, median = np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))
    for v in range(HEIGHT):
        for u in range(WIDTH):
            for i in np.argsort(splats.mean[:, 2]):
                screen = splats.cov[i, :2, :2] + dilation_px2 * np.eye(2)
                off = np.array([u + 0.5, v + 0.5]) - splats.mean[i, :2]
                alpha = min(splats.opacity[i] * np.exp(-0.5 * off @ np.linalg.solve(screen, off)), ALPHA_MAX)
                if alpha < ALPHA_MIN:
                    continue
                left = transmittance[v, u] * (1 - alpha)
                if left <= TRANSMITTANCE_MIN:
                    break
                z = splats.mean[i, 2] + np.linalg.solve(screen, splats.cov[i, :2, 2]) @ off
                weight = alpha * transmittance[v, u]
                colour[v, u] += weight * splats.colour[i]
                depth_sum[v, u] += weight * z
                if transmittance[v, u] > 0.5 >= left:
                    median[v, u] = z
                transmittance[v, u] = left
    alpha_map = 1 - transmittance
    return colour, alpha_map, depth_sum / np.where(alpha_map > 0, alpha_map, 1), median


def test_it_is_the_plain_sum() -> None:
    splats, _ = scene()
    view = render_orthographic(splats, WIDTH, HEIGHT)
    for image, expected in zip(
        (view.colour, view.alpha, view.expected_depth, view.median_depth), plain(splats, 0.3), strict=True
    ):
        np.testing.assert_allclose(image, expected, rtol=0, atol=1e-6)  # of the kernels' exponential


def test_parts_are_cut_from_the_whole() -> None:
    splats, _ = scene(seed=1)
    whole = render_orthographic(splats, WIDTH, HEIGHT)
    part = render_orthographic(splats, 20, 11, corner=(17.0, 9.0))
    np.testing.assert_allclose(part.colour, whole.colour[9:20, 17:37], rtol=0, atol=1e-9)
    np.testing.assert_allclose(part.median_depth, whole.median_depth[9:20, 17:37], rtol=0, atol=1e-9)


@pytest.mark.parametrize("distance", [1e6])
def test_a_camera_far_above_sees_the_same(distance: float) -> None:
    """The perspective of a camera at a distance d displaces by the height over d: 30/1e6 of 45 px."""
    splats, gaussians = scene(seed=2)
    camera = Pinhole(WIDTH, HEIGHT, distance, distance, WIDTH / 2, HEIGHT / 2)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-WIDTH / 2, -HEIGHT / 2, distance])
    far = CpuRasterizer().render(gaussians, pose, camera, RasterSettings(sh_degree=0, near_m=0.01))
    view = render_orthographic(splats, WIDTH, HEIGHT)
    np.testing.assert_allclose(view.alpha, far.alpha.numpy(), rtol=0, atol=2e-3)
    np.testing.assert_allclose(view.colour, far.colour.numpy(), rtol=0, atol=2e-3)
