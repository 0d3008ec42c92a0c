"""Adam for what all views share: similarity, cameras, constant errors and weights of the losses."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pipelines.train.geographic.problem import GeoProblem
from pipelines.train.schedule import JointOptions

_NAMES = {
    "y": "the similarity",
    "z": "the cameras",
    "x": "the systematic errors",
    "u": "the weights of the losses",
}
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class GeographicAdam:
    """Moments and rates of the unknowns of a problem.

    Args:
        problem: has the unknowns.
        options: have their rates.
        device: holds them.
    """

    def __init__(self, problem: GeoProblem, options: JointOptions, device: torch.device) -> None:
        self._problem, self._device = problem, device
        rates = {
            "y": options.similarity_rate,
            "z": options.camera_rate,
            "x": options.similarity_rate,
            "u": options.variance_rate,
        }
        # One kernel for each of these short vectors on a GPU, in place of a dozen whose launches take longer than
        # their work.
        self._adam = torch.optim.Adam(
            [{"params": [parameter], "rate": rates[name]} for name, parameter in problem.learned().items()],
            fused=device.type == "cuda",
        )

    def named(self) -> dict[str, Tensor]:
        """Return the unknowns by what they are called in messages."""
        return {_NAMES[name]: parameter for name, parameter in self._problem.learned().items()}

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self._adam.zero_grad()

    def step(self, factor: float) -> None:
        """Move all unknowns by their gradients, at their rates times `factor`."""
        for group in self._adam.param_groups:
            group["lr"] = factor * group["rate"]
        self._adam.step()

    def state(self) -> dict[str, Tensor]:
        """Return unknowns and moments by name, for a checkpoint."""
        parameters = self._problem.learned()
        state: dict[str, Tensor] = {**parameters}
        for name, parameter in parameters.items():
            moments = self._adam.state[parameter]
            state |= {f"{name}_{key}": torch.as_tensor(value) for key, value in moments.items()}
        return state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Restore unknowns and moments."""
        for name, parameter in self._problem.learned().items():
            with torch.no_grad():
                parameter.copy_(state[name])
            # A fused Adam keeps its count of steps on the device.
            self._adam.state[parameter] = {
                key: state[f"{name}_{key}"].to(self._device) for key in _MOMENTS if f"{name}_{key}" in state
            }
