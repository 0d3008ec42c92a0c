"""Unknowns of a training's georeference as tensors: one vector of coordinates about the solution.

`adjust.root` gives the coordinates w, in which the χ² of all measurements is |w|². Similarity, cameras, lens and
systematic errors are functions of them. An iteration needs the pose of one camera, and pays a product with the few
rows of the factor on that camera's path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.root import InformationRoot
from pipelines.adjust.state import State
from pipelines.core.types import AutogradContext, IntArray
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity, perturbation
from pipelines.geometry.statistics import CAUCHY_SCALE2

RecordT = TypeVar("RecordT")


def exp_so3_tensor(rotation_vector: Tensor) -> Tensor:
    """Return the rotation matrices (…, 3, 3) of rotation vectors (…, 3), in radians.

    Rodrigues' formula is used, because `torch.linalg.matrix_exp` would wait for the device.
    """
    squared = rotation_vector.square().sum(dim=-1, keepdim=True)[..., None]
    angle = (squared + torch.finfo(squared.dtype).tiny).sqrt()  # the root has no derivative at zero
    x, y, z = rotation_vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*rotation_vector.shape[:-1], 3, 3)
    identity = torch.eye(3, dtype=cross.dtype, device=cross.device)
    linear, quadratic = torch.sinc(angle / math.pi), 0.5 * torch.sinc(0.5 * angle / math.pi).square()
    return identity + linear * cross + quadratic * (cross @ cross)


def cauchy(chi2: Tensor, dimension: int) -> Tensor:
    """Return Cauchy's ρ (N,) of squared whitened residuals (N,) of a dimension: c² ln(1 + χ²/c²)."""
    scale2 = CAUCHY_SCALE2[dimension]
    return scale2 * torch.log1p(chi2 / scale2)


def moved_tensors(record: RecordT, move: Callable[[Tensor], Tensor]) -> RecordT:
    """Return a dataclass with every tensor replaced by `move` of it, e.g. for another device."""
    tensors = {
        field.name: move(getattr(record, field.name))
        for field in fields(record)  # type: ignore[arg-type]
        if isinstance(getattr(record, field.name), Tensor)
    }
    return replace(record, **tensors)  # type: ignore[type-var]


@dataclass(frozen=True)
class TensorSimilarity:
    """Similarity in float64: p_geo = scale () · rotation (3, 3) p_model + translation (3,), metres."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Return the mapped points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class TensorPivot:
    """A pivot of the factor, `geometry.sparse_cholesky.Pivot`, as tensors."""

    eliminated: Tensor
    border: Tensor
    diagonal: Tensor
    below: Tensor


class _Coloured(torch.autograd.Function):
    """Product L⁻ᵀ v of coordinates (6 n,), at the rows of pivots that follow each other upwards in the factor L."""

    @staticmethod
    def forward(ctx: AutogradContext, v: Tensor, pivots: Sequence[TensorPivot]) -> Tensor:
        ctx.pivots = pivots
        solution = torch.zeros_like(v)
        for pivot in reversed(pivots):
            own = v[pivot.eliminated] - pivot.below.T @ solution[pivot.border]
            solution[pivot.eliminated] = _solved(pivot.diagonal.T, own, upper=True)
        return solution

    @staticmethod
    def backward(ctx: AutogradContext, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,) = gradients
        solution = gradient.clone()
        for pivot in ctx.pivots:
            own = _solved(pivot.diagonal, solution[pivot.eliminated], upper=False)
            solution[pivot.eliminated] = own
            solution[pivot.border] -= pivot.below @ own
        return solution, None


def _solved(triangle: Tensor, right: Tensor, *, upper: bool) -> Tensor:
    solution: Tensor = torch.linalg.solve_triangular(triangle, right[:, None], upper=upper)
    return solution[:, 0]


class SolutionUnknowns(torch.nn.Module):
    """Similarity, cameras, lens and systematic errors as functions of coordinates w about a solution, in float64.

    The photographs cannot see a similarity of the whole. What of a motion is one moves `geo_from_model`, and the
    cameras move by the rest: the mean of the SfM points stays where the Gaussians are.

    A test camera gives no gradient by its photograph. It moves by its correlation with the other cameras, and so
    does the lens.

    Args:
        base: poses as SfM left them.
        start: the solution, as corrections of these.
        root: of the information there; None: nothing moves.
        lens: (ℓ,) places of the lens parameters that move, among those of `start`.
    """

    def __init__(self, base: CameraPoses, start: State, root: InformationRoot | None, lens: IntArray) -> None:
        super().__init__()
        count, b = len(start.correction), 0 if root is None else len(root.border)
        lens = lens if b else lens[:0]
        self.start, self._lenses = start, len(lens)
        self.w = torch.nn.Parameter(torch.zeros(0 if root is None else root.size, dtype=torch.float64))
        arrays = {
            "base_rotation": base.cam_from_model,
            "base_center": base.cam_center_in_model,
            "correction": start.correction,
            "solved_lens": start.lens,
            "solved_errors": start.errors,
            "lens_rows": lens,
            "geo_rotation": start.geo_from_model.rotation,
            "geo_shift": start.geo_from_model.translation,
            "response": np.zeros((count, 6, 0)) if root is None else root.response.reshape(count, 6, b),
            "border": np.zeros((0, 0)) if root is None else root.border,
            "common": np.zeros((7, 0)) if root is None else root.similarity,
            "modes": np.zeros((count, 6, 7)) if root is None else root.modes,
            "pivot_in_model": np.zeros(3) if root is None else root.pivot,
            "turned": np.zeros((0, 0)) if root is None else root.turned,
            "turned_by": np.zeros((0, 0)) if root is None else root.turned_by,
        }
        for name, values in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(values)))
        pivots = () if root is None else root.pivots
        self._pivots = tuple(TensorPivot(*map(torch.from_numpy, vars(pivot).values())) for pivot in pivots)
        self._path = None if root is None else root.factor.path

    base_rotation: Tensor
    base_center: Tensor
    correction: Tensor
    solved_lens: Tensor
    solved_errors: Tensor
    lens_rows: Tensor
    geo_rotation: Tensor
    geo_shift: Tensor
    response: Tensor
    border: Tensor
    common: Tensor
    modes: Tensor
    pivot_in_model: Tensor
    turned: Tensor
    turned_by: Tensor

    @classmethod
    def frozen(cls, base: CameraPoses, start: State) -> SolutionUnknowns:
        """Return unknowns that nothing moves."""
        return cls(base, start, None, np.zeros(0, dtype=np.int64))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> SolutionUnknowns:
        """Move the factor between devices together with the parameters."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._pivots = tuple(moved_tensors(pivot, fn) for pivot in self._pivots)
        return self

    def chi2(self) -> Tensor:
        """Return the χ² that the present motion costs all measurements; scalar."""
        return self.w.square().sum()

    def _coordinates(self) -> Tensor:
        """Return v (6 n + b,) of `InformationRoot`."""
        if not self.turned_by.shape[0]:
            return self.w
        return self.w + self.turned @ (self.turned_by @ (self.turned.T @ self.w))

    def _of_border(self, v: Tensor) -> Tensor:
        return self.border @ v[len(v) - self.border.shape[0] :]

    def pose(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the rotation cam ← model (3, 3) and the centre (3,) of one camera."""
        if self._path is None:
            return self._posed(self.correction[index], index)
        v = self._coordinates()
        path = [self._pivots[place] for place in self._path(index)]
        own = _Coloured.apply(v[: 6 * len(self.correction)], path)[6 * index : 6 * index + 6]  # type: ignore[no-untyped-call]
        moved = own - self.response[index] @ self._of_border(v) - self.modes[index] @ (self.common @ v)
        return self._posed(self.correction[index] + moved, index)

    def corrections(self) -> Tensor:
        """Return the corrections (δω, δc) of all cameras (n, 6), rad and m, without a similarity of the whole."""
        if self._path is None:
            return self.correction
        v = self._coordinates()
        own: Tensor = _Coloured.apply(v[: 6 * len(self.correction)], self._pivots)  # type: ignore[no-untyped-call]
        return (
            self.correction + own.view(-1, 6) - self.response @ self._of_border(v) - self.modes @ (self.common @ v)
        )

    def _posed(self, correction: Tensor, index: int | slice) -> tuple[Tensor, Tensor]:
        turn = exp_so3_tensor(-correction[..., :3])
        return self.base_rotation[index] @ turn, self.base_center[index] + correction[..., 3:]

    def moved(self) -> tuple[Tensor, Tensor]:
        """Return the rotations cam ← model (n, 3, 3) and centres (n, 3) in `model` of all cameras, metres."""
        return self._posed(self.corrections(), slice(None))

    def cam_from_model(self, index: int) -> Tensor:
        """Return the pose of one camera, (4, 4) float32, differentiable in w."""
        rotation, center = self.pose(index)
        translation = -rotation @ center
        bottom = torch.eye(4, dtype=torch.float64, device=rotation.device)[3:]
        return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), bottom]).float()

    def lens(self) -> Tensor:
        """Return the change (L,) of the lens parameters, in the order of `geometry.cameras.Lenses`; L = 0: none."""
        if not self._lenses:
            return self.solved_lens
        moved = self._of_border(self._coordinates())[: self._lenses]
        return self.solved_lens.index_add(0, self.lens_rows, moved)

    def errors(self) -> Tensor:
        """Return the systematic errors (p,), in metres and radians."""
        if not self.border.shape[0]:
            return self.solved_errors
        return self.solved_errors + self._of_border(self._coordinates())[self._lenses :]

    def common_motion(self) -> Tensor:
        """Return the similarity (7,) (ln s, rotation, shift in metres) by which the whole moves in `model`."""
        return self.common @ self._coordinates()

    def similarity(self) -> TensorSimilarity:
        """Return the present `geo_from_model`, differentiable in w."""
        start, delta = self.start.geo_from_model, self.common_motion()
        turn, grow, pivot = exp_so3_tensor(delta[1:4]), torch.exp(delta[0]), self.pivot_in_model
        shift = pivot + delta[4:] - grow * (turn @ pivot)
        return TensorSimilarity(
            grow * start.scale,
            self.geo_rotation @ turn,
            start.scale * (self.geo_rotation @ shift) + self.geo_shift,
        )

    @torch.no_grad()
    def current_similarity(self) -> Similarity:
        """Return the present `geo_from_model`."""
        delta = self.common_motion().cpu().numpy()
        return self.start.geo_from_model @ perturbation(delta, self.pivot_in_model.cpu().numpy())

    @torch.no_grad()
    def state(self) -> State:
        """Return the present values as a state of the adjustment."""
        tensors = self.corrections(), self.lens(), self.errors()
        return State(self.current_similarity(), *(tensor.cpu().numpy() for tensor in tensors))
