"""Exposure of each photograph: an affine change of colour, fitted in training or adjusted from the points' colours.

Each lens darkens its corners besides: a polynomial of the squared distance from its axis, fitted in training.

Photographs of one flight differ in exposure and white balance: gains of the three channels, and what a camera's
processing mixes between them. Light changes slowly: a weak prior draws each photograph towards the mean of those
before and after it, which decides where its own colours do not. Without exposures, a model bakes these differences
into the colours of Gaussians that few views see. The images cannot tell a change of all exposures from a change of
all Gaussians: the mean over the training photographs is therefore fixed to the identity.

Without Gaussians, exposures follow from the colours of points that several photographs show: photograph i shows the
colour c of a point as A_i c + b_i. Robust least squares adjusts exposures and colours together, as a bundle
adjustment does with poses and points:

1. Linearised normal equations; the points are eliminated (Schur complement).
2. The reduced matrix couples photographs with common points only, in blocks of 12 × 12. Conjugate gradients solve
   it.
3. Cauchy's weights follow from the residuals: a point may shine, or move, in one of its photographs.

A weak prior keeps each exposure near the identity where a photograph has too few colours to determine it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.sparse import bsr_matrix
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole
from pipelines.robust.statistics import cauchy_weight, median_chi2

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

    The corrections, gain matrix and offset, of the images `train` (T,) change; the others are identities. `lens`
    (V,) tells the lens of each image by a number; None: all have one. Vignetting is that of `with_vignetting`. The
    order of the training images of a lens is that of their time.
    """

    def __init__(
        self, count: int, train: Tensor, iterations: int, device: torch.device, lens: Sequence[int] | None = None
    ) -> None:
        numbers = [0] * count if lens is None else list(lens)
        self.lenses = sorted(set(numbers))
        self._lens = [self.lenses.index(number) for number in numbers]
        self._affine = _RowsAdam(torch.eye(3, 4, device=device).repeat(count, 1, 1), iterations)
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
        if radius2 is not None:
            colour = with_vignetting(colour, radius2, falloff)
        return with_affine(colour, leaf)

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


def with_affine(colour: Tensor, affine: Tensor) -> Tensor:
    """Return A c + b of every colour c in (…, 3), for (A | b) in `affine` (3, 4)."""
    return colour @ affine[:, :3].T + affine[:, 3]


def with_vignetting(colour: Tensor, radius2: Tensor, coefficients: Tensor) -> Tensor:
    """Return colours (H, W, 3) as a lens with `coefficients` (terms,) shows them: c · (1 + r²(v₀ + r²(v₁ + …))).

    `radius2` (H, W) is the squared distance from the optical axis; see `squared_radius`.
    """
    factor = torch.zeros_like(radius2)
    for coefficient in reversed(coefficients.unbind()):
        factor = radius2 * (factor + coefficient)
    return colour * (1.0 + factor)[..., None]


@lru_cache(maxsize=_KEPT_RADII)
def squared_radius(camera: Pinhole, whole: Pinhole, device: torch.device) -> Tensor:
    """Return the squared distance (H, W) of a view's pixels from the optical axis; 1 in the furthest corner.

    The camera shows a part of the whole view, at the same focal length. All views of a camera share the tensor: it
    is read only.
    """

    def squared(of: Pinhole, x: Any, y: Any) -> Any:
        return ((x - of.cx) / of.fx) ** 2 + ((y - of.cy) / of.fy) ** 2

    furthest = max(squared(whole, x, y) for x in (0.0, whole.width) for y in (0.0, whole.height))
    x, y = (torch.arange(side, dtype=torch.float64, device=device) + 0.5 for side in (camera.width, camera.height))
    radius2: Tensor = squared(camera, x, y[:, None]) / furthest
    return radius2.float()


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


_CHUNK = 2**17  # observations whose points are eliminated together
_MOST_STEPS = 15
_CONVERGED = 5e-4  # change of an exposure that ends the adjustment: an eighth of a grey level
_STEP_TOLERANCE = 1e-3  # relative, of conjugate gradients: the next step corrects the rest
_LEAST_SIGMA = 1e-3  # of a colour: rounding to 256 levels
# σ of the prior: gain of a channel, leak from one channel to another, offset. A colour runs from 0 to 1.
_GAIN, _LEAK, _OFFSET = 0.5, 0.1, 0.2
_SIGMA = np.where(np.eye(3, 4, dtype=bool), _GAIN, _LEAK)
_SIGMA[:, 3] = _OFFSET


@dataclass(frozen=True)
class PointColours:
    """RGB (M, 3) from 0 to 1 of M observations of points in photographs, sorted by the index of the point."""

    point: IntArray
    image: IntArray
    colour: Float32Array


def adjusted_exposures(observed: PointColours, count: int) -> FloatArray:
    """Return the exposures (count, 3, 4): gain, offset (A | b); a DegenerateGeometryError: no point is seen twice.

    Points with one observation do not count. The mean over the photographs with observations is the identity. A
    photograph without observations has it too. Memory holds the coupled pairs of photographs, and the derivatives
    of one chunk of observations.
    """
    rays = np.bincount(observed.point)
    several = rays[observed.point] >= 2
    if not several.any():
        message = "No point is seen in two photographs: exposures cannot be compared."
        raise DegenerateGeometryError("no-common-points", message)
    point = np.unique(observed.point[several], return_inverse=True)[1]
    observed = PointColours(point, observed.image[several], observed.colour[several])
    seen = np.bincount(observed.image, minlength=count) > 0
    exposure = np.tile(np.eye(3, 4), (count, 1, 1))
    for _ in range(_MOST_STEPS):
        step = _step(observed, exposure)
        exposure = exposure + step
        if np.abs(step).max() < _CONVERGED:
            break
    # Other colours of the points make the mean of the exposures the identity.
    mean = exposure[seen].mean(axis=0)
    change = np.linalg.solve(mean[:, :3], np.column_stack([np.eye(3), -mean[:, 3]]))
    gain, offset = exposure[seen][:, :, :3], exposure[seen][:, :, 3:]
    exposure[seen] = np.concatenate([gain @ change[:, :3], gain @ change[:, 3:] + offset], axis=2)
    return exposure


def _step(observed: PointColours, exposure: FloatArray) -> FloatArray:
    """Return the Gauss–Newton step (n, 3, 4) of the exposures; the points' colours are eliminated."""
    count, numbers = len(exposure), 3 * len(observed.point)
    redundancy = numbers - 3 * int(observed.point[-1] + 1) - 12 * count
    squared = np.concatenate([part.squared for part in _parts(observed, exposure, None)])
    share = max(redundancy / numbers, 0.1)
    sigma2 = max(float(np.median(squared)) / median_chi2(3) / share, _LEAST_SIGMA**2)
    weight = cauchy_weight(squared / sigma2, 3) / sigma2
    precise = _SIGMA.ravel() ** -2.0
    own = np.tile(np.diag(precise), (count, 1, 1))
    slope = ((exposure - np.eye(3, 4)).reshape(count, 12) * precise).ravel()
    coupled: bsr_matrix | None = None
    for part in _parts(observed, exposure, weight):
        np.add.at(own, part.image, part.normal)
        size = (12 * count, 3 * part.points)
        order = np.lexsort((part.point, part.image))
        pointer = np.concatenate([[0], np.cumsum(np.bincount(part.image, minlength=count))])
        cross = bsr_matrix((part.cross[order], part.point[order], pointer), shape=size)
        slope += (
            np.bincount(
                (12 * part.image[:, None] + np.arange(12)).ravel(), part.slope.ravel(), minlength=12 * count
            )
            - cross @ part.of_points.ravel()
        )
        taken = (cross @ cross.T).tobsr((12, 12))
        coupled = taken if coupled is None else coupled + taken
    diagonal = bsr_matrix((own, np.arange(count), np.arange(count + 1)), shape=(12 * count, 12 * count))
    return -_solved((diagonal - coupled).tobsr((12, 12)), slope).reshape(count, 3, 4)


def _solved(matrix: bsr_matrix, right: FloatArray) -> FloatArray:
    """Return the solution of a positive definite system by conjugate gradients, preconditioned by its blocks."""
    count = matrix.shape[0] // 12
    row = np.repeat(np.arange(count), np.diff(matrix.indptr))
    on_diagonal = row == matrix.indices
    blocks = np.empty((count, 12, 12))
    blocks[row[on_diagonal]] = matrix.data[on_diagonal]
    inverse = np.linalg.inv(blocks)
    preconditioner = LinearOperator(
        matrix.shape, matvec=lambda vector: (inverse @ vector.reshape(count, 12, 1)).ravel(), dtype=np.float64
    )
    return np.asarray(cg(matrix, right, rtol=_STEP_TOLERANCE, M=preconditioner)[0])


@dataclass(frozen=True)
class _Part:
    """Normal equations of m observations of P points, which are whole tracks."""

    points: int
    point: IntArray  # (m,) from 0
    image: IntArray  # (m,)
    squared: FloatArray  # (m,) residuals, squared
    normal: FloatArray  # (m, 12, 12) of an exposure
    cross: FloatArray  # (m, 12, 3) of exposure and point, the latter whitened
    slope: FloatArray  # (m, 12) by the exposure
    of_points: FloatArray  # (P, 3) slope by the point, whitened


def _parts(observed: PointColours, exposure: FloatArray, weight: FloatArray | None) -> Iterator[_Part]:
    """Yield the normal equations by chunks of points, whose colours are the best under the exposures.

    Without the observations' weights (M,), all weights are equal.
    """
    last = np.cumsum(np.bincount(observed.point))
    first_point = first = 0
    while first_point < len(last):
        next_point = max(int(np.searchsorted(last, first + _CHUNK, side="right")), first_point + 1)
        rows = slice(first, int(last[next_point - 1]))
        w = np.ones(rows.stop - first) if weight is None else weight[rows]
        yield _part(
            observed.point[rows] - first_point,
            observed.image[rows],
            observed.colour[rows].astype(np.float64),
            exposure[observed.image[rows]],
            w,
        )
        first_point, first = next_point, rows.stop


def _part(point: IntArray, image: IntArray, colour: FloatArray, exposure: FloatArray, weight: FloatArray) -> _Part:
    gain, count = exposure[:, :, :3], int(point[-1]) + 1
    weighted_gain = weight[:, None, None] * np.swapaxes(gain, 1, 2)
    start = np.flatnonzero(np.diff(point, prepend=-1))
    normal = np.add.reduceat(weighted_gain @ gain, start)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    right = np.add.reduceat((weighted_gain @ (colour - exposure[:, :, 3])[:, :, None]), start)
    of_point = np.linalg.solve(normal, right)[:, :, 0]
    residual = (exposure @ np.append(of_point, np.ones((count, 1)), axis=1)[point][:, :, None])[:, :, 0] - colour
    known = np.append(of_point, np.ones((count, 1)), axis=1)[point]  # (m, 4)
    inverse_root = np.swapaxes(np.linalg.inv(np.linalg.cholesky(normal)), 1, 2)
    own = np.zeros((len(point), 3, 4, 3, 4))
    outer = weight[:, None, None] * known[:, :, None] * known[:, None, :]
    for channel in range(3):
        own[:, channel, :, channel] = outer
    white_gain = (weight[:, None, None] * gain) @ inverse_root[point]  # (m, 3, 3)
    cross = (white_gain[:, :, None, :] * known[:, None, :, None]).reshape(-1, 12, 3)
    by_point = np.add.reduceat(weighted_gain @ residual[:, :, None], start)
    return _Part(
        points=count,
        point=point,
        image=image,
        squared=(residual**2).sum(axis=1),
        normal=own.reshape(-1, 12, 12),
        cross=cross,
        slope=(weight[:, None, None] * residual[:, :, None] * known[:, None, :]).reshape(-1, 12),
        of_points=(np.swapaxes(inverse_root, 1, 2) @ by_point)[:, :, 0],
    )
