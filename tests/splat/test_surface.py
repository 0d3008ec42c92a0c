"""Surface losses: zero on a surface, and downhill towards one."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings, Render
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.rasterizer.reference import facing_normals
from pipelines.splat.surface import (
    ObservedPoints,
    compactness_loss,
    depth_loss,
    depth_normals,
    flatness_loss,
    normal_loss,
)

CAMERA = Pinhole(48, 36, 40.0, 40.0, 24.0, 18.0)
POSE = torch.eye(4)


def wall(tilt_rad: float, thickness_m: float = 0.01, disc_tilt_rad: float | None = None) -> Gaussians:
    """Return opaque discs on a plane 5 m ahead, turned about the vertical; the discs may have another turn."""
    grid = torch.linspace(-4, 4, 33)
    u, v = (axis.reshape(-1) for axis in torch.meshgrid(grid, grid, indexing="ij"))
    turned = tilt_rad if disc_tilt_rad is None else disc_tilt_rad
    return Gaussians(
        torch.stack([u * math.cos(tilt_rad), v, 5 - u * math.sin(tilt_rad)], dim=1),
        torch.tensor([math.cos(turned / 2), 0.0, math.sin(turned / 2), 0.0]).repeat(len(u), 1),
        torch.tensor([0.25, 0.25, thickness_m]).log().repeat(len(u), 1),
        torch.full((len(u),), 3.0),
        torch.zeros(len(u), 1, 3),
    )


@pytest.mark.parametrize("tilt", [0.0, 0.5, -0.8])
def test_normals_of_a_plane_are_those_of_its_depth_and_of_its_discs(tilt: float) -> None:
    true = torch.tensor([-math.sin(tilt), 0.0, -math.cos(tilt)])
    assert float((facing_normals(wall(tilt), POSE) - true).abs().max()) < 1e-5
    v, u = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(48) + 0.5, indexing="ij")
    ray = torch.stack([(u - 24) / 40, (v - 18) / 40, torch.ones_like(u)], dim=-1)
    depth = 5 * math.cos(tilt) / (ray @ -true)
    assert float((depth_normals(depth, CAMERA) - true).abs().max()) < 1e-3


def loss_of_normals(gaussians: Gaussians, edge: float) -> torch.Tensor:
    settings = RasterSettings(sh_degree=0, depth=True, normal=True, median=False)
    return normal_loss(CpuRasterizer().render(gaussians, POSE, CAMERA, settings), POSE, CAMERA, edge)


def test_discs_in_their_plane_cost_nothing_and_turned_ones_do() -> None:
    true = float(loss_of_normals(wall(0.4), 0.1))
    turned = float(loss_of_normals(wall(0.4, disc_tilt_rad=0.0), 0.1))
    # 1 − cos 0.4 = 0.079 for normals that are off by 0.4 rad; blending over thick edges leaves some thousandths.
    assert true < 0.01
    assert turned > 0.04


def test_the_gradient_turns_the_discs_into_the_plane() -> None:
    gaussians = wall(0.4, disc_tilt_rad=0.2)
    gaussians.quats_wxyz.requires_grad_()
    optimizer = torch.optim.Adam([gaussians.quats_wxyz], lr=0.01)
    first = float(loss_of_normals(gaussians, 0.1).detach())
    for _ in range(15):
        optimizer.zero_grad()
        loss = loss_of_normals(gaussians, 0.1)
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 0.5 * first


def test_depth_edges_do_not_count() -> None:
    near, far = wall(0.0), wall(0.0)
    near = near.select(near.means[:, 0] < 0)
    near.means[:, 2] -= 2.0
    both = Gaussians.concatenate([near, far])
    # Two parallel walls behind each other have one normal; the step between them has none.
    assert float(loss_of_normals(both, 0.02)) < 0.02


def test_flatness_is_the_smallest_standard_deviation_of_what_is_visible() -> None:
    gaussians = wall(0.0, thickness_m=0.05)
    gaussians.log_scales.requires_grad_()
    loss = flatness_loss(gaussians, torch.tensor([0, 2]), extent_m=10.0)
    assert float(loss.detach()) == pytest.approx(0.005)
    loss.backward()
    assert gaussians.log_scales.grad is not None
    assert gaussians.log_scales.grad.abs().sum(dim=0)[:2].tolist() == [0, 0]
    assert gaussians.log_scales.grad[:, 2].nonzero()[:, 0].tolist() == [0, 2]


def test_depth_is_held_to_the_points_that_are_seen_in_it() -> None:
    depth = torch.full((36, 48), 5.0, requires_grad=True)
    alpha = torch.ones(36, 48)
    alpha[:, :8] = 0.1
    points = torch.tensor([
        [0.0, 0.0, 4.0],  # 25 % too far
        [0.5, -0.5, 5.0],  # right
        [-2.4, 0.0, 4.0],  # at column 0, where nothing is opaque
        [9.0, 0.0, 4.0],  # outside
        [0.0, 0.0, -4.0],  # behind
    ])  # fmt: skip
    loss = depth_loss(depth, alpha, ObservedPoints(points), POSE, CAMERA)
    # (0.25 + what being off at all costs: 9 · 0.002) / 2 that count.
    assert float(loss.detach()) == pytest.approx(0.5 * (0.25 + 0.018), rel=1e-5)
    loss.backward()
    assert depth.grad is not None
    # Only the four pixels around the middle have a gradient, towards nearer.
    assert (depth.grad[17:19, 23:25] > 0).all() and int((depth.grad.abs() > 1e-6).sum()) <= 8
    fourfold = ObservedPoints(points, torch.tensor([4.0, 9, 1, 1, 1]))
    weighted = depth_loss(depth.detach(), alpha, fourfold, POSE, CAMERA)
    assert float(weighted) == pytest.approx(4 * float(loss.detach()), rel=1e-5)
    elsewhere = torch.eye(4)
    elsewhere[2, 3] = 1.0
    far = depth_loss(depth.detach(), alpha, ObservedPoints(points[:1]), elsewhere, CAMERA)
    assert float(far) == pytest.approx(0.0, abs=1e-6)


def test_depth_loss_is_steepest_where_depth_is_nearly_right() -> None:
    alpha, point = torch.ones(36, 48), torch.tensor([[0.0, 0.0, 4.0]])

    def slope(depth_m: float) -> float:
        depth = torch.full((36, 48), depth_m, requires_grad=True)
        depth_loss(depth, alpha, ObservedPoints(point), POSE, CAMERA).backward()
        assert depth.grad is not None
        return float(depth.grad.sum())

    assert slope(4.4) == pytest.approx(0.25, rel=1e-3)  # 1 / z: 10 % off
    assert slope(4.0004) == pytest.approx(10 * 0.25, rel=0.06)  # 0.01 % off
    assert slope(3.9996) == pytest.approx(-10 * 0.25, rel=0.06)


def haze(apart_m: float) -> Gaussians:
    """Return two translucent walls before an opaque third, about 5 m ahead."""
    walls = [wall(0.0) for _ in range(3)]
    for place, layer in enumerate(walls):
        layer.means[:, 2] += (place - 1) * apart_m
        layer.logit_opacities[:] = -1.5 if place < 2 else 3.0
    return Gaussians.concatenate(walls)


def seen(gaussians: Gaussians) -> Render:
    return CpuRasterizer().render(gaussians, POSE, CAMERA, RasterSettings(sh_degree=0, depth=True))


def compactness(render: Render) -> torch.Tensor:
    assert render.expected_depth is not None and render.depth_variance is not None
    return compactness_loss(render.expected_depth, render.depth_variance, render.alpha)


def test_one_surface_is_compact_and_haze_is_not() -> None:
    # 1 cm thick discs spread far less than the 2.5 cm that a two-hundredth of 5 m is; 0.3 m is twelve times that.
    assert float(compactness(seen(haze(0.0)))) < 0.05
    assert float(compactness(seen(haze(0.3)))) > 3


def test_an_edge_costs_little_more_than_haze() -> None:
    # Ten times as far apart would cost a hundred times as much, were it not for the logarithm.
    assert float(compactness(seen(haze(3.0)))) < 2.5 * float(compactness(seen(haze(0.3))))


def test_the_gradient_clears_the_haze() -> None:
    gaussians = haze(0.2)
    gaussians.means.requires_grad_()
    gaussians.logit_opacities.requires_grad_()
    optimizer = torch.optim.Adam([gaussians.means, gaussians.logit_opacities], lr=0.02)
    before = seen(gaussians).depth_variance
    for _ in range(25):
        optimizer.zero_grad()
        compactness(seen(gaussians)).backward()
        optimizer.step()
    after = seen(gaussians)
    assert before is not None and after.depth_variance is not None
    assert float(after.depth_variance.mean().detach()) < 0.05 * float(before.mean().detach())
    assert float(after.alpha.min().detach()) > 0.8  # not by clearing the surface, too
