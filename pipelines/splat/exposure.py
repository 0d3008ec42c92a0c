"""Exposure of each photograph: an affine change of colour, fitted in training or adjusted from the points' colours.

Each lens darkens its corners besides: a polynomial of the squared distance from its axis, fitted in training.

Photographs of one flight differ in exposure and white balance: gains of the three channels, and what a camera's
processing mixes between them. Light changes slowly: a weak prior draws each photograph towards the mean of those
before and after it, which decides where its own colours do not. Without exposures, a model bakes these differences
into the colours of Gaussians that few views see. The images cannot tell a change of all exposures from a change of
all Gaussians: the mean over the training photographs is therefore fixed to the identity.

Without Gaussians, the gains of the channels follow from the colours of points that several photographs show. Such
points are of few colours: grey roads and green lawns do not tell what a camera mixes between its channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipelines.core.types import (
    Array34,
    ArrayN,
    ArrayNK,
    ArrayNK3,
    AutogradContext,
    Float32Array,
    FloatArray,
    IntArray,
)
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.statistics import cauchy_weight, median_chi2
from pipelines.splat.kernel_cache import kernel

_FIRST_RATE, _LAST_RATE = 5e-3, 5e-4
VIGNETTING_TERMS = 3  # of r², r⁴, r⁶
# Weight of the prior: it decides what the colours leave open. One of 0.1 cost 0.1 dB of the test views, where gains
# differed by 10 % from photograph to photograph.
_TIE = 0.003
_KEPT_RADII = 8  # sizes of cameras and of their crops
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15


class _RowsAdam:
    """Rows of a tensor, each with an Adam of its own, whose rate falls over the iterations."""

    def __init__(self, values: Tensor, iterations: int) -> None:
        self.values, self._iterations = values, iterations
        self._moments = torch.zeros(2, *values.shape, device=values.device)
        self._steps = [0] * len(values)

    def step(self, row: int, gradient: Tensor, iteration: int) -> None:
        first, second = self._moments[0, row], self._moments[1, row]
        self._steps[row] += 1
        steps, progress = self._steps[row], iteration / self._iterations
        rate = _FIRST_RATE ** (1 - progress) * _LAST_RATE**progress
        first.lerp_(gradient, 1 - _BETA1)
        second.lerp_(gradient.square(), 1 - _BETA2)
        unbiased = (second / (1 - _BETA2**steps)).sqrt_().add_(_EPS)
        self.values[row] -= rate / (1 - _BETA1**steps) * first / unbiased

    def state(self, name: str) -> dict[str, Tensor]:
        steps = torch.tensor(self._steps, dtype=torch.int64)
        return {name: self.values.clone(), f"{name}_moments": self._moments.clone(), f"{name}_steps": steps}

    def restore(self, name: str, state: dict[str, Tensor]) -> None:
        self.values.copy_(state[name])
        self._moments.copy_(state[f"{name}_moments"])
        self._steps = [int(count) for count in state[f"{name}_steps"]]


class Exposures:
    """Affine colour corrections (V, 3, 4) of V images, and the vignetting of their lenses, with their optimiser.

    The corrections, gain matrix and offset, of the images `train` (T,) change, from `start` (V, 3, 4) on. `lens`
    (V,) tells the lens of each image by a number; None: all have one. Vignetting is that of `with_vignetting`. The
    order of the training images of a lens is that of their time.
    """

    def __init__(self, start: Tensor, train: Tensor, iterations: int, lens: Sequence[int] | None = None) -> None:
        count, device = len(start), start.device
        numbers = [0] * count if lens is None else list(lens)
        self.lenses = sorted(set(numbers))
        self._lens = [self.lenses.index(number) for number in numbers]
        self._affine = _RowsAdam(start.clone(), iterations)
        self._vignetting = _RowsAdam(torch.zeros(len(self.lenses), VIGNETTING_TERMS, device=device), iterations)
        self._train = train.to(device)
        self._beside = _neighbours(train.tolist(), self._lens)
        self._used: tuple[int, Tensor, Tensor] | None = None

    @property
    def affine(self) -> Tensor:
        return self._affine.values

    @property
    def vignetting(self) -> Tensor:
        """Coefficients (L, terms) of `lenses`."""
        return self._vignetting.values

    def apply(self, index: int, colour: Tensor, radius2: Tensor | None = None) -> Tensor:
        """Return the render (H, W, 3) as photograph `index` shows it; differentiable, for `step`.

        `radius2` (H, W) is that of `with_vignetting`; None: the light does not fall off.
        """
        leaf = self.affine[index].clone().requires_grad_()
        falloff = self.vignetting[self._lens[index]].clone().requires_grad_()
        self._used = (index, leaf, falloff)
        if radius2 is None:
            return with_affine(colour, leaf)
        if colour.device.type == "cpu" and colour.dtype == radius2.dtype == leaf.dtype:
            shown: Tensor = _Exposed.apply(colour, radius2, leaf, falloff)  # type: ignore[no-untyped-call]
            return shown
        return with_affine(with_vignetting(colour, radius2, falloff), leaf)

    def step(self, iteration: int) -> None:
        """Change the exposure and the lens that `apply` used last, and restore the mean over the images."""
        if self._used is None or self._used[1].grad is None:
            return
        index, leaf, falloff = self._used
        assert leaf.grad is not None
        gradient = leaf.grad
        if beside := self._beside.get(index):
            gradient = gradient + _TIE * (self.affine[index] - self.affine[beside].mean(dim=0))
        self._affine.step(index, gradient, iteration)
        if falloff.grad is not None:
            self._vignetting.step(self._lens[index], falloff.grad, iteration)
        shift = self.affine[self._train].mean(dim=0) - torch.eye(3, 4, device=leaf.device)
        self.affine[self._train] -= shift
        self._used = None

    def state(self) -> dict[str, Tensor]:
        return self._affine.state("affine") | self._vignetting.state("vignetting")

    def restore(self, state: dict[str, Tensor]) -> None:
        self._affine.restore("affine", state)
        self._vignetting.restore("vignetting", state)


def _neighbours(images: Sequence[int], lens: Sequence[int]) -> dict[int, list[int]]:
    """Return the images before and after each, of the same lens."""
    beside: dict[int, list[int]] = {image: [] for image in images}
    for number in set(lens):
        for before, after in pairwise(image for image in images if lens[image] == number):
            beside[before].append(after)
            beside[after].append(before)
    return beside


class FrozenExposures:
    """Affine colour corrections (V, 3, 4) of all images that stay as given, with the interface of `Exposures`."""

    def __init__(self, affine: Tensor) -> None:
        self.affine = affine

    def apply(self, index: int, colour: Tensor, radius2: Tensor | None = None) -> Tensor:
        return with_affine(colour, self.affine[index])

    def step(self, iteration: int) -> None:
        """Leave the exposures as they are."""

    def state(self) -> dict[str, Tensor]:
        """Return no tensors: nothing changes between checkpoints."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Accept the state of `state`, which is empty."""


class _Exposed(torch.autograd.Function):
    """`with_affine` of `with_vignetting` on a CPU: one pass over the pixels in place of forty."""

    @staticmethod
    def forward(
        ctx: AutogradContext, colour: Tensor, radius2: Tensor, affine: Tensor, coefficients: Tensor
    ) -> Tensor:
        inputs = [tensor.contiguous() for tensor in (colour, radius2, affine, coefficients)]
        ctx.save_for_backward(*inputs)
        shown = torch.empty_like(inputs[0])
        expose(*(tensor.detach().numpy() for tensor in inputs), shown.numpy())
        return shown

    @staticmethod
    @once_differentiable
    def backward(ctx: AutogradContext, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        saved, gradient = ctx.saved_tensors, grad_outputs[0].contiguous()
        colour, _, affine, coefficients = saved
        of_colour = torch.empty_like(colour)
        mixing = torch.empty(len(colour), *affine.shape, dtype=torch.float64)
        falling = torch.empty(len(colour), len(coefficients), dtype=torch.float64)
        outputs = (of_colour, mixing, falling)
        expose_gradient(*(tensor.detach().numpy() for tensor in (*saved, gradient, *outputs)))
        return of_colour, None, mixing.sum(dim=0).to(affine), falling.sum(dim=0).to(coefficients)


# ruff: noqa: PLR0917  (kernels take arrays, not objects)
@njit(nogil=True, error_model="numpy", inline="always")
def _light(
    far: float,
    coefficients: ArrayN,  # (terms,) float32/64
) -> float:
    """Return the share of the light at a squared radius."""
    light = 0.0
    for k in range(coefficients.shape[0] - 1, -1, -1):
        light = far * (light + coefficients[k])
    return light + 1.0


@kernel(parallel=True, error_model="numpy")
def expose(
    colour: ArrayNK3,  # (H, W, 3) float32/64
    radius2: ArrayNK,  # (H, W) float32/64
    affine: Array34,  # (3, 4) float32/64
    coefficients: ArrayN,  # (terms,) float32/64
    shown: ArrayNK3,  # (H, W, 3) float32/64
) -> None:
    """Write `with_affine` of `with_vignetting` of colours into `shown` (H, W, 3), rows over threads."""
    for row in prange(colour.shape[0]):
        for i in range(colour.shape[1]):
            far = float(radius2[row, i])
            light = _light(far, coefficients)
            red, green, blue = light * colour[row, i, 0], light * colour[row, i, 1], light * colour[row, i, 2]
            for c in range(3):
                mixed = affine[c, 0] * red + affine[c, 1] * green + affine[c, 2] * blue
                shown[row, i, c] = mixed + affine[c, 3]


@kernel(parallel=True, error_model="numpy")
def expose_gradient(
    colour: ArrayNK3,  # (H, W, 3) float32/64
    radius2: ArrayNK,  # (H, W) float32/64
    affine: Array34,  # (3, 4) float32/64
    coefficients: ArrayN,  # (terms,) float32/64
    gradient: ArrayNK3,  # (H, W, 3) float32/64
    of_colour: ArrayNK3,  # (H, W, 3) float32/64
    mixing: ArrayNK3,  # (H, 3, 4) float64
    falling: ArrayNK,  # (H, terms) float64
) -> None:
    """Write the gradients of colours, and of each row by affine change and vignetting, given that of `shown`.

    Sums over rows are the caller's: their order must not depend on the threads.
    """
    for row in prange(colour.shape[0]):
        mixing[row], falling[row] = 0.0, 0.0
        for i in range(colour.shape[1]):
            far = float(radius2[row, i])
            light = _light(far, coefficients)
            red, green, blue = gradient[row, i, 0], gradient[row, i, 1], gradient[row, i, 2]
            of_light = 0.0
            for c in range(3):
                back = affine[0, c] * red + affine[1, c] * green + affine[2, c] * blue
                level = float(colour[row, i, c])
                of_colour[row, i, c] = light * back
                of_light += back * level
                mixing[row, 0, c] += red * light * level
                mixing[row, 1, c] += green * light * level
                mixing[row, 2, c] += blue * light * level
            mixing[row, 0, 3] += red
            mixing[row, 1, 3] += green
            mixing[row, 2, 3] += blue
            for k in range(coefficients.shape[0]):
                of_light *= far
                falling[row, k] += of_light


_Values = Any  # a number, an array or a tensor


def with_affine(colour: Tensor, affine: Tensor) -> Tensor:
    """Return A c + b of every colour c in (…, 3), for (A | b) in `affine` (3, 4)."""
    return colour @ affine[:, :3].T + affine[:, 3]


def with_vignetting(colour: Tensor, radius2: Tensor, coefficients: Tensor) -> Tensor:
    """Return colours (H, W, 3) as a lens with `coefficients` (terms,) shows them: c · (1 + r²(v₀ + r²(v₁ + …))).

    `radius2` (H, W) is the squared distance from the optical axis; see `squared_radius`.
    """
    vignetted: Tensor = colour * falloff(radius2, coefficients.unbind())[..., None]
    return vignetted


def falloff(radius2: _Values, coefficients: Sequence[_Values]) -> Any:
    """Return the vignetting 1 + r²(v₀ + r²(v₁ + …)) of squared radii, a tensor or an array, by its terms."""
    factor = 0.0 * radius2
    for coefficient in reversed(coefficients):
        factor = radius2 * (factor + coefficient)
    return 1.0 + factor


@lru_cache(maxsize=_KEPT_RADII)
def squared_radius(camera: Pinhole, whole: Pinhole, device: torch.device) -> Tensor:
    """Return the squared distance (H, W) of a view's pixels from the optical axis; 1 in the furthest corner.

    The camera shows a part of the whole view, at the same focal length. All views of a camera share the tensor: it
    is read only.
    """

    x, y = (torch.arange(side, dtype=torch.float64, device=device) + 0.5 for side in (camera.width, camera.height))
    radius2: Tensor = squared_radius_at(x, y[:, None], camera, whole)
    return radius2.float()


def squared_radius_at(x: _Values, y: _Values, camera: Pinhole, whole: Pinhole) -> Any:
    """Return the squared distance of pixels x, y of a camera from the optical axis, as `squared_radius`."""

    def squared(of: Pinhole, x: _Values, y: _Values) -> Any:
        return ((x - of.cx) / of.fx) ** 2 + ((y - of.cy) / of.fy) ** 2

    furthest = max(squared(whole, x, y) for x in (0.0, whole.width) for y in (0.0, whole.height))
    return squared(camera, x, y) / furthest


def fitted_affine(rendered: Tensor, photograph: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the affine change of colour (3, 4) that maps a render to a photograph (H, W, 3) by least squares.

    The `mask` (H, W) tells the pixels to use; None: all.
    """
    x, y = (image.double().reshape(-1, 3) for image in (rendered, photograph))
    if mask is not None:
        x, y = x[mask.reshape(-1)], y[mask.reshape(-1)]
    design = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)
    # gelsd: the smallest solution if a render has too few colours to determine all twelve numbers.
    solution: Tensor = torch.linalg.lstsq(design.cpu(), y.cpu(), driver="gelsd").solution
    return solution.T.to(rendered)


_ROUNDS = 10  # of robust weights
_CONVERGED = 5e-4  # change of a gain that ends the adjustment: an eighth of a grey level
_LEAST_SIGMA = 1e-3  # of a colour: rounding to 256 levels
_GAIN = 0.5  # σ of the prior of a gain's logarithm


@dataclass(frozen=True)
class PointColours:
    """RGB (M, 3) above 0 up to 1 of M observations of points (M,) in photographs (M,)."""

    point: IntArray
    image: IntArray
    colour: Float32Array


def adjusted_exposures(observed: PointColours, count: int, reference: IntArray) -> FloatArray:
    """Return the exposures (count, 3, 4) of photographs: a gain for each channel, from the colours of points.

    Photograph i shows the colour c of a point as g_i c. Logarithms make that linear; weighted least squares adjusts
    gains and colours together, with Cauchy's weights: a point may shine, or move, in one of its photographs. The
    mean over the photographs of reference with observations is the identity, as is a photograph without any.
    """
    gain = np.ones((count, 3))
    several = np.bincount(observed.point)[observed.point] >= 2
    if not several[np.isin(observed.image, reference)].any():
        return _diagonal(gain)
    point = np.unique(observed.point[several], return_inverse=True)[1]
    image, colour = observed.image[several], observed.colour[several].astype(np.float64)
    points, logarithm = int(point.max()) + 1, np.log(colour)
    redundancy = max(1 - (points + count) / len(point), 0.1)
    weight, log_gain = colour**2, np.zeros((count, 3))  # colours, not their logarithms, have the same noise
    for _ in range(_ROUNDS):
        before = log_gain
        log_gain = np.column_stack(
            [_log_gains(point, image, logarithm[:, k], weight[:, k], count) for k in range(3)]
        )
        corrected = logarithm - log_gain[image]
        total = np.column_stack([np.bincount(point, weight[:, k]) for k in range(3)])
        mean = np.column_stack([np.bincount(point, weight[:, k] * corrected[:, k]) for k in range(3)]) / total
        squared = ((corrected - mean[point]) ** 2 * colour**2).sum(axis=1)
        sigma2 = max(float(np.median(squared)) / median_chi2(3) / redundancy, _LEAST_SIGMA**2)
        weight = colour**2 * cauchy_weight(squared / sigma2, 3)[:, None]
        if np.abs(log_gain - before).max() < _CONVERGED:
            break
    seen = np.bincount(image, minlength=count) > 0
    gain[seen] = np.exp(log_gain[seen])
    gain[seen] /= gain[reference[seen[reference]]].mean(axis=0)
    return _diagonal(gain)


def _log_gains(
    point: IntArray, image: IntArray, logarithm: FloatArray, weight: FloatArray, count: int
) -> FloatArray:
    """Return the logarithms (count,) of one channel's gains; the points' colours are eliminated."""
    of_points = np.bincount(point, weight)
    seen = csr_matrix((weight, (point, image)), shape=(len(of_points), count))
    prior = weight.mean() * _LEAST_SIGMA**2 / _GAIN**2
    normal = diags(np.bincount(image, weight, count) + prior) - seen.T @ diags(1 / of_points) @ seen
    mean = np.bincount(point, weight * logarithm) / of_points
    return np.asarray(spsolve(normal.tocsc(), np.bincount(image, weight * logarithm, count) - seen.T @ mean))


def _diagonal(gain: FloatArray) -> FloatArray:
    return gain[:, :, None] * np.eye(3, 4)
