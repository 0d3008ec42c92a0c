"""What a rasteriser must have in common with the reference: images, gradients, and the Gaussians that it saw."""

from __future__ import annotations

import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.rasterizer.reference import project_gaussians, render_reference
from tests.splat.rasterizer.conftest import Scene, as_leaves

# float32 with the fast exponential of CUDA: some 1e-6 a contribution. Gradients sum 1e3 of them, of either sign.
IMAGE, GRADIENT = 1e-4, 1e-3
_REACH = 3.33  # σ of gsplat's box around a Gaussian

# Number of Gaussians, logarithm of their size, degree of the harmonics, with depth and normals or without.
CASES = [(150, -2.0, 3, True), (150, -1.0, 2, True), (400, -3.0, 1, False), (60, 0.3, 0, True)]
BACKGROUND = (0.2, 0.5, 0.9)


def assert_parity(
    rasteriser: Rasterizer, device: str, scene: Scene, camera: Pinhole, settings: RasterSettings
) -> None:
    """Bound the differences of a float32 render on `device` and of its gradients from the reference in float64."""
    truth, _ = as_leaves(scene, torch.float64)
    moved = [tensor.detach().to(device, torch.float32).requires_grad_() for tensor in scene[0].tensors().values()]
    gaussians = Gaussians(*moved)
    motion, truth_motion = (torch.zeros(6, dtype=torch.float64, requires_grad=True) for _ in range(2))
    expected = render_reference(truth, _moved(scene[1], truth_motion), camera, settings)
    render = rasteriser.render(gaussians, _moved(scene[1], motion).to(device), camera, settings)
    names = ["colour", "alpha"]
    names += ["expected_depth", "median_depth"] if settings.depth else []
    names += ["normal"] if settings.normal else []
    for name in names:
        scale = 8 if "depth" in name else 1  # metres
        difference = (getattr(render, name).cpu().double() - getattr(expected, name)).abs()
        # Whether an alpha of exactly 1/255 counts is a matter of rounding: one pixel in a thousand may differ.
        assert (difference > scale * IMAGE).double().mean() < 1e-3, f"{name}: {difference.max()}"
    _assert_seen(render.stats.visible.cpu(), expected.stats.visible, scene, camera, settings)

    loss = torch.zeros((), dtype=torch.float64)
    truth_loss = loss.clone()
    random = torch.Generator().manual_seed(0)
    for name in names:
        if name != "median_depth":  # which has no gradient
            weight = torch.randn(getattr(expected, name).shape, generator=random, dtype=torch.float64)
            loss = loss.to(device) + (weight.to(device) * getattr(render, name)).sum()
            truth_loss = truth_loss + (weight * getattr(expected, name)).sum()
    loss.backward()
    truth_loss.backward()
    pairs = {name: (tensor, truth.tensors()[name]) for name, tensor in gaussians.tensors().items()}
    pairs["motion"] = (motion, truth_motion)
    for name, (ours, theirs) in pairs.items():
        assert ours.grad is not None
        assert theirs.grad is not None
        error = (ours.grad.cpu().double() - theirs.grad).abs().max() / theirs.grad.abs().max()
        assert error < GRADIENT, f"{name}: {error}"
    assert render.stats.mean_gradient is not None
    assert render.stats.mean_gradient.shape == (len(render.stats.visible), 2)


def _moved(cam_from_model: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
    """Return the pose after a turn and a shift of the camera (6,).

    Gradients of the 12 numbers of a pose cannot be compared: gsplat inverts the matrix where the reference
    transposes the rotation, and the two differ in every direction that is no motion.
    """
    x, y, z, *shift = motion.unbind()
    zero = torch.zeros_like(x)
    rows = [(zero, -z, y, shift[0]), (z, zero, -x, shift[1]), (-y, x, zero, shift[2]), (zero,) * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ cam_from_model


def _assert_seen(
    seen: torch.Tensor, expected: torch.Tensor, scene: Scene, camera: Pinhole, settings: RasterSettings
) -> None:
    """Require all Gaussians that reach the centre of a pixel, and of others only those whose box reaches the image.

    gsplat rounds the half sides of its box up to whole pixels; the reference counts the centres of pixels.
    """
    assert set(expected.tolist()) <= set(seen.tolist())
    more = torch.tensor(sorted(set(seen.tolist()) - set(expected.tolist())), dtype=torch.int64)
    gaussians, pose = scene
    chosen = gaussians.select(more)
    in_cam = chosen.means @ pose[:3, :3].T + pose[:3, 3]
    means_px, cov = project_gaussians(chosen, in_cam, pose, camera, settings.dilation_px2)
    outside = torch.maximum(-means_px, means_px - torch.tensor([camera.width, camera.height])).clamp_min(0)
    assert (outside <= _REACH * cov.diagonal(dim1=-2, dim2=-1).sqrt() + 1).all()
    assert len(more) <= len(gaussians.means) // 10
