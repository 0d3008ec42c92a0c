"""Attraction of Gaussians to planes that were measured, with a confidence for each Gaussian.

GeomGS (arXiv 2501.13417) trains a confidence of each Gaussian together with its distance to LiDAR. Here the
confidence is eliminated: c d²/s² + c − 1 − ln c is least for c = 1/(1 + d²/s²), and is then ln(1 + d²/s²). No
Gaussian carries a further parameter, and density control has nothing to inherit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipelines.core.types import FloatArray, IntArray
from pipelines.splat.gaussians import Gaussians

_SIDE_BITS = 21  # of a cell's number along an axis
_AROUND = np.stack(np.meshgrid(*3 * [[-1, 0, 1]], indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class MeasuredPlanes:
    """P planes in `model`.

    Attributes:
        position: (P, 3) metres.
        normal: (P, 3) unit vectors.
        confidence: (P,) 0 … 1.
        scale_m: distance s at which a Gaussian's confidence is a half.
        cell_m: reach of the planes; a Gaussian two cells away belongs to none.
    """

    position: FloatArray
    normal: FloatArray
    confidence: FloatArray
    scale_m: float
    cell_m: float


class PlaneAttraction:
    """Loss of Gaussians beside the planes that they lie near.

    Args:
        planes: at least one.
        device: of the Gaussians.
    """

    def __init__(self, planes: MeasuredPlanes, device: torch.device) -> None:
        low = planes.position.min(axis=0) - planes.cell_m  # no cell around a plane has a negative number
        cell = np.floor((planes.position - low) / planes.cell_m).astype(np.int64)
        key = np.unique((np.unique(_keys(cell))[:, None] + _keys(_AROUND)).ravel())
        _, plane = cKDTree(planes.position).query(low + (_cells(key) + 0.5) * planes.cell_m)
        self._key = torch.from_numpy(key).to(device)
        tensors = (low, planes.position[plane], planes.normal[plane], planes.confidence[plane])
        self._corner, self._place, self._normal, self._confidence = (
            torch.from_numpy(values).float().to(device) for values in tensors
        )
        self._scale_m, self._cell_m = planes.scale_m, planes.cell_m

    def __call__(self, gaussians: Gaussians, visible: Tensor) -> Tensor:
        """Return the mean of α p ln(1 + d²/s²) over the visible Gaussians (K,): 0 for those far from all planes.

        p is the confidence in the plane, d the distance of the centre from it, and α the opacity, without gradient.
        """
        means = gaussians.means[visible]
        cell = ((means.detach() - self._corner) / self._cell_m).floor().long()
        key = (cell[:, 0] << 2 * _SIDE_BITS) + (cell[:, 1] << _SIDE_BITS) + cell[:, 2]
        row = torch.searchsorted(self._key, key).clamp_max(len(self._key) - 1)
        beside = (self._key[row] == key) & (cell >= 0).all(dim=1)
        off = ((means - self._place[row]) * self._normal[row]).sum(dim=1) / self._scale_m
        opacity = torch.sigmoid(gaussians.logit_opacities[visible]).reshape(len(visible)).detach()
        return (opacity * self._confidence[row] * beside * torch.log1p(off.square())).sum() / max(len(visible), 1)


def _keys(cell: IntArray) -> IntArray:
    """Return the keys of cells (N, 3); sums of keys are those of the sums."""
    return np.asarray((cell[:, 0] << 2 * _SIDE_BITS) + (cell[:, 1] << _SIDE_BITS) + cell[:, 2])


def _cells(key: IntArray) -> IntArray:
    side = (1 << _SIDE_BITS) - 1
    return np.stack([key >> 2 * _SIDE_BITS, (key >> _SIDE_BITS) & side, key & side], axis=1)
