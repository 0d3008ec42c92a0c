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
from tests.splat.rasterizer.parity import BACKGROUND, CASES, GRADIENT, assert_parity

MISSING = missing_for_cuda()
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(MISSING is not None, reason=f"no GPU to test on: {MISSING}")]


@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients(make_scene, camera, case):
    count, log_scale, degree, depth = case
    settings = RasterSettings(sh_degree=degree, background=BACKGROUND, depth=depth, normal=depth)
    scene = make_scene(count, seed=count, log_scale=log_scale)
    assert_parity(rasterizer("cuda"), "cuda", scene, camera, settings)


@pytest.mark.parametrize("masked", [False, True])
def test_photometric_loss(masked):
    random = torch.Generator().manual_seed(1)
    rendered, target = torch.rand(2, 40, 50, 3, generator=random)
    mask = torch.rand(40, 50, generator=random) > 0.3 if masked else None
    values, gradients = [], []
    for device in ("cpu", "cuda"):
        leaf = rendered.to(device, copy=True).requires_grad_()
        loss = photometric_loss(leaf, target.to(device), None if mask is None else mask.to(device))
        loss.backward()
        values.append(loss.item())
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
