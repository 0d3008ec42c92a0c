"""Renders beside their photographs: as lens and exposure show them, and how far the two are apart."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pipelines.core.progress import Progress
from pipelines.splat.exposure import squared_radius, with_affine, with_vignetting
from pipelines.splat.metrics import psnr
from pipelines.surface.surface_views import ModelRenderer


def through_lens(renderer: ModelRenderer, index: int, colour: Tensor) -> Tensor:
    """Return colours (H, W, 3) of a render as the lens and the exposure of its photograph show them."""
    camera_id, pinhole = int(renderer.sparse.image_camera_id[index]), renderer.images.pinhole(index)
    lens = next((lens for lens in renderer.model.vignetting if lens.camera_id == camera_id), None)
    if lens is not None:
        radius2 = squared_radius(pinhole, pinhole, colour.device)
        colour = with_vignetting(colour, radius2, torch.tensor(lens.coefficients, device=colour.device))
    exposure = renderer.model.cameras[index].exposure
    return colour if exposure is None else with_affine(colour, torch.tensor(exposure, device=colour.device))


def photograph_and_mask(renderer: ModelRenderer, index: int) -> tuple[Tensor, Tensor]:
    """Return the undistorted photograph (H, W, 3), 0 … 1, and the mask (H, W) of its pixels that count."""
    photo = torch.from_numpy(np.array(renderer.images.image(index))).float() / 255
    return photo, torch.from_numpy(np.array(renderer.images.mask(index)))


def mean_psnr(renderer: ModelRenderer, indices: Sequence[int], progress: Progress) -> float | None:
    """Return the mean PSNR of views by their indices, masks applied, as of `georef evaluate`; None without any.

    Raises:
        InputError: a photograph cannot be read.
    """
    figures = []
    with progress.task("views compared", len(indices)) as task:
        for index in indices:
            photo, mask = photograph_and_mask(renderer, index)
            rendered = through_lens(renderer, index, renderer.render(index).colour.cpu()).clamp(0, 1)
            figures.append(psnr(rendered, photo, mask))
            task.advance()
    return float(np.mean(figures)) if figures else None
