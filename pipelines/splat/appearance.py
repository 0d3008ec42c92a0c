"""Refinement of Gaussians by images: of their appearance, while their geometry stays, or of both."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from pipelines.core.progress import SILENT, Progress
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import (
    TRANSPARENCY_WEIGHT,
    photometric_loss,
    training_background,
    transparency_loss,
)
from pipelines.splat.optimizer import GaussianAdam, LearningRates
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings

# Rates of a short fit of linear quantities. Gaussians without a rate for their geometry keep it to the last bit.
_RATES = LearningRates(
    means=0.0, means_final=0.0, quats_wxyz=0.0, log_scales=0.0, logit_opacities=0.05, sh_dc=0.01, sh_rest=0.002
)
# Rates at which shapes follow as well, after a part of the Gaussians has gone. Of those of a training, the centres'
# is in scene extents.
WITH_SHAPES = replace(_RATES, means=2.5e-4, means_final=2.5e-5, quats_wxyz=0.008, log_scales=0.04)
_FALLS = ((0.8, 0.1), (0.5, 0.3), (0.0, 1.0))  # from this part of the work on, the rates have this factor


@dataclass(frozen=True)
class ShownView:
    """Image (H, W, 3), 0 … 1, that the Gaussians should show from a pose (4, 4)."""

    cam_from_model: Tensor
    camera: Pinhole
    colour: Tensor


def refine_appearance(
    gaussians: Gaussians,
    views: Callable[[int], ShownView],
    order: list[int],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    *,
    rates: LearningRates = _RATES,
    extent_m: float = 1.0,
    progress: Progress = SILENT,
) -> Gaussians:
    """Return the Gaussians, on their own device, with colours and opacities that show the views.

    The order tells the number of a view for each iteration, the settings the degree of the harmonics. As in a
    training, the background changes and transparency costs. Other rates move the geometry, too; that of the centres
    is a part of the extent.
    """
    device = rasterizer.device
    adam = GaussianAdam(gaussians.to(device), extent_m, len(order), rates)
    with progress.task("refinement", len(order)) as task:
        for iteration, number in enumerate(order):
            view = views(number)
            adam.rate_factor = next(factor for begin, factor in _FALLS if iteration >= begin * len(order))
            pose = view.cam_from_model.to(device)
            visible = adam.show(rasterizer.candidates(adam.gaussians, pose, view.camera, settings))
            before = replace(settings, background=training_background(iteration))
            render = rasterizer.render(visible, pose, view.camera, before)
            loss = photometric_loss(render.colour, view.colour.to(device))
            (loss + TRANSPARENCY_WEIGHT * transparency_loss(render.alpha)).backward()
            adam.step(iteration, render.stats.visible)
            task.advance()
    return adam.gaussians.detached().to(gaussians.means.device)


def shuffled_passes(views: int, passes: int, rng: np.random.Generator) -> list[int]:
    """Return the numbers of views for a number of passes, each in a random order of its own."""
    return [int(number) for _ in range(passes) for number in rng.permutation(views)]
