"""Random scenes in front of a random camera."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Render

Scene = tuple[Gaussians, Tensor]


def random_scene(count: int, *, seed: int = 0, degree: int = 3, log_scale: float = -2.0) -> Scene:
    """Return Gaussians (float64) at depths 2 to 8 m, some outside the image, and a camera off the origin."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    depth = 2 + 6 * torch.rand(count, 1, generator=random, dtype=torch.float64)
    across = (torch.rand(count, 2, generator=random, dtype=torch.float64) - 0.5) * 1.4 * depth
    pose = torch.eye(4, dtype=torch.float64)
    turn = normal(3, 3)
    pose[:3, :3] = torch.linalg.matrix_exp(0.5 * (turn - turn.T))
    pose[:3, 3] = normal(3)
    gaussians = Gaussians(
        means=(torch.cat([across, depth], dim=1) - pose[:3, 3]) @ pose[:3, :3],
        quats_wxyz=normal(count, 4),
        log_scales=log_scale + 0.5 * normal(count, 3),
        logit_opacities=2 * normal(count),
        sh=0.3 * normal(count, (degree + 1) ** 2, 3),
    )
    return gaussians, pose


def as_leaves(scene: Scene, dtype: torch.dtype) -> Scene:
    """Return a copy in `dtype` that collects gradients; the pose stays float64, as in training."""
    gaussians, pose = scene
    tensors = [tensor.detach().to(dtype).requires_grad_() for tensor in gaussians.tensors().values()]
    return Gaussians(*tensors), pose.detach().clone().requires_grad_()


def weighted_loss(render: Render, *, seed: int = 0) -> Tensor:
    """Return a loss to which every pixel of every differentiable image contributes with its own random weight."""
    random = torch.Generator().manual_seed(seed)
    loss = torch.zeros((), dtype=torch.float64)
    for image in (render.colour, render.alpha, render.expected_depth, render.depth_variance, render.normal):
        if image is not None:
            loss = loss + (image * torch.randn(image.shape, generator=random, dtype=torch.float64)).sum()
    return loss


@pytest.fixture
def camera() -> Pinhole:
    """Return a camera off centre, whose image is no multiple of the tile in either direction."""
    return Pinhole(width=70, height=45, fx=60.0, fy=58.0, cx=36.0, cy=21.0)


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    return random_scene


@pytest.fixture
def leaves() -> Callable[[Scene, torch.dtype], Scene]:
    return as_leaves


@pytest.fixture
def loss_of() -> Callable[..., Tensor]:
    return weighted_loss
