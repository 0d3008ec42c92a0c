"""Evidence of the training views on single Gaussians: how much each shows, and whether photographs contradict it.

A pixel's colour is linear in the opacity of each Gaussian. The derivative of the squared error by the opacity
therefore tells which part of the error grows with it. Training brings that to zero where a Gaussian is in its
place.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.core.progress import Progress
from pipelines.core.types import Float32Array
from pipelines.geometry.cameras import pose_matrix
from pipelines.splat.densify import view_contributions
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.surface.photometry import photograph_and_mask, through_lens
from pipelines.surface.surface_views import ModelRenderer


@dataclass(frozen=True)
class Evidence:
    """Sums over views and their pixels, for N Gaussians.

    Attributes:
        weight_px: (N,) of the blending weights.
        error: (N,) of the opacity times the derivative of the squared error of the three colours by it.
    """

    weight_px: Float32Array
    error: Float32Array

    @property
    def mean_error(self) -> Float32Array:
        """Return the error (N,) of a pixel that a Gaussian fills; 0: no view shows it."""
        return np.asarray(self.error / np.maximum(self.weight_px, 1e-3), dtype=np.float32)


def evidence_of(renderer: ModelRenderer, backend: Rasterizer, views: list[int], progress: Progress) -> Evidence:
    """Return the evidence of views, by their indices; an InputError: a photograph cannot be read."""
    gaussians = renderer.gaussians.to(backend.device)
    weight, error = torch.zeros(2, len(gaussians), device=backend.device)
    with progress.task("evidence of the views", len(views)) as task:
        for index in views:
            pose, camera = _pose(renderer, index).to(backend.device), renderer.pinholes.of(index)
            none = torch.zeros(camera.height, camera.width, device=backend.device)
            weight += view_contributions(gaussians, pose, camera, none, backend).weight_px
            error += _error_by_opacity(renderer, backend, index, pose)
            task.advance()
    return Evidence(weight.cpu().numpy(), error.cpu().numpy())


def _pose(renderer: ModelRenderer, index: int) -> Tensor:
    pose = renderer.pose(index)
    return torch.from_numpy(pose_matrix(pose.cam_from_model, pose.center_in_model)).float()


def _error_by_opacity(renderer: ModelRenderer, backend: Rasterizer, index: int, pose: Tensor) -> Tensor:
    """Return opacity times the derivative of the squared error by it (N,), of one view."""
    model = renderer.model
    shown = renderer.gaussians.to(backend.device).detached()
    shown.logit_opacities = shown.logit_opacities.clone().requires_grad_()
    photo, mask = (values.to(backend.device) for values in photograph_and_mask(renderer, index))
    settings = RasterSettings(model.sh_degree, model.background)
    with torch.enable_grad():
        render = backend.render(shown, pose, renderer.pinholes.of(index), settings)
        difference = through_lens(renderer, index, render.colour) - photo
        error = (difference.square().sum(dim=2) * mask).sum()
        (by_logit,) = torch.autograd.grad(error, shown.logit_opacities)
    # ∂o/∂logit = o (1 − o)
    return by_logit / (1 - torch.sigmoid(shown.logit_opacities.detach())).clamp_min(1e-3)
