"""Gaussians as tensors, a row for each Gaussian, in the form in which they are optimised and stored; their files.

Also their transformation to another frame, and the detection of values that are not finite.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from pipelines.core.errors import ConvergenceError
from pipelines.core.types import Float32Array, Rows
from pipelines.formats.splat_ply import SplatArrays, read_splat_ply, write_splat_ply
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.splat import sh


@dataclass
class Gaussians(Rows):
    """N Gaussians in the `model` frame, float32 on one device."""

    means: Tensor  # (N, 3) centres in metres
    quats_wxyz: Tensor  # (N, 4) rotations (model ← principal axes), not necessarily of unit length
    log_scales: Tensor  # (N, 3) natural logarithm of σ along the principal axes, in metres
    logit_opacities: Tensor  # (N,) logit of the opacity
    sh: Tensor  # (N, K, 3) spherical-harmonic coefficients, K = (degree + 1)²; colour = 0.5 + Σ SH, clamped at 0

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name, in order."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def detached(self) -> Gaussians:
        return Gaussians(**{name: tensor.detach() for name, tensor in self.tensors().items()})

    def arrays(self) -> dict[str, Float32Array]:
        """Return the values as numpy arrays by name, for files."""
        return {name: tensor.detach().cpu().numpy() for name, tensor in self.tensors().items()}

    def select(self, index: Tensor) -> Gaussians:
        """Return the Gaussians of some rows, int64, or of a mask (N,)."""
        rows = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        # Twice as fast as `tensor[rows]`.
        return Gaussians(**{name: tensor.index_select(0, rows) for name, tensor in self.tensors().items()})

    def to(self, device: torch.device) -> Gaussians:
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
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


def write_gaussians(path: Path, gaussians: Gaussians, *, mip_filter: bool = False) -> None:
    """Write Gaussians, trained with the mip filter or not, as a 3DGS PLY; it appears whole or not at all."""
    write_splat_ply(path, SplatArrays(**gaussians.arrays()), mip_filter=mip_filter)


def read_gaussians(path: Path, rows: slice = slice(None)) -> Gaussians:
    """Read Gaussians from a 3DGS PLY; of a part of its rows, nothing else comes into memory.

    Raises:
        InputError: no such file, not a PLY of that form, cut off, or with values that are not finite.
    """
    return Gaussians(**{name: torch.tensor(values) for name, values in vars(read_splat_ply(path, rows)).items()})


def transformed(gaussians: Gaussians, target_from_source: Similarity) -> Gaussians:
    """Return the same Gaussians in another frame: a camera that moves along sees the same image.

    Centres are mapped (p_target = s R p_source + t), scales multiplied, rotations and the direction-dependent bands
    of the colours turned, in float64. The result has the input's type: the target's origin must lie near the scene.
    """
    device, kind = gaussians.means.device, gaussians.means.dtype
    turn = torch.as_tensor(target_from_source.rotation, dtype=torch.float64, device=device)
    shift = torch.as_tensor(target_from_source.translation, dtype=torch.float64, device=device)
    x, y, z, w = quat_xyzw_from_matrix(target_from_source.rotation).tolist()
    # Of the product of quaternions with the rotation on the left.
    product = [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]
    turn_quat = torch.tensor(product, dtype=torch.float64, device=device).view(4, 4)
    unit = torch.nn.functional.normalize(gaussians.quats_wxyz.double(), dim=1)
    return Gaussians(
        means=(target_from_source.scale * gaussians.means.double() @ turn.T + shift).to(kind),
        quats_wxyz=(unit @ turn_quat.T).to(kind),
        log_scales=(gaussians.log_scales.double() + math.log(target_from_source.scale)).to(kind),
        logit_opacities=gaussians.logit_opacities.clone(),
        sh=sh.rotate_sh(gaussians.sh, turn.cpu()),
    )


_NEVER = 2**62


class NonFiniteError(ConvergenceError):
    def __init__(self, name: str, iteration: int) -> None:
        self.name, self.iteration = name, iteration
        super().__init__("not-finite", f"the {name} is not finite at iteration {iteration}")


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
        """Wait for the device; a NonFiniteError names the earliest value that was not finite."""
        first = self._first.cpu()
        place = int(first.argmin())
        if int(first[place]) < _NEVER:
            raise NonFiniteError(self._names[place], int(first[place]))

    def reset(self) -> None:
        self._first.fill_(_NEVER)
