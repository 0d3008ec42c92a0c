"""SOG: Gaussians as WebP pictures with a table of contents, PlayCanvas' format, and its index of levels of detail.

A unit of SOG (version 2) is a folder: `meta.json` and lossless pictures, in which one pixel of each belongs to one
Gaussian. A streamed dataset has many units, and `lod-meta.json`: a tree of boxes, whose leaves name their rows in
the unit of each level. The layout is that of github.com/playcanvas/splat-transform.

Readers of SOG take its axes as those of a PLY of splats and turn them by 180° about x or z: y points down.

| value | step | range |
|---|---|---|
| position | 2⁻¹⁶ of the unit's extent, of sign(x) ln(1 + abs(x)) | that of the unit |
| opacity | 1/255 | 0 … 1 |
| constant harmonic | 1/38.25 | ±3.33 |
| logarithm of the scale | 1/16 | −10 … 5.94 |
| rotation | quaternion, smallest three components with 8 bits each | |
| other harmonics | 1/64 | −2 … 1.98 |

Values have the steps of SPZ, or finer ones. Harmonics are entries of a palette of 65 536 at most: a unit of so many
Gaussians has one for each, and no clustering is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines import __version__
from pipelines.core.errors import InputError
from pipelines.core.files import replace_text
from pipelines.core.products import dump_json
from pipelines.core.types import ByteArray, Float32Array, FloatArray, IntArray
from pipelines.formats.splat_ply import SplatArrays

MOST_IN_UNIT = 65_536  # entries of the palette
_GENERATOR = f"GeoRefGS {__version__}"
_SCALES = np.arange(256) / 16 - 10
_COLOURS = (np.arange(256) - 127.5) / 38.25
_HARMONICS = (np.arange(256) - 128) / 64
_ALIGNED = 4  # sides of pictures, in pixels
_PALETTE_COLUMNS = 64  # entries in a row of the palette's picture
_LARGEST_TAG = 252  # of a rotation: plus the index of its largest component


@dataclass(frozen=True)
class SogRows:
    """Rows of a unit that a leaf shows at one level: number of the unit, first row, number of rows."""

    unit: int
    first: int
    count: int


@dataclass(frozen=True)
class SogNode:
    """Box (2, 3) of the tree with its children, or of a leaf the rows of each level, 0 the finest."""

    bounds: FloatArray
    children: tuple[SogNode, ...] = ()
    levels: dict[int, SogRows] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        low, high = self.bounds.tolist()
        document: dict[str, Any] = {"bound": {"min": low, "max": high}}
        if self.children:
            return {**document, "children": [child.document() for child in self.children]}
        lods = {
            str(level): {"file": rows.unit, "offset": rows.first, "count": rows.count}
            for level, rows in self.levels.items()
        }
        return {**document, "lods": lods}


def write_sog_index(path: Path, units: list[str], counts: list[int], root: SogNode) -> None:
    """Write `lod-meta.json`, given the folders of the units and the number of Gaussians of each level."""
    document = {
        "version": 1,
        "asset": {"generator": _GENERATOR},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(counts),
        "filenames": [f"{unit}/meta.json" for unit in units],
        "tree": root.document(),
    }
    replace_text(path, dump_json(document) + "\n")


def write_sog(folder: Path, splat: SplatArrays, *, mip_filter: bool = False) -> FloatArray:
    """Write N Gaussians, 1 to 65 536, as a unit, in their order; `mip_filter`: renders of them need it.

    Returns by how much their positions are rounded (N,), in metres, along the axis of the largest error. Opacities,
    colours, scales and harmonics beyond the format's range are clamped to it.

    Raises:
        InputError: values that are not finite, or a rotation of length zero.
        ValueError: too many Gaussians, or none.
    """
    count = len(splat)
    if not 0 < count <= MOST_IN_UNIT:
        raise ValueError(f"a unit of SOG has 1 to {MOST_IN_UNIT} Gaussians, not {count}")
    for name, values in vars(splat).items():
        if not np.isfinite(values).all():
            message = "Gaussians with values that are not finite cannot be written as SOG."
            raise InputError("values-not-finite", message, field=name)
    folder.mkdir(parents=True, exist_ok=True)
    side = math.ceil(math.sqrt(count) / _ALIGNED) * _ALIGNED
    size = (side, math.ceil(count / side / _ALIGNED) * _ALIGNED)
    logarithms = np.sign(splat.means) * np.log1p(np.abs(splat.means.astype(np.float64)))
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    position = np.rint(65535 * (logarithms - low) / extent).astype(np.int64)
    opacity = 0.5 + 0.5 * np.tanh(0.5 * splat.logit_opacities[:, None].astype(np.float64))
    shown = np.column_stack([_nearest(_COLOURS, splat.sh[:, 0]), np.rint(255 * opacity)])
    _write(folder / "means_l.webp", position & 0xFF, size)
    _write(folder / "means_u.webp", position >> 8, size)
    _write(folder / "scales.webp", _nearest(_SCALES, splat.log_scales), size)
    _write(folder / "quats.webp", _packed_rotations(splat.quats_wxyz), size)
    _write(folder / "sh0.webp", shown, size)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": _GENERATOR},
        "count": count,
        "antialias": mip_filter,
        **({"model": "antialiased"} if mip_filter else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _SCALES.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _COLOURS.tolist(), "files": ["sh0.webp"]},
    }
    if splat.sh.shape[1] > 1:
        meta["shN"] = _write_harmonics(folder, splat.sh[:, 1:], size)
    replace_text(folder / "meta.json", dump_json(meta) + "\n")
    read = low + extent * position / 65535
    return np.asarray(np.abs(np.sign(read) * np.expm1(np.abs(read)) - splat.means).max(axis=1))


def _write_harmonics(folder: Path, higher: Float32Array, size: tuple[int, int]) -> dict[str, Any]:
    """Write the palette and each Gaussian's entry in it, and return their part of the table of contents."""
    count, coefficients = higher.shape[:2]
    palette = _nearest(_HARMONICS, higher).reshape(-1, 3)
    rows = math.ceil(count / _PALETTE_COLUMNS)
    entry = np.arange(count)
    labels = np.column_stack([entry & 0xFF, entry >> 8, np.zeros_like(entry)])
    _write(folder / "shN_centroids.webp", palette, (_PALETTE_COLUMNS * coefficients, rows))
    _write(folder / "shN_labels.webp", labels, size)
    return {
        "count": count,
        "bands": math.isqrt(coefficients + 1) - 1,
        "codebook": _HARMONICS.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _nearest(codebook: NDArray[np.floating], values: Float32Array) -> IntArray:
    """Return the entries of an even, ascending codebook that are nearest to values."""
    step = codebook[1] - codebook[0]
    nearest = np.rint((values.astype(np.float64) - codebook[0]) / step)
    return np.asarray(np.clip(nearest, 0, len(codebook) - 1).astype(np.int64))


def _packed_rotations(quats_wxyz: Float32Array) -> IntArray:
    """Return quaternions as three bytes of the smaller components, in order, and the tag of the largest one."""
    quats = quats_wxyz.astype(np.float64)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    if not length.all():
        message = "A rotation of length zero cannot be written as SOG."
        raise InputError("quaternion-length", message, field="quats_wxyz")
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    smaller = np.take_along_axis(quats * sign / length, others, axis=1)
    packed = np.clip(np.rint(255 * (0.5 + smaller * math.sqrt(0.5))), 0, 255)
    return np.column_stack([packed, _LARGEST_TAG + largest]).astype(np.int64)


def _write(path: Path, values: IntArray | FloatArray, size: tuple[int, int]) -> None:
    """Write rows (N, 3) or (N, 4) of bytes as the pixels of a lossless picture of a width and a height."""
    width, height = size
    pixels: ByteArray = np.zeros((width * height, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    # Without `exact`, colours where the fourth channel is zero would be lost.
    Image.fromarray(pixels.reshape(height, width, -1)).save(path, "WEBP", lossless=True, exact=True)
