"""Detection of values that are not finite, without waiting for the device at every iteration."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pipelines.core.errors import ConvergenceError

_NEVER = 2**62


class NonFiniteError(ConvergenceError):
    """A loss or a gradient is not finite.

    Args:
        name: of the loss or gradient.
        iteration: the first with a value that is not finite.
    """

    def __init__(self, name: str, iteration: int) -> None:
        self.name, self.iteration = name, iteration
        super().__init__(f"the {name} is not finite at iteration {iteration}")


class FinitenessMonitor:
    """Records on the device, for each of several scalars, the first iteration at which it was not finite."""

    def __init__(self, names: tuple[str, ...], device: torch.device) -> None:
        self._names = names
        self._first = torch.full((len(names),), _NEVER, dtype=torch.int64, device=device)

    def note(self, iteration: int, values: Mapping[str, Tensor]) -> None:
        """Record this iteration's scalars, by name; a sum over a tensor stands for all of its values."""
        row = torch.stack([values[name].detach().double() for name in self._names])
        self._first = torch.where(torch.isfinite(row), self._first, self._first.clamp_max(iteration))

    def check(self) -> None:
        """Wait for the device and report the first value that was not finite.

        Raises:
            NonFiniteError: of the earliest iteration; of several scalars at once, the first by order of names.
        """
        first = self._first.cpu()
        place = int(first.argmin())
        if int(first[place]) < _NEVER:
            raise NonFiniteError(self._names[place], int(first[place]))

    def reset(self) -> None:
        """Forget all records."""
        self._first.fill_(_NEVER)
