"""Gaussians as tensors, a row for each Gaussian, in the form in which they are optimised and stored."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from pipelines.core.types import Float32Array


@dataclass
class Gaussians:
    """N Gaussians in the `model` frame, float32 on one device.

    Attributes:
        means: (N, 3) centres in metres.
        quats_wxyz: (N, 4) rotations (model ← principal axes), not necessarily of unit length.
        log_scales: (N, 3) natural logarithm of the standard deviations along the principal axes, in metres.
        logit_opacities: (N,) logit of the opacity.
        sh: (N, K, 3) spherical-harmonic coefficients, K = (degree + 1)²; colour = 0.5 + Σ SH, clamped at 0.
    """

    means: Tensor
    quats_wxyz: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name, in order."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def detached(self) -> Gaussians:
        """Return the same values without gradient history."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.tensors().items()})

    def arrays(self) -> dict[str, Float32Array]:
        """Return the values as numpy arrays by name, for files."""
        return {name: tensor.detach().cpu().numpy() for name, tensor in self.tensors().items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Float32Array]) -> Gaussians:
        """Make Gaussians from arrays by the names of the attributes; copied."""
        return cls(**{field.name: torch.tensor(arrays[field.name]) for field in fields(cls)})

    def select(self, index: Tensor) -> Gaussians:
        """Return the rows that `index` (bool mask or integer) picks."""
        return Gaussians(**{name: tensor[index] for name, tensor in self.tensors().items()})

    def to(self, device: torch.device) -> Gaussians:
        """Return the same Gaussians on a device."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """Return all rows of `parts`, in order."""
        return Gaussians(
            **{name: torch.cat([part.tensors()[name] for part in parts]) for name in parts[0].tensors()}
        )


def rotation_matrices(quats_wxyz: Tensor) -> Tensor:
    """Return rotation matrices (N, 3, 3) of quaternions (N, 4) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats_wxyz, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)
