"""The depth of a render is that of the surfaces at the pixels: discs on slanted planes, whose depth is known."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import ALPHA_MIN, DEPTH_REACH, RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.rasterizer.reference import render_reference

CAMERA = Pinhole(width=120, height=90, fx=100.0, fy=95.0, cx=57.0, cy=47.0)
SETTINGS = RasterSettings(sh_degree=0, depth=True)
RENDERERS = pytest.mark.parametrize("render", [CpuRasterizer().render, render_reference], ids=["cpu", "reference"])


def disc(center, tilt_rad, sigma_m, *, opacity=0.95):
    """Return a flat Gaussian that faces the camera, turned by `tilt_rad` about the camera's x axis."""
    quat = [math.cos(tilt_rad / 2), math.sin(tilt_rad / 2), 0.0, 0.0]
    return Gaussians(
        means=torch.tensor([center], dtype=torch.float64),
        quats_wxyz=torch.tensor([quat], dtype=torch.float64),
        log_scales=torch.tensor([[sigma_m, sigma_m, 1e-3]], dtype=torch.float64).log(),
        logit_opacities=torch.logit(torch.tensor([opacity], dtype=torch.float64)),
        sh=torch.zeros(1, 1, 3, dtype=torch.float64),
    )


def rays():
    """Return directions (H, W, 3) through the pixel centres, z = 1."""
    v, u = torch.meshgrid(
        torch.arange(CAMERA.height, dtype=torch.float64) + 0.5,
        torch.arange(CAMERA.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    return torch.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, torch.ones_like(u)], dim=-1)


@RENDERERS
@pytest.mark.parametrize("tilt_deg", [-60.0, 30.0, 50.0])
def test_disc_on_a_slanted_plane(render, tilt_deg):
    center, sigma_m = torch.tensor([1.5, -2.0, 30.0], dtype=torch.float64), 3.0
    tilt = math.radians(tilt_deg)
    normal = torch.tensor([0.0, -math.sin(tilt), math.cos(tilt)], dtype=torch.float64)
    truth = (center @ normal) / (rays() @ normal)
    view = render(disc(center.tolist(), tilt, sigma_m), torch.eye(4, dtype=torch.float64), CAMERA, SETTINGS)

    from_center_m = (rays() * truth[..., None] - center).norm(dim=-1)
    near, wide = from_center_m < 0.5 * sigma_m, from_center_m < sigma_m
    # Not exact, because perspective is not affine: the depth of a plane is z / (1 − x) where the linear one is
    # z (1 + x), and they part by z x². At half a σ from the centre x ≤ σ sin(tilt) / 2z ≤ 0.043: 0.06 m, of an
    # extent of 9 m; at one σ four times that. The dilation of 0.3 px² flattens the slope by less than one per cent.
    extent_m = 3 * sigma_m
    for depth, seen in ((view.expected_depth, view.alpha > 0), (view.median_depth, view.alpha > 0.5)):
        error = (depth - truth).abs()
        assert (near & seen).sum() >= 30
        assert error[near & seen].max() < 0.01 * extent_m
        assert error[wide & seen].max() < 0.04 * extent_m
    # The centre's depth is wrong by most of σ sin(tilt) at one σ.
    assert (truth - center[2])[wide & (view.alpha > 0)].abs().max() > 0.8 * sigma_m * abs(math.sin(tilt))


@RENDERERS
def test_disc_that_faces_the_camera_is_flat(render):
    view = render(disc([0.0, 0.0, 5.0], 0.0, 0.5), torch.eye(4, dtype=torch.float64), CAMERA, SETTINGS)
    seen = view.alpha > 0
    torch.testing.assert_close(view.expected_depth[seen], torch.full_like(view.alpha[seen], 5.0))


@RENDERERS
def test_two_discs_of_one_plane_agree_where_they_meet(render):
    # Blending depths of one plane gives that plane, wherever the centres are: by their depths it would be a stair.
    tilt = math.radians(45.0)
    normal = torch.tensor([0.0, -math.sin(tilt), math.cos(tilt)], dtype=torch.float64)
    across = torch.tensor([0.0, math.cos(tilt), math.sin(tilt)], dtype=torch.float64)
    centers = [torch.tensor([0.0, 0.0, 40.0], dtype=torch.float64) + step * across for step in (-1.5, 0.0, 1.5)]
    parts = [disc(center.tolist(), tilt, 1.0, opacity=0.6) for center in centers]
    view = render(Gaussians.concatenate(parts), torch.eye(4, dtype=torch.float64), CAMERA, SETTINGS)
    truth = (centers[1] @ normal) / (rays() @ normal)
    from_center_m = (rays() * truth[..., None] - centers[1]).norm(dim=-1)
    # Each is off by z x², at its 3.3 σ by 0.14 m, with a weight that has vanished there.
    assert (view.expected_depth - truth).abs()[from_center_m < 1.5].max() < 0.05


@RENDERERS
def test_depth_stays_in_front_of_the_camera(render):
    # A needle along the optical axis, nearly: at 3.3 σ it would be 2 m behind the camera.
    gaussians = disc([0.3, 0.2, 2.0], 0.0, 0.05)
    gaussians.log_scales[0, 2] = math.log(1.2)
    view = render(gaussians, torch.eye(4, dtype=torch.float64), CAMERA, SETTINGS)
    seen = view.alpha > 0
    assert (view.expected_depth[seen] - 2.0).abs().max() <= 2.0 * DEPTH_REACH
    # The needle uses most of that reach, down to α = 1/255.
    assert (view.expected_depth[seen] - 2.0).abs().max() > 0.8 * 2.0 * DEPTH_REACH
    assert view.alpha[seen].min() >= ALPHA_MIN
    assert (view.median_depth[view.alpha > 0.5] > 0).all()


@RENDERERS
def test_wall_of_discs_as_wide_as_a_pixel(render):
    tilt, pixel_m = math.radians(60.0), 0.1
    normal = torch.tensor([0.0, -math.sin(tilt), math.cos(tilt)], dtype=torch.float64)
    across = torch.tensor([0.0, math.cos(tilt), math.sin(tilt)], dtype=torch.float64)
    right = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    middle, steps = torch.tensor([0.0, 0.0, 10.0], dtype=torch.float64), pixel_m * torch.arange(-12.0, 13.0)
    places = [middle + a * across + b * right for a in steps for b in steps]
    wall = Gaussians.concatenate([disc(place.tolist(), tilt, pixel_m, opacity=0.5) for place in places])
    view = render(wall, torch.eye(4, dtype=torch.float64), CAMERA, SETTINGS)
    point = rays() * view.expected_depth[..., None]
    inside = ((point - middle).norm(dim=-1) < 0.5) & (view.alpha > 0.9)
    assert inside.sum() >= 20
    # Seen at 60°, a disc is half a pixel wide. The dilation of the image, 0.3 px², would take 0.3 / (0.25 + 0.3) of
    # its slope and bring the wall nearer by half a pixel, because nearer discs hide those behind them. A tenth of
    # the dilation takes 0.03 / (0.25 + 0.03), a fifth of that.
    assert ((middle - point) @ normal)[inside].abs().max() < 0.15 * pixel_m
