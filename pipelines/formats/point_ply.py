"""PLY of points with their uncertainty, for viewers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from pipelines.core.types import BoolArray, ByteArray, FloatArray

_VERTEX = [
    ("x", "<f8"), ("y", "<f8"), ("z", "<f8"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"),
    ("sigma", "<f4"), ("inlier", "u1"),
]  # fmt: skip


def write_point_ply(
    path: Path, position: FloatArray, rgb: ByteArray, sigma_m: FloatArray, inlier: BoolArray
) -> None:
    """Write points with their colour and uncertainty, in binary.

    Points without a position (NaN) are left out, because viewers fail on them.

    Args:
        path: of the file.
        position: (N, 3).
        rgb: (N, 3).
        sigma_m: (N,) σ along the worst axis.
        inlier: (N,).
    """
    finite = np.isfinite(position).all(axis=1)
    vertex = np.empty(int(finite.sum()), dtype=_VERTEX)
    for column, axis in enumerate("xyz"):
        vertex[axis] = position[finite, column]
    for column, colour in enumerate(("red", "green", "blue")):
        vertex[colour] = rgb[finite, column]
    vertex["sigma"], vertex["inlier"] = sigma_m[finite], inlier[finite]
    path.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))
