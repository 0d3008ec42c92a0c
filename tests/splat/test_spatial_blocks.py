"""Blocks of Gaussians: a window that is rendered from the chosen ones is that of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings, Window
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.spatial import SpatialBlocks

CAMERA = Pinhole(160, 120, 130.0, 125.0, 70.0, 66.0)


def scattered(count: int, seed: int) -> Gaussians:
    """Return Gaussians before, behind and beside the camera; sizes differ by a factor of 1000."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    return Gaussians(
        means=normal(count, 3) * torch.tensor([8.0, 8.0, 12.0]),
        quats_wxyz=normal(count, 4),
        log_scales=-3.0 + 1.5 * normal(count, 1) + 0.5 * normal(count, 3),
        logit_opacities=3 * normal(count),
        sh=0.3 * normal(count, 4, 3),
    )


@pytest.mark.parametrize("seed", range(4))
def test_chosen_gaussians_hold_all_that_a_window_shows(seed: int) -> None:
    gaussians, rng = scattered(5000, seed), np.random.default_rng(seed)
    gaussians.means[7] = torch.nan  # shows nowhere
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), rng.standard_normal(3)
    blocks, backend = SpatialBlocks(gaussians), CpuRasterizer()
    matrix = torch.as_tensor(pose, dtype=torch.float32)
    for window in (Window(0, 0, 3, 3), Window(80, 60, 5, 4), Window(157, 118, 3, 2), None):
        settings = RasterSettings(sh_degree=1, depth=True, window=window)
        chosen = blocks.in_view(pose, CAMERA, settings)
        visible = backend.render(gaussians, matrix, CAMERA, settings).stats.visible
        among_chosen = (gaussians.means[visible][:, None] == chosen.means).all(dim=2).any(dim=1)
        assert among_chosen.all()


def test_few_of_many_are_chosen_where_gaussians_are_small() -> None:
    gaussians = scattered(100_000, 9)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales.clamp(max=-4.0))
    chosen = SpatialBlocks(gaussians).in_view(np.eye(4), CAMERA, RasterSettings(window=Window(80, 60, 3, 3)))
    # The 782 blocks fill a volume: each is a tenth of it wide, and the line of sight meets some tens of them.
    assert 0 < len(chosen) < 0.15 * len(gaussians)


def test_no_gaussians() -> None:
    blocks = SpatialBlocks(scattered(0, 0))
    assert len(blocks.in_view(np.eye(4), CAMERA, RasterSettings())) == 0
