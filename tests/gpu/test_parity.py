"""The cuda backend gives the reference's images and gradients, and trains as the CPU does. Needs a GPU.

Without one, or with a part missing, the tests are skipped, and the reason names the part (`pytest -rs tests/gpu`).
"""

from __future__ import annotations

import pytest
import torch

from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import photometric_loss
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.rasterizer.cuda_kernels import missing_for_cuda
from pipelines.splat.rasterizer.reference import render_reference

MISSING = missing_for_cuda()
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(MISSING is not None, reason=f"no GPU to test on: {MISSING}")]
BACKGROUND = (0.2, 0.5, 0.9)
# float32 with the fast exponential of CUDA: some 1e-6 a contribution. Gradients sum 1e3 of them, of either sign.
IMAGE, GRADIENT = 1e-4, 1e-3


def on_gpu(scene):
    gaussians, pose = scene
    tensors = [
        tensor.detach().to("cuda", torch.float32).requires_grad_() for tensor in gaussians.tensors().values()
    ]
    return Gaussians(*tensors), pose.detach().to("cuda").requires_grad_()


@pytest.mark.parametrize(
    # Number of Gaussians, logarithm of their size, degree of the harmonics, with depth and normals or without.
    "case",
    [(150, -2.0, 3, True), (150, -1.0, 2, True), (400, -3.0, 1, False), (60, 0.3, 0, True)],
)
def test_images_and_gradients(make_scene, leaves, camera, case):
    count, log_scale, degree, depth = case
    scene = make_scene(count, seed=count, log_scale=log_scale)
    settings = RasterSettings(sh_degree=degree, background=BACKGROUND, depth=depth, normal=depth)
    (truth, truth_pose), (gaussians, pose) = leaves(scene, torch.float64), on_gpu(scene)
    expected = render_reference(truth, truth_pose, camera, settings)
    render = rasterizer("cuda").render(gaussians, pose, camera, settings)
    names = ["colour", "alpha", *(["expected_depth", "normal", "median_depth"] if depth else [])]
    for name in names:
        scale = 8 if "depth" in name else 1  # metres
        difference = (getattr(render, name).cpu().double() - getattr(expected, name)).abs()
        # Whether an alpha of exactly 1/255 counts is a matter of rounding: one pixel in a thousand may differ.
        assert (difference > scale * IMAGE).double().mean() < 1e-3, f"{name}: {difference.max()}"
    torch.testing.assert_close(render.stats.visible.cpu().sort().values, expected.stats.visible)

    loss = torch.zeros((), dtype=torch.float64)
    truth_loss = loss.clone()
    random = torch.Generator().manual_seed(0)
    for name in names[:4]:  # a median has no gradient
        weight = torch.randn(getattr(expected, name).shape, generator=random, dtype=torch.float64)
        loss = loss.cuda() + (weight.cuda() * getattr(render, name)).sum()
        truth_loss = truth_loss + (weight * getattr(expected, name)).sum()
    loss.backward()
    truth_loss.backward()
    pairs = {name: (tensor, truth.tensors()[name]) for name, tensor in gaussians.tensors().items()}
    pairs["cam_from_model"] = (pose, truth_pose)
    for name, (ours, theirs) in pairs.items():
        error = (ours.grad.cpu().double() - theirs.grad).abs().max() / theirs.grad.abs().max()
        assert error < GRADIENT, f"{name}: {error}"


@pytest.mark.parametrize("masked", [False, True])
def test_photometric_loss(masked):
    random = torch.Generator().manual_seed(1)
    rendered, target = torch.rand(2, 40, 50, 3, generator=random)
    mask = torch.rand(40, 50, generator=random) > 0.3 if masked else None
    values, gradients = [], []
    for device in ("cpu", "cuda"):
        leaf = rendered.to(device).requires_grad_()
        loss = photometric_loss(leaf, target.to(device), None if mask is None else mask.to(device))
        loss.backward()
        values.append(float(loss))
        gradients.append(leaf.grad.cpu())
    assert values[1] == pytest.approx(values[0], rel=1e-5)
    assert (gradients[1] - gradients[0]).abs().max() < GRADIENT * gradients[0].abs().max()


def test_optimiser(make_scene):
    gaussians, _ = make_scene(200)
    optimisers = [GaussianAdam(on, 1.0, 100) for on in (_float32(gaussians, "cpu"), _float32(gaussians, "cuda"))]
    for iteration in range(20):
        random = torch.Generator().manual_seed(iteration)
        rows = torch.randperm(200, generator=random)[:120]
        gradients = {
            n: torch.randn(t.shape, generator=random) for n, t in optimisers[0].gaussians.tensors().items()
        }
        for adam in optimisers:
            for name, tensor in adam.gaussians.tensors().items():
                tensor.grad = gradients[name].to(tensor.device)
            adam.step(iteration, rows.to(adam.gaussians.means.device))
    for name, tensor in optimisers[0].gaussians.tensors().items():
        torch.testing.assert_close(optimisers[1].gaussians.tensors()[name].cpu(), tensor, rtol=1e-5, atol=1e-5)


def _float32(gaussians, device):
    return Gaussians(*(tensor.detach().to(device, torch.float32) for tensor in gaussians.tensors().values()))
