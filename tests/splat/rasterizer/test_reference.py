"""The reference is right by itself: closed forms, finite differences, and gsplat's own torch code."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import ALPHA_MIN, RasterSettings
from pipelines.splat.rasterizer.reference import project_gaussians, render_reference


def test_single_round_gaussian_has_its_closed_form(camera):
    depth, sigma, opacity = 4.0, 0.2, 0.7
    gaussians = Gaussians(
        means=torch.tensor([[0.3, -0.2, depth]], dtype=torch.float64),
        quats_wxyz=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        log_scales=torch.full((1, 3), math.log(sigma), dtype=torch.float64),
        logit_opacities=torch.logit(torch.tensor([opacity], dtype=torch.float64)),
        sh=torch.tensor([[[0.4, 0.0, -0.4]]], dtype=torch.float64),
    )
    render = render_reference(gaussians, torch.eye(4, dtype=torch.float64), camera, RasterSettings(sh_degree=0))
    u, v = camera.fx * 0.3 / depth + camera.cx, -camera.fy * 0.2 / depth + camera.cy
    rows, columns = torch.meshgrid(
        torch.arange(45.0).double() + 0.5, torch.arange(70.0).double() + 0.5, indexing="ij"
    )
    # J Σ Jᵀ of a round Gaussian: (f σ/z)² (I + slope slopeᵀ), plus the dilation.
    slope = torch.tensor([0.3 / depth, -0.2 / depth], dtype=torch.float64)
    focal = torch.diag(torch.tensor([camera.fx, camera.fy], dtype=torch.float64)) * sigma / depth
    cov = focal @ (torch.eye(2, dtype=torch.float64) + torch.outer(slope, slope)) @ focal
    cov = cov + 0.3 * torch.eye(2, dtype=torch.float64)
    offset = torch.stack([columns - u, rows - v], dim=-1)
    sigma_px = 0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(cov), offset)
    alpha = opacity * torch.exp(-sigma_px)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    torch.testing.assert_close(render.alpha, alpha, rtol=1e-12, atol=1e-12)
    basis = math.sqrt(1 / (4 * math.pi))
    torch.testing.assert_close(render.colour[..., 0], alpha * (0.5 + 0.4 * basis), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_gradcheck(make_scene):
    # Central differences of step 1e-6 are good to 1e-9; gradcheck's own tolerances are wider.
    (gaussians, pose), camera = make_scene(3, seed=3, degree=2), Pinhole(11, 8, 9.0, 9.0, 5.5, 4.0)

    def images(*inputs):
        settings = RasterSettings(sh_degree=2, background=(0.3, 0.1, 0.6), depth=True)
        render = render_reference(Gaussians(*inputs[:5]), inputs[5], camera, settings)
        return render.colour, render.alpha, render.expected_depth

    inputs = [tensor.requires_grad_() for tensor in (*gaussians.tensors().values(), pose)]
    assert torch.autograd.gradcheck(images, inputs, check_undefined_grad=False)


def test_projection_and_harmonics_agree_with_gsplat(make_scene, camera):
    theirs = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is an extra")
    gaussians, pose = make_scene(200, seed=5, log_scale=-1.0)
    covars, _ = theirs._quat_scale_to_covar_preci(gaussians.quats_wxyz, gaussians.log_scales.exp())
    intrinsics = torch.tensor([[60.0, 0, 36], [0, 58, 21], [0, 0, 1]], dtype=torch.float64)
    mean_in_cam, covar_in_cam = theirs._world_to_cam(gaussians.means, covars, pose[None])
    mean_px, cov_px2 = theirs._persp_proj(mean_in_cam, covar_in_cam, intrinsics[None], camera.width, camera.height)
    ours_mean, ours_cov = project_gaussians(gaussians, mean_in_cam[0], pose, camera, 0.0)
    torch.testing.assert_close(ours_mean, mean_px[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(ours_cov, cov_px2[0], rtol=1e-10, atol=1e-10)
    direction = torch.nn.functional.normalize(gaussians.means, dim=-1)
    torch.testing.assert_close(
        sh.evaluate_sh(gaussians.sh, direction, 3),
        theirs._spherical_harmonics(3, direction, gaussians.sh),
        rtol=1e-6,  # their constants have seven digits or more
        atol=1e-9,
    )
