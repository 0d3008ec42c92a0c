"""Content of a tile: Gaussians as a glb, in the frame of the tileset's root."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.gltf import encode_glb
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import FRACTIONAL_BITS, encode_spz
from pipelines.geometry.rotations import matrix_from_quat_xyzw

_REACH_M = 2.0 ** (23 - FRACTIONAL_BITS)
_SIGMAS = 3.0  # viewers draw a Gaussian up to about three standard deviations


def write_glb(path: Path, splat: SplatArrays, extras: dict[str, Any] | None = None) -> None:
    """Write Gaussians of an East-North-Up frame as a glb.

    A scene that reaches further than ±2048 m gets coarser steps of position: 0.24 mm up to ±4096 m, and so on.

    Args:
        path: of the glb.
        splat: N ≥ 1 Gaussians.
        extras: metadata for `asset.extras`.

    Raises:
        InputError: values that are not finite.
        OSError: the file cannot be written.
    """
    furthest = float(np.abs(splat.means).max())
    coarser = max(0, math.ceil(math.log2((furthest + 1) / _REACH_M))) if math.isfinite(furthest) else 0
    spz = encode_spz(splat, 3, FRACTIONAL_BITS - coarser)
    low, high = splat.means.min(axis=0).tolist(), splat.means.max(axis=0).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_glb(spz, len(splat), math.isqrt(splat.sh.shape[1]) - 1, (low, high), extras))


def bounds_of(splat: SplatArrays) -> FloatArray:
    """Return the box (2, 3), least and largest coordinates, that holds Gaussians up to three times their σ."""
    scales = np.exp(splat.log_scales.astype(np.float64))
    reach = _SIGMAS * np.sqrt(np.einsum("nij,nj->ni", _rotations(splat) ** 2, scales**2))
    means = splat.means.astype(np.float64)
    return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])


def _rotations(splat: SplatArrays) -> FloatArray:
    return matrix_from_quat_xyzw(np.roll(splat.quats_wxyz, -1, axis=1))
