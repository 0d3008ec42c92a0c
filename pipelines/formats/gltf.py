"""Binary glTF (.glb) of Gaussians: `KHR_gaussian_splatting` with an SPZ file as its only data.

The extensions are KHR_gaussian_splatting (ratified) and KHR_gaussian_splatting_compression_spz_2 (draft). Readers
decode the SPZ into the attributes that the primitive names; its accessors therefore have no data of their own.

CesiumJS reads the first primitive of the first node only. It takes colour and opacity from COLOR_0. An attribute
for the harmonic of degree 0 would make it drop all harmonics, so none is named.
"""

from __future__ import annotations

import json
import struct
from typing import Any

from pipelines.core.types import Vector3

SPLATS = "KHR_gaussian_splatting"
SPZ_IN_GLTF = "KHR_gaussian_splatting_compression_spz_2"
# glTF is y-up: (x, y, z) of a z-up frame is (x, z, −y) there. Column by column.
Y_UP_FROM_Z_UP = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_POINTS = 0
_UNSIGNED_BYTE, _FLOAT = 5121, 5126
_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_LARGEST_FILE = 2**32 - 1


def encode_glb(
    spz: bytes, count: int, sh_degree: int, bounds: tuple[Vector3, Vector3], extras: dict[str, Any] | None = None
) -> bytes:
    """Return a glb of an SPZ file of version 2 or 3 in a z-up frame.

    `bounds` are the least and largest coordinates of the centres, and `extras` metadata for `asset.extras`.

    Raises:
        ValueError: the SPZ is too large for a glb.
    """
    names = [f"{SPLATS}:SCALE", f"{SPLATS}:ROTATION"]
    names += [
        f"{SPLATS}:SH_DEGREE_{band}_COEF_{k}" for band in range(1, sh_degree + 1) for k in range(2 * band + 1)
    ]
    low, high = bounds
    accessors: list[dict[str, Any]] = [
        {"componentType": _FLOAT, "count": count, "type": "VEC3", "min": list(low), "max": list(high)},
        {"componentType": _UNSIGNED_BYTE, "normalized": True, "count": count, "type": "VEC4"},
    ]
    accessors += [
        {"componentType": _FLOAT, "count": count, "type": "VEC4" if name.endswith("ROTATION") else "VEC3"}
        for name in names
    ]
    attributes = dict(zip(("POSITION", "COLOR_0", *names), range(len(accessors)), strict=True))
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
        "extensions": {SPZ_IN_GLTF: {"bufferView": 0}},
    }
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {SPLATS: splats}}
    document = {
        "asset": {"version": "2.0", "generator": "GeoRefGS", **({"extras": extras} if extras else {})},
        "extensionsUsed": [SPLATS, SPZ_IN_GLTF],
        "extensionsRequired": [SPLATS, SPZ_IN_GLTF],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": list(Y_UP_FROM_Z_UP)}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": len(spz)}],
        "buffers": [{"byteLength": len(spz)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [_chunk(_JSON_CHUNK, text, b" "), _chunk(_BINARY_CHUNK, spz, b"\0")]
    size = 12 + sum(map(len, chunks))
    if size > _LARGEST_FILE:
        raise ValueError("a glb has less than 4 GiB")
    return struct.pack("<III", _MAGIC, 2, size) + b"".join(chunks)


def spz_in_glb(data: bytes) -> bytes:
    """Return the SPZ file in a glb that `encode_glb` made, with its padding; empty if the file is no glb."""
    if len(data) < 20 or data[:4] != struct.pack("<I", _MAGIC):
        return b""
    (size,) = struct.unpack_from("<I", data, 12)
    return data[20 + size + 8 :]


def _chunk(kind: int, data: bytes, filler: bytes) -> bytes:
    padding = -len(data) % 4
    return struct.pack("<II", len(data) + padding, kind) + data + filler * padding
