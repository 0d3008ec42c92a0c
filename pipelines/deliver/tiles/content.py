"""Content of a tile: Gaussians as a glb, in the frame of the tileset's root."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.formats.gltf import encode_glb, spz_in_glb
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import FRACTIONAL_BITS, decode_spz, encode_spz

_REACH_M = 2.0 ** (23 - FRACTIONAL_BITS)
_COPIES, _BYTES = 3, 17  # bytes of a Gaussian in SPZ before its compression, without harmonics above the constant


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


def require_space(folder: Path, count: int, coefficients: int) -> None:
    """Refuse tiles that the disk would not hold: each Gaussian is in a leaf, in splat.glb, and merged in levels.

    Args:
        folder: on the disk.
        count: number of Gaussians.
        coefficients: of the harmonics of each colour.

    Raises:
        InputError: too little space is free.
    """
    needed = _COPIES * count * (_BYTES + 3 * coefficients)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"tiles of {count} Gaussians may need {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are "
            "free: give a lower --sh-degree or a larger --min-opacity, or make room on this disk",
            path=folder,
        )


def read_glb(path: Path) -> SplatArrays:
    """Return the Gaussians of a glb that `write_glb` wrote.

    Raises:
        InputError: the file cannot be read, or is damaged.
    """
    file_size(path)
    return decode_spz(spz_in_glb(path.read_bytes()), path)
