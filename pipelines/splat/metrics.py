"""Image quality as the splatting literature reports it: PSNR and SSIM of images as they are shown."""

from __future__ import annotations

import math

from torch import Tensor

from pipelines.splat.losses import image_similarity

# PSNR of equal images: a report has no infinity. Rounding to 8 bits alone gives 59 dB.
MAX_PSNR_DB = 100.0


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, of values from 0 to 1 over all channels; at most 100 dB.

    Args:
        image: (H, W, 3); clamped to 0 … 1, as on a display.
        target: (H, W, 3).
        mask: (H, W) bool, True where a pixel counts; None: all do.

    Raises:
        ValueError: shapes do not agree, or no pixel counts.
    """
    _check(image, target, mask)
    difference = image.detach().clamp(0, 1).double() - target.double()
    if mask is not None:
        difference = difference[mask]
    error = float(difference.square().mean())
    return min(-10 * math.log10(error), MAX_PSNR_DB) if error > 0 else MAX_PSNR_DB


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean SSIM with the 11×11 Gaussian window of `pipelines.splat.losses`, 1 for equal images.

    Args:
        image: (H, W, 3); clamped to 0 … 1, as on a display.
        target: (H, W, 3).
        mask: (H, W) bool, True where a pixel counts; None: all do.

    Raises:
        ValueError: shapes do not agree, or no pixel counts.
    """
    _check(image, target, mask)
    return image_similarity(image.detach().clamp(0, 1), target, mask).ssim


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.shape != target.shape:
        raise ValueError(f"expected two images of one shape, got {tuple(image.shape)} and {tuple(target.shape)}")
    if mask is not None and not bool(mask.any()):
        raise ValueError("the mask leaves no pixel to compare")
