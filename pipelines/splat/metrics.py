"""Image quality as the splatting literature reports it: PSNR, SSIM, and LPIPS (doi 10.1109/CVPR.2018.00068).

The VGG-16 weights of LPIPS are not part of the package. An NPZ file holds them: a TorchScript or `.pth` file would
carry code or pickles. The arrays have the names of the published network's state. With the `lpips` package and its
weights installed, these lines write the file:

    import lpips, numpy
    numpy.savez("lpips_vgg.npz", **{k: v.numpy() for k, v in lpips.LPIPS(net="vgg").state_dict().items()})
"""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from pipelines.core.errors import InputError
from pipelines.core.files import read_npz
from pipelines.splat.losses import image_similarity

# PSNR of equal images: a report has no infinity. Rounding to 8 bits alone gives 59 dB.
MAX_PSNR_DB = 100.0


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, of values from 0 to 1 over all channels; at most 100 dB.

    The image (H, W, 3) is clamped to 0 … 1, as on a display. The `mask` (H, W) tells the pixels that count; None:
    all.

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
    """Return the mean SSIM with the window of `pipelines.splat.losses`; arguments and errors as of `psnr`."""
    _check(image, target, mask)
    return image_similarity(image.detach().clamp(0, 1), target, mask)[1]


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.shape != target.shape:
        raise ValueError(f"expected two images of one shape, got {tuple(image.shape)} and {tuple(target.shape)}")
    if mask is not None and not bool(mask.any()):
        raise ValueError("the mask leaves no pixel to compare")


# VGG-16's convolutions by their index among its layers; each slice ends where a feature is taken.
_SLICES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
_CHANNELS = (64, 128, 256, 512, 512)
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_SMALLEST_PX = 16  # four poolings


class Lpips:
    """Perceptual distance of images; the weights are loaded once. An InputError: no NPZ file of such weights."""

    def __init__(self, weights: Path) -> None:
        arrays = read_npz(weights, tuple(_shapes()))
        for name, shape in _shapes().items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                message = f"The weights are not finite numbers of shape {shape}."
                raise InputError("lpips-weights", message, path=weights, field=name)
        self._weights = {name: torch.as_tensor(array, dtype=torch.float32) for name, array in arrays.items()}

    def __call__(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
        """Return the distance of two images (H, W, 3) with values from 0 to 1, of 16 px or more.

        Features see neighbourhoods, so that pixels cannot be left out. Where the `mask` (H, W) is False, the image
        takes the target's pixels instead.
        """
        if image.shape != target.shape or image.ndim != 3 or min(image.shape[:2]) < _SMALLEST_PX:
            raise ValueError(f"expected two images (H, W, 3) of 16 px or more, got {tuple(image.shape)}")
        if mask is not None:
            image = torch.where(mask[:, :, None], image, target)
        with torch.no_grad():
            layers = zip(_features(image, self._weights), _features(target, self._weights), strict=True)
            distances = [
                functional.conv2d((x - y) ** 2, self._weights[f"lin{i}.model.1.weight"]).mean()
                for i, (x, y) in enumerate(layers)
            ]
        return float(torch.stack(distances).sum())


def _features(image: Tensor, weights: dict[str, Tensor]) -> list[Tensor]:
    planes = 2 * image.detach().cpu().float().clamp(0, 1).permute(2, 0, 1)[None] - 1
    x = (planes - torch.tensor(_SHIFT).view(1, 3, 1, 1)) / torch.tensor(_SCALE).view(1, 3, 1, 1)
    features = []
    for number, layers in enumerate(_SLICES, start=1):
        if number > 1:
            x = functional.max_pool2d(x, 2)
        for layer in layers:
            name = f"net.slice{number}.{layer}"
            x = functional.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding=1).relu()
        features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10))
    return features


def _shapes() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    before = 3
    for number, (layers, channels) in enumerate(zip(_SLICES, _CHANNELS, strict=True)):
        for layer in layers:
            shapes[f"net.slice{number + 1}.{layer}.weight"] = (channels, before, 3, 3)
            shapes[f"net.slice{number + 1}.{layer}.bias"] = (channels,)
            before = channels
        shapes[f"lin{number}.model.1.weight"] = (1, channels, 1, 1)
    return shapes
