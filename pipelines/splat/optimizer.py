"""Adam over the Gaussians: a learning rate for each quantity, updates of visible rows only, editable rows.

Rates are those of 3D Gaussian Splatting (doi 10.1145/3592433); the rate of the centres is in scene extents and
falls exponentially over the training. Unlike there, the other rates fall too, in the last part of the training: the
Gaussians come to rest, instead of moving about the place where the photographs have them.

Rows are added, and seen, at different times. Every row therefore counts its own updates, for the bias correction
that its moments need. With all rows in every step the result is plain Adam. Visiting only the rows that a view
sees, with all tensors of a row in one visit, saves the memory traffic that dominates Adam, and leaves the other
moments alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from pipelines.core.types import Float32Array, IntArray
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.kernel_cache import kernel

# ruff: noqa: PLR0917  (kernels take arrays, not objects)


@kernel(parallel=True, fastmath={"contract", "nsz"})
def adam_rows(
    rows: IntArray,  # (V,) int64
    places: IntArray,  # (V,) int64
    parameters: tuple[Float32Array, ...],  # (N, Dᵢ) float32
    gradients: tuple[Float32Array, ...],  # (M, Dᵢ) float32
    exp_avg: Float32Array,  # (N, D) float32
    exp_avg_sq: Float32Array,  # (N, D) float32
    steps: NDArray[np.int32],  # (N,) int32
    rates: Float32Array,  # (D,) float32
    corrections: Float32Array,  # (T, 2) float32
    betas: Float32Array,  # (4,) float32
    eps: np.float32,
) -> None:
    """Take one step of Adam (doi 10.48550/arXiv.1412.6980, alg. 1) on some rows, in place.

    Args:
        rows: (V,) rows to update, each at most once; places: (V,) those of their gradients.
        parameters, gradients: tuples of (N, Dᵢ) and (M, Dᵢ) arrays, float32.
        exp_avg, exp_avg_sq: (N, D) first and second moments, D = Σ Dᵢ.
        steps: (N,) int32, number of updates of each row so far.
        rates: (D,) learning rates.
        corrections: (T, 2), 1 / (1 − β₁ᵗ) and 1 / √(1 − β₂ᵗ); the last row serves all later steps.
        betas: (4,) β₁, 1 − β₁, β₂, 1 − β₂.
        eps: added to the denominator, of the parameters' type.
    """
    last = corrections.shape[0] - 1
    beta1, complement1, beta2, complement2 = betas[0], betas[1], betas[2], betas[3]
    for i in prange(rows.shape[0]):
        row = rows[i]
        steps[row] += 1
        step = min(steps[row], last)
        unbias1, unbias2 = corrections[step, 0], corrections[step, 1]
        first = 0
        for group in range(len(parameters)):
            parameter, gradient = parameters[group][row], gradients[group][places[i]]
            width = parameter.shape[0]
            average, square = exp_avg[row, first : first + width], exp_avg_sq[row, first : first + width]
            rate = rates[first : first + width]
            for k in range(width):
                g = gradient[k]
                m = beta1 * average[k] + complement1 * g
                v = beta2 * square[k] + complement2 * g * g
                average[k], square[k] = m, v
                parameter[k] -= rate[k] * (m * unbias1) / (np.sqrt(v) * unbias2 + eps)
            first += width


_REFERENCE_ITERATIONS = 30_000
# A training of 1/r of those iterations has rates that are r^p times as high, with a limit: p and limit of each.
_RAISED = {
    "means": (1 / 2, 6.0),
    "means_final": (1 / 2, 6.0),
    "quats_wxyz": (1 / 3, 4.0),
    "log_scales": (0.6, 8.0),
    "logit_opacities": (1 / 3, 4.0),
    "sh_dc": (1 / 3, 4.0),
    "sh_rest": (1.0, 12.0),
}
# All rates but the centres' fall exponentially from this fraction of the training on, to this share at its end.
_SETTLING_FROM, _SETTLED = 0.6, 0.1
_BETA1, _BETA2 = 0.9, 0.999  # decay of the first and of the second moment
EPS = 1e-15  # added to the denominator; tiny, because these gradients are tiny
_CORRECTED_STEPS = 20_000  # 0.999^20000 = 2e-9: below float32's resolution of 1


@dataclass(frozen=True)
class LearningRates:
    """Learning rates."""

    means: float = 1.6e-4  # first rate of the centres, in scene extents
    means_final: float = 1.6e-6  # last rate
    quats_wxyz: float = 1e-3
    log_scales: float = 5e-3
    logit_opacities: float = 5e-2
    sh_dc: float = 2.5e-3  # of the constant colour
    sh_rest: float = 1.25e-4  # of the direction-dependent colour

    @classmethod
    def for_iterations(cls, iterations: int) -> LearningRates:
        """Return the rates of 3DGS, made for 30 000 iterations, raised for shorter trainings.

        The rate limits the change of a Gaussian per step. At the rates of 3DGS, 600 iterations of a 48-image orbit
        (240 px, 20 000 Gaussians) leave holes between Gaussians that had no time to grow, and 18.1 dB on the test
        views. All rates raised 2, 4 and 8 times give 22.3, 26.8 and 23.7 dB. Sizes, places and direction-dependent
        colours bear more than 4 times, and gain by it (examples/benchmarks/results/training.md, Rates); opacities,
        constant colours and rotations gain nothing.
        """
        ratio = max(_REFERENCE_ITERATIONS / iterations, 1.0)
        return cls(
            **{name: min(ratio**power, most) * getattr(cls(), name) for name, (power, most) in _RAISED.items()}
        )


class GaussianAdam:
    """Gaussians under training and their moments, of which there are none at first.

    Attributes:
        gaussians: leaf tensors that require gradients; replaced by `rearrange`.
        shown: the Gaussians whose gradients the next step takes; see `show`.
        extent_m: size of the scene, the unit of the centres' rate.
        iterations: length of the training, over which that rate falls.
        rates: by default those of 3DGS, raised for trainings shorter than its own.
        rate_factor: of all learning rates; lowered after a divergence.
    """

    def __init__(
        self, gaussians: Gaussians, extent_m: float, iterations: int, rates: LearningRates | None = None
    ) -> None:
        self.rates = rates or LearningRates.for_iterations(iterations)
        self.extent_m = extent_m
        self.iterations = iterations
        self.rate_factor = 1.0
        copies = {name: tensor.detach().clone() for name, tensor in gaussians.tensors().items()}
        self.gaussians = self.shown = _leaves(Gaussians(**copies))
        self._rows: Tensor | None = None  # of `shown`; None: all
        count, width = len(gaussians), sum(math.prod(values.shape[1:]) for values in gaussians.tensors().values())
        self._exp_avg = gaussians.means.new_zeros(count, width)
        self._exp_avg_sq = torch.zeros_like(self._exp_avg)
        self._steps = torch.zeros(count, dtype=torch.int32, device=gaussians.means.device)
        self._corrections = _bias_corrections().to(gaussians.means.device)

    def show(self, rows: Tensor | None = None) -> Gaussians:
        """Return some Gaussians (M,) without gradients, for a render: copies of their rows; None: all themselves.

        Gradients of few rows spare those of all others: allocated, cleared and added up at every iteration.
        """
        self._rows = rows
        if rows is None:
            self.shown = self.gaussians
            for tensor in self.shown.tensors().values():
                tensor.grad = None
        else:
            self.shown = _leaves(self.gaussians.detached().select(rows))
        return self.shown

    def step(self, iteration: int, rows: Tensor | None = None) -> None:
        """Update the rows (V,) int64 without repetition of `shown` (a render's visible Gaussians; None: all) by the
        tensors' `.grad`.

        Raises:
            ValueError: a tensor has no gradient.
        """
        tensors = self.shown.tensors()
        missing = [name for name, tensor in tensors.items() if tensor.grad is None]
        if missing:
            raise ValueError(f"{', '.join(missing)}: no gradient; call backward() first")
        if rows is None:
            rows = torch.arange(len(self.shown), device=self._steps.device)
        with torch.no_grad():
            if self._steps.device.type == "cpu":
                self._step_by_kernel(iteration, rows)
            else:
                self._step_by_tensors(iteration, rows)

    def means_rate(self, iteration: int) -> float:
        """Return the learning rate of the centres, in metres."""
        progress = min(iteration / max(self.iterations, 1), 1.0)
        falling = float(self.rates.means ** (1 - progress) * self.rates.means_final**progress)
        return self.rate_factor * falling * self.extent_m

    def rearrange(self, gaussians: Gaussians, source: Tensor) -> None:
        """Replace all rows by N' Gaussians, whose `source` (N',) is their former row, or −1.

        Surviving rows keep their moments, new rows start without. The tensors are taken over, not copied.
        """
        new, former = source < 0, source.clamp_min(0)
        self.gaussians = self.shown = _leaves(gaussians.detached())
        self._rows = None

        def moved(moments: Tensor) -> Tensor:
            kept = moments.index_select(0, former)
            kept[new] = 0
            return kept

        self._exp_avg, self._exp_avg_sq = moved(self._exp_avg), moved(self._exp_avg_sq)
        self._steps = moved(self._steps)

    def overwrite(self, name: str, values: Tensor) -> None:
        """Give one tensor of the Gaussians new values (N, …) and forget its moments."""
        with torch.no_grad():
            self.gaussians.tensors()[name].copy_(values)
        columns = self._columns()[name]
        self._exp_avg[:, columns] = 0
        self._exp_avg_sq[:, columns] = 0

    def state(self) -> dict[str, Tensor]:
        """Return copies of the moments, for a checkpoint; their owner saves the Gaussians themselves."""
        return {name: tensor.clone() for name, tensor in self._moments().items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the moments of `state`; a ValueError says that their number or degree is another."""
        for name, tensor in self._moments().items():
            if name not in state or state[name].shape != tensor.shape:
                raise ValueError(f"{name}: expected a tensor of shape {tuple(tensor.shape)}")
            tensor.copy_(state[name])

    def _moments(self) -> dict[str, Tensor]:
        return {"exp_avg": self._exp_avg, "exp_avg_sq": self._exp_avg_sq, "steps": self._steps}

    def _columns(self) -> dict[str, slice]:
        columns, first = {}, 0
        for name, tensor in self.gaussians.tensors().items():
            columns[name] = slice(first, first + math.prod(tensor.shape[1:]))
            first = columns[name].stop
        return columns

    def _column_rates(self, iteration: int) -> Tensor:
        base, columns = self.rates, self._columns()
        rates = self._exp_avg.new_empty(self._exp_avg.shape[1])
        for name in ("quats_wxyz", "log_scales", "logit_opacities"):
            rates[columns[name]] = getattr(base, name)
        rates[columns["sh"]] = base.sh_rest
        rates[columns["sh"]][:3] = base.sh_dc
        progress = min(iteration / max(self.iterations, 1), 1.0)
        settling = _SETTLED ** (max(progress - _SETTLING_FROM, 0.0) / (1 - _SETTLING_FROM))
        rates *= self.rate_factor * settling
        rates[columns["means"]] = self.means_rate(iteration)
        return rates

    def _step_by_kernel(self, iteration: int, places: Tensor) -> None:
        tensors, visible = self.gaussians.tensors().values(), self.shown.tensors().values()
        parameters, gradients = (
            tuple(part.detach().contiguous().numpy().reshape(len(part), -1) for part in parts if part is not None)
            for parts in (tensors, [tensor.grad for tensor in visible])
        )
        rows = places if self._rows is None else self._rows[places]
        betas = np.array([_BETA1, 1 - _BETA1, _BETA2, 1 - _BETA2], dtype=np.float32)
        adam_rows(
            rows.contiguous().numpy(),
            places.contiguous().numpy(),
            parameters,
            gradients,
            self._exp_avg.numpy(),
            self._exp_avg_sq.numpy(),
            self._steps.numpy(),
            self._column_rates(iteration).numpy(),
            self._corrections.numpy(),
            betas,
            np.float32(EPS),
        )

    def _step_by_tensors(self, iteration: int, places: Tensor) -> None:
        """Take the same step by torch operations, for devices that the kernel does not run on.

        All quantities of a row are updated together: five times as few operations as one quantity after the other.
        """
        tensors, visible, columns = self.gaussians.tensors(), self.shown.tensors(), self._columns()
        rows = places if self._rows is None else self._rows[places]
        self._steps[rows] += 1
        unbias = self._corrections[self._steps[rows].long().clamp_max(len(self._corrections) - 1)]
        grads = [tensor.grad for tensor in visible.values()]
        parts = [grad[places].reshape(len(rows), -1) for grad in grads if grad is not None]
        gradient = torch.cat(parts, dim=1)
        average = self._exp_avg[rows].lerp_(gradient, 1 - _BETA1)
        square = self._exp_avg_sq[rows].lerp_(gradient * gradient, 1 - _BETA2)
        self._exp_avg[rows], self._exp_avg_sq[rows] = average, square
        scale = square.sqrt_().mul_(unbias[:, 1:]).add_(EPS)
        change = average.mul_(unbias[:, :1]).mul_(self._column_rates(iteration)).div_(scale)
        for name, tensor in tensors.items():
            tensor.index_add_(0, rows, change[:, columns[name]].reshape(len(rows), *tensor.shape[1:]), alpha=-1)


def _leaves(gaussians: Gaussians) -> Gaussians:
    tensors = gaussians.tensors()
    return Gaussians(**{name: tensor.contiguous().requires_grad_() for name, tensor in tensors.items()})


def _bias_corrections() -> Tensor:
    step = torch.arange(_CORRECTED_STEPS, dtype=torch.float64)
    step[0] = 1.0  # never used: a row's first update is its step 1
    columns = [1 / (1 - _BETA1**step), 1 / (1 - _BETA2**step).sqrt()]
    return torch.stack(columns, dim=1).float()
