"""Losses of Gaussians: photometric, of transparency, of opacity in free space, and of distance to measured planes.

The photometric loss is that of 3D Gaussian Splatting (doi 10.1145/3592433, eq. 7): 0.8 · L1 + 0.2 · (1 − SSIM).
SSIM (doi 10.1109/TIP.2003.819861) has the 11×11 Gaussian window, σ = 1.5 px, zeros around the image. On a CPU value
and gradient come from one pass of fused kernels: torch's convolutions cost more than the rasteriser.

Photographs have no holes. Over one background, a training learns places of its colour as holes, which every viewer
with another background shows. So the background changes from iteration to iteration, and transparency costs.

A mask selects the pixels that count. The others are zero in both images, like pixels outside the image: they add
neither to L1 nor to SSIM's mean, and a window that reaches over them sees the same zeros as at the image's edge.

GeomGS (arXiv 2501.13417) trains a confidence of each Gaussian together with its distance to LiDAR. Here the
confidence is eliminated: c d²/s² + c − 1 − ln c is least for c = 1/(1 + d²/s²), and is then ln(1 + d²/s²). No
Gaussian carries a further parameter, and density control has nothing to inherit.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba
import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from pipelines.core.types import AutogradContext, BoolArray, FloatArray, IntArray
from pipelines.splat import ssim_kernels as kernels
from pipelines.splat.gaussians import Gaussians

SSIM_WEIGHT = 0.2
TRANSPARENCY_WEIGHT = 0.3  # 99 % of the pixels in the middle of a simulated town become 0.97 opaque


def photometric_loss(
    rendered: Tensor, target: Tensor, mask: Tensor | None = None, *, ssim_weight: float = SSIM_WEIGHT
) -> Tensor:
    """Return (1 − w) · mean|rendered − target| + w · (1 − mean SSIM), differentiable in `rendered`.

    Args:
        rendered, target: (H, W, 3) float32 or float64, of one type and on one device.
        mask: (H, W) bool, True where a pixel counts; None: all do.
        ssim_weight: w.

    Raises:
        ValueError: shapes, types or devices do not agree.
    """
    _check(rendered, target, mask)
    if rendered.device.type == "cpu":
        loss: Tensor = _Photometric.apply(rendered, target, mask, ssim_weight)  # type: ignore[no-untyped-call]
        return loss
    l1, ssim = _terms_by_convolution(rendered, target, mask)
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)


def image_similarity(image: Tensor, target: Tensor, mask: Tensor | None = None) -> tuple[float, float]:
    """Return mean L1 and SSIM of two images, without gradient; arguments and errors as of `photometric_loss`."""
    _check(image, target, mask)
    with torch.no_grad():
        if image.device.type == "cpu":
            absolute, similarity, count, _ = _by_kernels(image, target, mask)
            return absolute / count, similarity / count
        l1, ssim = _terms_by_convolution(image, target, mask)
        return float(l1), float(ssim)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: AutogradContext, rendered: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float
    ) -> Tensor:
        wanted = ssim_weight if ctx.needs_input_grad[0] else None
        absolute, similarity, count, gradient = _by_kernels(rendered, target, mask, wanted)
        if gradient is not None:
            ctx.save_for_backward(gradient)
        loss = (1 - ssim_weight) * absolute / count + ssim_weight * (1 - similarity / count)
        return rendered.new_tensor(loss)

    @staticmethod
    def backward(ctx: AutogradContext, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * grad_outputs[0], None, None, None


def _by_kernels(
    rendered: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float | None = None
) -> tuple[float, float, int, Tensor | None]:
    """Return Σ|x − y|, Σ SSIM, the number of values in these sums, and the loss's gradient if it has a weight."""
    x, y = (image.detach().contiguous().numpy().reshape(len(image), -1) for image in (rendered, target))
    valid = np.empty((0, 0), dtype=np.bool_) if mask is None else mask.contiguous().numpy()
    kind, taps = x.dtype.type, kernels.gaussian_taps(x.dtype)
    # A band blurs ten rows that its neighbours blur, too: no more bands than threads, and none of a few rows.
    bands = max(1, min(numba.get_num_threads(), len(x) // kernels.WINDOW))
    partials, sums = np.empty((3, *x.shape), dtype=x.dtype), np.empty((len(x), 2))
    kernels.ssim_forward(x, y, valid, taps, kind(kernels.C1), kind(kernels.C2), bands, partials, sums)
    count = x.size if mask is None else 3 * int(valid.sum())
    # Without pixels that count, there is no difference: SSIM is 1.
    absolute, similarity = sums.sum(axis=0).tolist() if count else (0.0, 1.0)
    count = max(count, 1)
    if ssim_weight is None:
        return absolute, similarity, count, None
    gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
    scales = kind((1 - ssim_weight) / count), kind(ssim_weight / count)
    kernels.ssim_backward(x, y, valid, partials, taps, *scales, bands, gradient.numpy().reshape(x.shape))
    return absolute, similarity, count, gradient


def _terms_by_convolution(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return L1 and SSIM by torch operations, for devices that the kernels do not run on."""
    weight = torch.ones_like(image[..., 0]) if mask is None else mask.to(image.dtype)
    x, y = (value * weight[..., None] for value in (image, target))
    taps = _window(image.dtype, image.device)
    planes = torch.cat([x, y, x * x, y * y, x * y], dim=-1).permute(2, 0, 1)[:, None]
    blurred: Tensor = _Blur.apply(planes, taps)  # type: ignore[no-untyped-call]
    mx, my, xx, yy, xy = blurred[:, 0].unflatten(0, (5, 3))
    numerator = (2 * mx * my + kernels.C1) * (2 * (xy - mx * my) + kernels.C2)
    denominator = (mx * mx + my * my + kernels.C1) * (xx - mx * mx + yy - my * my + kernels.C2)
    count = (3 * weight.sum()).clamp_min(1)
    ssim = 1 - ((1 - numerator / denominator) * weight).sum() / count
    return (x - y).abs().sum() / count, ssim


class _Blur(torch.autograd.Function):
    """Blur of planes (n, 1, H, W) along both axes; the taps are symmetric, and so it is its own adjoint.

    torch lets cuDNN round convolutions to TF32, which errs by 4e-4 of the loss. A flag around the forward pass
    alone would not hold in the backward pass.
    """

    @staticmethod
    def forward(ctx: AutogradContext, planes: Tensor, taps: Tensor) -> Tensor:
        ctx.save_for_backward(taps)
        return _blurred(planes, taps)

    @staticmethod
    def backward(ctx: AutogradContext, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (taps,) = ctx.saved_tensors
        return _blurred(grad_outputs[0], taps), None


def _blurred(planes: Tensor, taps: Tensor) -> Tensor:
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        along_y = functional.conv2d(planes, taps.view(1, 1, -1, 1), padding=(kernels.RADIUS, 0))
        return functional.conv2d(along_y, taps.view(1, 1, 1, -1), padding=(0, kernels.RADIUS))


# Made once: every copy to a GPU waits for all work that is queued there.
@lru_cache(maxsize=8)
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    half = torch.as_tensor(kernels.gaussian_taps(np.float64), dtype=dtype, device=device)
    return torch.cat([half.flip(0), half[1:]])


def _check(rendered: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if rendered.ndim != 3 or rendered.shape[2] != 3 or rendered.shape != target.shape:
        raise ValueError(f"expected two images (H, W, 3), got {tuple(rendered.shape)} and {tuple(target.shape)}")
    if rendered.dtype != target.dtype or rendered.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"expected two float images of one type, got {rendered.dtype} and {target.dtype}")
    if mask is not None and (mask.shape != rendered.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"expected a bool mask {tuple(rendered.shape[:2])}, got {mask.dtype} {tuple(mask.shape)}")


# RGB behind the scene in turn: colours from all over the cube, so that no shade can be learned as a hole. They are
# few, since each is copied to a GPU once.
_BACKGROUNDS = np.random.default_rng(0).permutation(
    np.stack(np.meshgrid(*3 * (np.linspace(0.0, 1.0, 4),)), axis=-1).reshape(-1, 3)
)


def training_background(iteration: int) -> tuple[float, float, float]:
    """Return the colour behind the scene in an iteration of a training."""
    red, green, blue = _BACKGROUNDS[iteration % len(_BACKGROUNDS)].tolist()
    return red, green, blue


def transparency_loss(alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of 1 − α over the pixels (H, W) of a render that count; `mask` None: all do."""
    through = 1 - alpha
    return through.mean() if mask is None else (through * mask).sum() / mask.sum().clamp_min(1)


@dataclass(frozen=True)
class FreeSpace:
    """Cells of the scene in which a scanner's beams met nothing, as a grid in `model`."""

    low_in_model: FloatArray  # (3,) low corner in metres
    cell_m: float  # side
    free: BoolArray  # (X, Y, Z)


class FreeSpaceLoss:
    def __init__(self, space: FreeSpace, device: torch.device) -> None:
        self._low = torch.tensor(space.low_in_model, dtype=torch.float32, device=device)
        self._free = torch.from_numpy(np.ascontiguousarray(space.free)).to(device)
        self._last = torch.tensor(space.free.shape, device=device) - 1
        self._cell_m = space.cell_m

    def __call__(self, gaussians: Gaussians, visible: Tensor) -> Tensor:
        """Return the mean opacity of the visible Gaussians (K,), of which those outside free space count as 0.

        The loss has no gradient by position: a Gaussian in free space fades, and does not move to the next surface.
        """
        cell = ((gaussians.means.detach()[visible] - self._low) / self._cell_m).floor().long()
        inside = ((cell >= 0) & (cell <= self._last)).all(dim=1)
        x, y, z = torch.minimum(cell.clamp_min(0), self._last).unbind(dim=1)
        floats = inside & self._free[x, y, z]
        opacity = torch.sigmoid(gaussians.logit_opacities[visible]).reshape(len(visible))
        return (opacity * floats).sum() / max(len(visible), 1)


_SIDE_BITS = 21  # of a cell's number along an axis
_AROUND = np.stack(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class MeasuredPlanes:
    """P planes in `model`: positions (P, 3) in metres, unit normals (P, 3), confidences (P,) 0 … 1.

    A Gaussian's confidence is a half at the distance s = `scale_m`; beyond two cells from all planes it has none.
    """

    position: FloatArray
    normal: FloatArray
    confidence: FloatArray
    scale_m: float
    cell_m: float


class PlaneAttraction:
    """Loss of the distances of Gaussians from the nearest of the planes, of which there is at least one."""

    def __init__(self, planes: MeasuredPlanes, device: torch.device) -> None:
        low = planes.position.min(axis=0) - planes.cell_m  # no cell around a plane has a negative number
        cell = np.floor((planes.position - low) / planes.cell_m).astype(np.int64)
        key = np.unique((np.unique(_keys(cell))[:, None] + _keys(_AROUND)).ravel())
        _, plane = cKDTree(planes.position).query(low + (_cells(key) + 0.5) * planes.cell_m)
        self._key = torch.from_numpy(key).to(device)
        tensors = (low, planes.position[plane], planes.normal[plane], planes.confidence[plane])
        self._corner, self._place, self._normal, self._confidence = (
            torch.from_numpy(values).float().to(device) for values in tensors
        )
        self._scale_m, self._cell_m = planes.scale_m, planes.cell_m

    def __call__(self, gaussians: Gaussians, visible: Tensor) -> Tensor:
        """Return the mean of α p ln(1 + d²/s²) over the visible Gaussians (K,): 0 for those far from all planes.

        p is the confidence in the plane, d the distance of the centre from it, and α the opacity, without gradient.
        """
        means = gaussians.means[visible]
        cell = ((means.detach() - self._corner) / self._cell_m).floor().long()
        key: Tensor = _keys(cell)
        row = torch.searchsorted(self._key, key).clamp_max(len(self._key) - 1)
        beside = (self._key[row] == key) & (cell >= 0).all(dim=1)
        off = ((means - self._place[row]) * self._normal[row]).sum(dim=1) / self._scale_m
        opacity = torch.sigmoid(gaussians.logit_opacities[visible]).reshape(len(visible)).detach()
        weight = opacity * self._confidence[row] * beside
        return (weight * torch.log1p(off.square())).sum() / max(len(visible), 1)


_Cells = Any  # array or tensor


def _keys(cell: _Cells) -> Any:
    """Return the keys of cells (N, 3), an array or a tensor; the key of a sum of cells is the sum of their keys."""
    return (cell[:, 0] << 2 * _SIDE_BITS) + (cell[:, 1] << _SIDE_BITS) + cell[:, 2]


def _cells(key: IntArray) -> IntArray:
    side = (1 << _SIDE_BITS) - 1
    return np.stack([key >> 2 * _SIDE_BITS, (key >> _SIDE_BITS) & side, key & side], axis=1)
