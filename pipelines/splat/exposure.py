"""Exposure of each photograph: an affine change of colour that training fits together with the Gaussians.

Photographs of one flight differ in exposure and white balance. Without exposures, a model bakes these differences
into the colours of Gaussians that few views see. The images cannot tell a change of all exposures from a change of
all Gaussians: the mean over the training photographs is therefore held at the identity.
"""

from __future__ import annotations

import torch
from torch import Tensor

_FIRST_RATE, _LAST_RATE = 5e-3, 5e-4
_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-15


class Exposures:
    """Affine colour corrections of all images, and the Adam that moves those of the training images.

    Attributes:
        affine: (V, 3, 4) gain matrix and offset of each image; the identity for images without a fit.

    Args:
        count: V.
        train: (T,) int64, the training images.
        iterations: length of the training, over which the rate falls.
        device: of the images.
    """

    def __init__(self, count: int, train: Tensor, iterations: int, device: torch.device) -> None:
        self.affine = torch.eye(3, 4, device=device).repeat(count, 1, 1)
        self._train, self._iterations = train.to(device), iterations
        self._moments = torch.zeros(2, count, 3, 4, device=device)
        self._steps = [0] * count
        self._used: tuple[int, Tensor] | None = None

    def apply(self, index: int, colour: Tensor) -> Tensor:
        """Return the render (H, W, 3) with the exposure of photograph `index`; differentiable, for `step`."""
        leaf = self.affine[index].clone().requires_grad_()
        self._used = (index, leaf)
        return with_affine(colour, leaf)

    def step(self, iteration: int) -> None:
        """Move the exposure that `apply` used last by its gradient, and restore the mean."""
        if self._used is None or self._used[1].grad is None:
            return
        index, leaf = self._used
        gradient, first, second = leaf.grad, self._moments[0, index], self._moments[1, index]
        assert gradient is not None
        self._steps[index] += 1
        steps, progress = self._steps[index], iteration / self._iterations
        rate = _FIRST_RATE ** (1 - progress) * _LAST_RATE**progress
        first.lerp_(gradient, 1 - _BETA1)
        second.lerp_(gradient.square(), 1 - _BETA2)
        unbiased = (second / (1 - _BETA2**steps)).sqrt_().add_(_EPS)
        self.affine[index] -= rate / (1 - _BETA1**steps) * first / unbiased
        shift = self.affine[self._train].mean(dim=0) - torch.eye(3, 4, device=leaf.device)
        self.affine[self._train] -= shift
        self._used = None

    def state(self) -> dict[str, Tensor]:
        """Return copies of exposures and moments, for a checkpoint."""
        return {
            "affine": self.affine.clone(),
            "moments": self._moments.clone(),
            "steps": torch.tensor(self._steps, dtype=torch.int64),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore a state."""
        self.affine.copy_(state["affine"])
        self._moments.copy_(state["moments"])
        self._steps = [int(count) for count in state["steps"]]


class HeldExposures:
    """Affine colour corrections of all images that do not move, in the place of `Exposures`.

    Attributes:
        affine: (V, 3, 4) gain matrix and offset of each image.
    """

    def __init__(self, affine: Tensor) -> None:
        self.affine = affine

    def apply(self, index: int, colour: Tensor) -> Tensor:
        """Return the render (H, W, 3) with the exposure of photograph `index`."""
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


def fitted_affine(rendered: Tensor, photograph: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the affine change of colour (3, 4) that maps a render to a photograph best, by least squares.

    Args:
        rendered: (H, W, 3).
        photograph: (H, W, 3).
        mask: (H, W) bool, the pixels to use; None: all.
    """
    x, y = (image.double().reshape(-1, 3) for image in (rendered, photograph))
    if mask is not None:
        x, y = x[mask.reshape(-1)], y[mask.reshape(-1)]
    design = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)
    # gelsd: the smallest solution if a render has too few colours to determine all twelve numbers.
    solution: Tensor = torch.linalg.lstsq(design.cpu(), y.cpu(), driver="gelsd").solution
    return solution.T.to(rendered)
