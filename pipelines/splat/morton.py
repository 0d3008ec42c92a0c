"""Order of the Gaussians in memory: neighbours in space are neighbours in memory.

The Gaussians of one view are then a few long runs of rows. Gathering them takes a third of the time of rows in
random order.
"""

from __future__ import annotations

import torch
from torch import Tensor

BITS = 21  # three coordinates of 21 bits fill the 63 bits of a positive int64


def morton_order(means: Tensor) -> Tensor:
    """Return the permutation (N,) int64 that sorts points (N, 3) along a Z-order curve in their bounding box."""
    if len(means) == 0:
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    return torch.argsort(morton_codes(means)[0], stable=True)


def morton_codes(points: Tensor) -> tuple[Tensor, float]:
    """Return the places of points along a Z-order curve, and the edge of its cells.

    The curve runs through the cube of 2^21 cells a side at the least corner of the points' bounding box. Codes
    without their lowest 3 k bits are those of cells that are 2^k times as large.

    Args:
        points: (N, 3), N ≥ 1.

    Returns:
        (N,) int64 codes, and the edge in the points' unit.
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
