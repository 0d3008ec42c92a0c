"""Sections of an SPZ file: values of Gaussians as bytes, and back.

| value | step | range |
|---|---|---|
| position | 2⁻¹² m (`fractional_bits`) | ±2048 m; beyond it, other writers wrap without a word |
| opacity | 1/255 | 0 … 1 |
| constant harmonic | 1/38.25 | ±3.33 |
| logarithm of the scale | 1/16 | −10 … 5.94 |
| rotation | quaternion, smallest three components with 9 bits and a sign each | |
| harmonics of degree 1 | 1/16 | −1 … 1 |
| harmonics of degree 2 and 3 | 1/8 | −1 … 1 |
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.formats.splat_ply import SplatArrays

_COLOUR_STEPS = 0.15 * 255
_LARGEST_COMPONENT = 511 / np.sqrt(0.5)  # of the components that are not the largest, √½ is the bound
_CHUNK = 1 << 18  # Gaussians that are converted at once: bounds the memory of the intermediate values


@dataclass(frozen=True)
class SpzLayout:
    """Sizes of the sections, as the header states them."""

    version: int
    count: int
    degree: int
    fractional_bits: int

    @property
    def higher(self) -> int:
        """Number of harmonics above the constant one."""
        return (self.degree + 1) ** 2 - 1

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes a Gaussian of the sections that are not empty."""
        rotation = 3 if self.version == 2 else 4
        return tuple(width for width in (9, 1, 3, 3, rotation, 3 * self.higher) if width)

    @property
    def body_bytes(self) -> int:
        """Bytes of all sections."""
        return self.count * sum(self.widths)


def quantised(splat: SplatArrays, layout: SpzLayout) -> list[ByteArray]:
    """Return the sections (N · width,) that are not empty.

    Args:
        splat: N Gaussians with finite values and positions in range.
        layout: of the file.
    """
    sections = [np.empty((layout.count, width), np.uint8) for width in layout.widths]
    for rows in _chunks(layout.count):
        fixed = np.rint(splat.means[rows].astype(np.float64) * 2.0**layout.fractional_bits).astype("<i4")
        sections[0][rows] = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)
        opacity = 0.5 + 0.5 * np.tanh(0.5 * splat.logit_opacities[rows, None].astype(np.float64))
        sections[1][rows] = _bytes(255 * opacity)
        sections[2][rows] = _bytes(_COLOUR_STEPS * splat.sh[rows, 0].astype(np.float64) + 127.5)
        sections[3][rows] = _bytes(16 * (splat.log_scales[rows].astype(np.float64) + 10))
        sections[4][rows] = _packed_rotations(splat.quats_wxyz[rows]).view(np.uint8).reshape(-1, 4)
        if layout.higher:
            sections[5][rows] = _coarse_harmonics(splat.sh[rows, 1:]).reshape(-1, 3 * layout.higher)
    return [section.reshape(-1) for section in sections]


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


def _bytes(values: FloatArray) -> ByteArray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _coarse_harmonics(higher: Float32Array) -> ByteArray:
    """Return harmonics (N, K − 1, 3) as bytes of which the lowest 3 or 4 bits are zero: they compress well."""
    step = np.full((higher.shape[1], 1), 16)
    step[:3] = 8
    exact = 128 * np.clip(higher, -2, 2) + 128
    coarse: ByteArray = np.clip(np.floor(exact / step + 0.5) * step, 0, 255).astype(np.uint8)
    return coarse


def _packed_rotations(quats_wxyz: Float32Array) -> NDArray[np.uint32]:
    """Return quaternions (N, 4) as words: index of the largest component of xyzw, then the others from x on."""
    xyzw = np.roll(quats_wxyz.astype(np.float64), -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    words = largest.astype(np.uint32)
    for axis in range(4):
        size = np.minimum(np.rint(_LARGEST_COMPONENT * np.abs(xyzw[:, axis])), 511).astype(np.uint32)
        signed = (xyzw[:, axis] < 0).astype(np.uint32) << np.uint32(9) | size
        words = np.where(largest == axis, words, words << np.uint32(10) | signed)
    little_endian: NDArray[np.uint32] = words.astype("<u4")
    return little_endian


def dequantised(layout: SpzLayout, body: ByteArray) -> SplatArrays:
    """Return the Gaussians in the sections of a file.

    An opacity of 0 or 255 steps is read a quarter of a step inside, so that its logit is finite.

    Args:
        layout: of the file.
        body: (B,) its sections, one after the other.
    """
    ends = np.cumsum([layout.count * width for width in layout.widths])
    sections = [part.reshape(layout.count, -1) for part in np.split(body, ends[:-1])]
    widths = {
        "means": (3,),
        "quats_wxyz": (4,),
        "log_scales": (3,),
        "logit_opacities": (),
        "sh": (1 + layout.higher, 3),
    }
    splat = SplatArrays(**{name: np.empty((layout.count, *width), np.float32) for name, width in widths.items()})
    for rows in _chunks(layout.count):
        positions, opacities, colours, scales, rotations, *higher = (section[rows] for section in sections)
        words = np.zeros((len(positions), 3, 4), np.uint8)
        words[:, :, 1:] = positions.reshape(-1, 3, 3)
        fixed = words.view("<i4")[:, :, 0] >> 8  # an arithmetic shift extends the sign
        splat.means[rows] = fixed / 2.0**layout.fractional_bits
        splat.quats_wxyz[rows] = _unpacked_rotations(rotations)
        splat.log_scales[rows] = scales / 16 - 10
        opacity = np.clip(opacities[:, 0].astype(np.float64), 0.25, 254.75) / 255
        splat.logit_opacities[rows] = np.log(opacity / (1 - opacity))
        splat.sh[rows, 0] = (colours - 127.5) / _COLOUR_STEPS
        for section in higher:
            splat.sh[rows, 1:] = section.reshape(-1, layout.higher, 3) / np.float32(128) - 1
    return splat


def _unpacked_rotations(section: ByteArray) -> Float32Array:
    """Return quaternions (N, 4) wxyz of three bytes (x, y, z) or of four (smallest three)."""
    if section.shape[1] == 3:
        xyz = section / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
        return np.column_stack([w, xyz]).astype(np.float32)
    words = np.ascontiguousarray(section).view("<u4")[:, 0]
    largest = words >> np.uint32(30)
    xyzw = np.zeros((len(words), 4))
    for axis in (3, 2, 1, 0):
        stored = largest != axis
        size = (words & np.uint32(511)) / _LARGEST_COMPONENT
        xyzw[:, axis] = np.where(stored, np.where(words & np.uint32(512), -size, size), 0)
        words = np.where(stored, words >> np.uint32(10), words)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], 1)
    return np.roll(xyzw, 1, axis=1).astype(np.float32)
