"""Order of Gaussians in space: neighbours are neighbours in memory, and blocks of them tell what a window can show.

The Gaussians of one view are then a few long runs of rows. Gathering them takes a third of the time of rows in
random order.
"""

import math
from functools import cache

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu_gaussian import WIDEST
from pipelines.splat.rasterizer.reference import FRUSTUM_MARGIN
from pipelines.splat.sh import coefficient_count

BITS = 21  # three coordinates of 21 bits fill the 63 bits of a positive int64


def morton_order(means: Tensor) -> Tensor:
    """Return the permutation (N,) int64 that sorts points (N, 3) along a Z-order curve in their bounding box."""
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    return torch.argsort(morton_codes(means)[0], stable=True)


def morton_codes(points: Tensor) -> tuple[Tensor, float]:
    """Return the places (N,) int64 of N ≥ 1 points (N, 3) along a Z-order curve, and the edge of its cells.

    The curve runs through the cube of 2^21 cells a side at the least corner of the points' bounding box. Codes
    without their lowest 3 k bits are those of cells that are 2^k times as large.
    """
    low, high = points.amin(dim=0), points.amax(dim=0)
    extent = (high - low).max().clamp_min(torch.finfo(points.dtype).tiny)
    cells = ((points - low) / extent * (2**BITS - 1)).long()
    code = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis in range(3):
        code |= _spread_bits(cells[:, axis]) << axis
    return code, float(extent) / (2**BITS - 1)


def _spread_bits(value: Tensor) -> Tensor:
    """Leave two zero bits between the bits of 21-bit integers."""
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


_BLOCK = 128
_CLASSES = 8  # of size: a few huge Gaussians must not make every block huge


class SpatialBlocks:
    """Gaussians, on a CPU, in blocks of neighbours of like size: finds the few that a small window can show."""

    def __init__(self, gaussians: Gaussians) -> None:
        means = gaussians.means.detach().double()
        reach = WIDEST * torch.exp(gaussians.log_scales.detach().double().amax(dim=1))
        usable = torch.nonzero(torch.isfinite(means).all(dim=1) & torch.isfinite(reach)).squeeze(1)
        means, reach = means[usable], reach[usable]
        order = _order(means, reach)
        self._row, self._count = usable[order].numpy(), len(order)
        self._values = {name: np.ascontiguousarray(values) for name, values in gaussians.arrays().items()}
        self._harmonics = cache(
            lambda degree: np.ascontiguousarray(self._values["sh"][:, : coefficient_count(degree)])
        )
        blocks = -(-self._count // _BLOCK)
        padded = np.minimum(np.arange(blocks * _BLOCK), max(self._count - 1, 0)).reshape(blocks, _BLOCK)
        places, reaches = means[order].numpy()[padded], reach[order].numpy()[padded]
        self._center = (places.min(axis=1) + places.max(axis=1)) / 2 if blocks else np.zeros((0, 3))
        self._radius = np.linalg.norm(places - self._center[:, None], axis=2).max(axis=1, initial=0.0)
        self._reach = reaches.max(axis=1, initial=0.0)

    def in_view(self, cam_from_model: FloatArray, camera: Pinhole, settings: RasterSettings) -> Gaussians:
        """Return few Gaussians, in their order: all that a render of the whole image, or of the settings' window,
        can show, with the harmonics of the settings' degree alone.
        """
        blocks = self._blocks_in(cam_from_model, camera, settings)
        chosen = blocks[:, None] * _BLOCK + np.arange(_BLOCK)
        rows = np.sort(self._row[chosen[chosen < self._count]])
        values = self._values | {"sh": self._harmonics(settings.sh_degree)}
        # By numpy: torch would wake all its threads for a few thousand rows.
        return Gaussians(**{name: torch.from_numpy(array.take(rows, axis=0)) for name, array in values.items()})

    def count_shown(self, cam_from_model: FloatArray, camera: Pinhole, settings: RasterSettings) -> int:
        """Return how many Gaussians `shown` returns, but for the last block's, without gathering them."""
        return min(len(self._blocks_in(cam_from_model, camera, settings)) * _BLOCK, self._count)

    def _blocks_in(self, cam_from_model: FloatArray, camera: Pinhole, settings: RasterSettings) -> IntArray:
        image = settings.image_of(camera)
        x, y, z = (self._center @ cam_from_model[:3, :3].T + cam_from_model[:3, 3]).T
        ahead = z + self._radius >= settings.near_m
        for across, size, focal, middle, whole, of_whole in (
            (x, image.width, image.fx, image.cx, camera.width, camera.cx),
            (y, image.height, image.fy, image.cy, camera.height, camera.cy),
        ):
            low, high = -middle / focal, (size - middle) / focal
            margin = WIDEST * math.sqrt(settings.dilation_px2) / focal
            slope = max(of_whole, whole - of_whole) / focal + FRUSTUM_MARGIN * 0.5 * whole / focal
            stretch = math.hypot(1.0, slope)  # of a σ on the screen
            reach = stretch * self._reach + margin * np.maximum(z + self._radius, 0.0)
            ahead &= across - high * z <= math.hypot(1.0, high) * self._radius + reach
            ahead &= across - low * z >= -math.hypot(1.0, low) * self._radius - reach
        return np.flatnonzero(ahead)


def _order(means: Tensor, reach: Tensor) -> Tensor:
    """Return the permutation (N,) that sorts by class of size, then along a space-filling curve."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64)
    size = torch.log2(reach / reach.median().clamp_min(1e-30)).ceil().clamp(0, _CLASSES - 1)
    by_place = torch.argsort(morton_codes(means)[0], stable=True)
    return by_place[torch.argsort(size[by_place], stable=True)]
