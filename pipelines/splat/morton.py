"""Order of the Gaussians in memory: neighbours in space are neighbours in memory.

The Gaussians of one view are then a few long runs of rows. Gathering them takes a third of the time of rows in
random order.
"""

from __future__ import annotations

import torch
from torch import Tensor

_BITS = 21  # three coordinates of 21 bits fill the 63 bits of a positive int64


def morton_order(means: Tensor) -> Tensor:
    """Return the permutation (N,) int64 that sorts points (N, 3) along a Z-order curve in their bounding box."""
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    low, high = means.amin(dim=0), means.amax(dim=0)
    extent = (high - low).max().clamp_min(torch.finfo(means.dtype).tiny)
    cells = ((means - low) / extent * (2**_BITS - 1)).long()
    code = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for axis in range(3):
        code |= _spread_bits(cells[:, axis]) << axis
    return torch.argsort(code, stable=True)


def _spread_bits(value: Tensor) -> Tensor:
    """Leave two zero bits between the bits of 21-bit integers."""
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249
