"""Contribution of every Gaussian to a view: the pixels that it makes up, and those of them with a high error.

The blending weight of Gaussian k at pixel p is w_k(p) = α_k(p) T_k(p), and Σ_p w_k(p) e(p) is the derivative of
Σ_p e(p) c(p) by the Gaussian's colour. One render of grey Gaussians and its backward pass therefore give the sums
of all Gaussians at once, on every backend (the auxiliary gradient of doi 10.48550/arXiv.2404.06109, section 3.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.sh import C0

# An error counts as high from this fraction of the view's largest (FastGS takes maps normalised to 0 … 1).
_HIGH_ERROR = 0.1


@dataclass(frozen=True)
class ViewContributions:
    """Contributions of N Gaussians to one view.

    Attributes:
        weight_px: (N,) pixels that each Gaussian makes up, Σ w.
        high_error_px: (N,) those of them whose error is high, Σ w [error is high].
    """

    weight_px: Tensor
    high_error_px: Tensor


# Returns the contributions to a number of different training views, drawn with the generator.
Probe = Callable[[int, torch.Generator], list[ViewContributions]]


def view_contributions(
    gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, error: Tensor, rasterizer: Rasterizer
) -> ViewContributions:
    """Return the contributions of all Gaussians to one view.

    Args:
        gaussians: N of them.
        cam_from_model: (4, 4) pose.
        camera: of H × W pixels.
        error: (H, W) absolute error of the view, 0 where no pixel counts.
        rasterizer: backend.
    """
    scaled = error / error.max().clamp_min(1e-9)
    maps = torch.stack([torch.ones_like(error), (scaled > _HIGH_ERROR).to(error), torch.zeros_like(error)], dim=-1)
    grey = gaussians.detached()
    grey.sh = torch.zeros(len(gaussians), 1, 3, device=error.device, requires_grad=True)
    with torch.enable_grad():
        render = rasterizer.render(grey, cam_from_model.detach(), camera, RasterSettings(sh_degree=0))
        (gradient,) = torch.autograd.grad((render.colour * maps).sum(), grey.sh)
    sums = gradient[:, 0] / C0
    return ViewContributions(sums[:, 0], sums[:, 1])
