"""Free space: cells of the scene in which a scanner's beams met nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import BoolArray, FloatArray
from pipelines.splat.gaussians import Gaussians


@dataclass(frozen=True)
class FreeSpace:
    """Grid in `model`.

    Attributes:
        low_in_model: (3,) low corner in metres.
        cell_m: side of the cells.
        free: (X, Y, Z) whether a cell is free.
    """

    low_in_model: FloatArray
    cell_m: float
    free: BoolArray

    def share(self) -> float:
        """Return the share of the cells that are free, 0 … 1."""
        return float(self.free.mean())


class FreeSpaceLoss:
    """Loss of Gaussians in free space.

    Args:
        space: the grid.
        device: of the Gaussians.
    """

    def __init__(self, space: FreeSpace, device: torch.device) -> None:
        self._low = torch.tensor(space.low_in_model, dtype=torch.float32, device=device)
        self._free = torch.from_numpy(np.ascontiguousarray(space.free)).to(device)
        self._last = torch.tensor(space.free.shape, device=device) - 1
        self._cell_m = space.cell_m

    def __call__(self, gaussians: Gaussians, visible: Tensor) -> Tensor:
        """Return the mean opacity of the visible Gaussians (K,), of which those outside free space count as 0.

        The loss has no gradient by places: a Gaussian fades, rather than move to the surface that it belongs to.
        """
        cell = ((gaussians.means.detach()[visible] - self._low) / self._cell_m).floor().long()
        inside = ((cell >= 0) & (cell <= self._last)).all(dim=1)
        x, y, z = torch.minimum(cell.clamp_min(0), self._last).unbind(dim=1)
        floats = inside & self._free[x, y, z]
        opacity = torch.sigmoid(gaussians.logit_opacities[visible]).reshape(len(visible))
        return (opacity * floats).sum() / max(len(visible), 1)
