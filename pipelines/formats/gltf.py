"""Binary glTF (.glb), and that of Gaussians: `KHR_gaussian_splatting`, with an SPZ file or with plain data.

The extensions are KHR_gaussian_splatting (ratified) and KHR_gaussian_splatting_compression_spz_2 (draft). Readers
decode an SPZ into the attributes that the primitive names; its accessors therefore have no data of their own.

CesiumJS draws Gaussians from SPZ alone, and reads the first primitive of the first node only. It takes colour and
opacity from COLOR_0. An attribute for the harmonic of degree 0 would make it drop all harmonics, so a file with SPZ
names none. A file with plain data names all that the ratified extension demands: standard deviations and opacity
as they are (no logarithm, no logit), rotations x, y, z, w, and every harmonic. It does not demand that a reader
knows the extension: others may draw the centres as points, in the colours of COLOR_0. CesiumJS 1.145 by
itself fails, because its shader takes the names of the attributes: `tiles.html` hands it the arrays.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from pipelines.core.errors import InputError
from pipelines.core.json_values import Json
from pipelines.core.types import Float32Array, Vector3
from pipelines.formats.splat_ply import SplatArrays

SPLATS = "KHR_gaussian_splatting"
SPZ_IN_GLTF = "KHR_gaussian_splatting_compression_spz_2"
# glTF is y-up: (x, y, z) of a z-up frame is (x, z, −y) there. Column by column.
Y_UP_FROM_Z_UP = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_POINTS = 0
_UNSIGNED_BYTE, _FLOAT, _VERTICES = 5121, 5126, 34962
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_LARGEST_FILE = 2**32 - 1
_CONSTANT_HARMONIC = 0.28209479177387814
_LEAST_OPACITY = 1e-7  # whose logit is finite in float32, as is that of 1 less it


def encode_glb(
    spz: bytes, count: int, sh_degree: int, bounds: tuple[Vector3, Vector3], extras: Json | None = None
) -> bytes:
    """Return a glb of an SPZ file of version 2 or 3 in a z-up frame.

    `bounds` are the least and largest coordinates of the centres, and `extras` metadata for `asset.extras`.

    Raises:
        ValueError: the SPZ is too large for a glb.
    """
    names = [f"{SPLATS}:SCALE", f"{SPLATS}:ROTATION", *_harmonics(1, sh_degree)]
    low, high = bounds
    accessors: dict[str, dict[str, Any]] = {
        "POSITION": {"componentType": _FLOAT, "count": count, "type": "VEC3", "min": list(low), "max": list(high)},
        "COLOR_0": {"componentType": _UNSIGNED_BYTE, "normalized": True, "count": count, "type": "VEC4"},
    }
    for name in names:
        kind = "VEC4" if name.endswith("ROTATION") else "VEC3"
        accessors[name] = {"componentType": _FLOAT, "count": count, "type": kind}
    return _glb(accessors, [{"buffer": 0, "byteLength": len(spz)}], spz, extras, is_spz=True)


def encode_plain_glb(splat: SplatArrays, extras: Json | None = None) -> bytes:
    """Return a glb of N ≥ 1 Gaussians in a z-up frame whose attributes are plain arrays; `extras` as above.

    Raises:
        InputError: values that are not finite, rotations of length zero or standard deviations beyond float32.
        ValueError: the arrays are too large for a glb.
    """
    opacity = expit(splat.logit_opacities)
    colour = np.clip(0.5 + _CONSTANT_HARMONIC * splat.sh[:, 0], 0, 1)
    with np.errstate(invalid="ignore", over="ignore"):
        unit = splat.quats_wxyz / np.linalg.norm(splat.quats_wxyz, axis=1, keepdims=True)
        scale = np.exp(splat.log_scales)
    arrays: dict[str, Float32Array] = {
        "POSITION": splat.means,
        f"{SPLATS}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{SPLATS}:SCALE": scale,
        f"{SPLATS}:OPACITY": opacity[:, None],
    }
    degree = math.isqrt(splat.sh.shape[1]) - 1
    arrays |= {name: splat.sh[:, index] for index, name in enumerate(_harmonics(0, degree))}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            message = "Gaussians with values that are not finite cannot be written as glTF."
            raise InputError("values-not-finite", message, field=name)
    stored: dict[str, NDArray[Any]] = {name: values.astype("<f4") for name, values in arrays.items()}
    stored["COLOR_0"] = np.rint(255 * np.column_stack([colour, opacity])).astype(np.uint8)
    accessors: dict[str, dict[str, Any]] = {}
    views: list[dict[str, Any]] = []
    start = 0
    for name, values in stored.items():
        kind = {"type": _TYPES[values.shape[1]], "componentType": _FLOAT}
        if values.dtype == np.uint8:
            kind |= {"componentType": _UNSIGNED_BYTE, "normalized": True}
        accessors[name] = {"bufferView": len(views), "count": len(values), **kind}
        views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": _VERTICES})
        start += values.nbytes
    low, high = (bound.tolist() for bound in (stored["POSITION"].min(axis=0), stored["POSITION"].max(axis=0)))
    accessors["POSITION"] |= {"min": low, "max": high}
    payload = b"".join(values.tobytes() for values in stored.values())
    return _glb(accessors, views, payload, extras)


def spz_in_glb(data: bytes) -> bytes:
    """Return the SPZ file in a glb that `encode_glb` made, with its padding; empty if the file is no such glb."""
    if len(data) < 20 or data[:4] != struct.pack("<I", _MAGIC):
        return b""
    (size,) = struct.unpack_from("<I", data, 12)
    return data[20 + size + 8 :]


def decode_plain_glb(data: bytes, path: Path | None = None) -> SplatArrays:
    """Return the Gaussians of a glb that `encode_plain_glb` made.

    Raises:
        InputError: not such a file, or damaged; names the path.

    Examples:
        >>> shapes = (1, 3), (1, 4), (1, 3), (1,), (1, 1, 3)  # mean, rotation, ln σ, logit of opacity, harmonics
        >>> splat = SplatArrays(*(np.ones(shape, np.float32) for shape in shapes))
        >>> decode_plain_glb(encode_plain_glb(splat)).means.tolist()
        [[1.0, 1.0, 1.0]]
    """
    try:
        magic, _, _, size = struct.unpack_from("<IIII", data)
        if magic != _MAGIC:
            raise ValueError("not a glb")
        document = json.loads(data[20 : 20 + size])
        (primitive,) = document["meshes"][0]["primitives"]
        arrays = {}
        for name, index in primitive["attributes"].items():
            if name != "COLOR_0":
                accessor = document["accessors"][index]
                width = next(width for width, kind in _TYPES.items() if kind == accessor["type"])
                start = 20 + size + 8 + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
                values = np.frombuffer(data, "<f4", width * accessor["count"], start)
                arrays[name] = values.reshape(-1, width).astype(np.float32)
        harmonics = sum(name.startswith(f"{SPLATS}:SH_DEGREE_") for name in arrays)
        names = _harmonics(0, math.isqrt(harmonics) - 1)
        opacity = np.clip(arrays[f"{SPLATS}:OPACITY"][:, 0], _LEAST_OPACITY, 1 - _LEAST_OPACITY)
        return SplatArrays(
            means=arrays["POSITION"],
            quats_wxyz=arrays[f"{SPLATS}:ROTATION"][:, [3, 0, 1, 2]],
            log_scales=np.log(np.maximum(arrays[f"{SPLATS}:SCALE"], np.finfo(np.float32).tiny)),
            logit_opacities=logit(opacity),
            sh=np.stack([arrays[name] for name in names], axis=1),
        )
    except (ValueError, KeyError, IndexError, TypeError, StopIteration, struct.error, RecursionError) as error:
        raise InputError("file-damaged", f"The glb does not hold plain Gaussians: {error}", path=path) from error


def _harmonics(first: int, last: int) -> list[str]:
    """Return the names of the harmonics from a degree to another, in the order of the coefficients."""
    return [f"{SPLATS}:SH_DEGREE_{band}_COEF_{k}" for band in range(first, last + 1) for k in range(2 * band + 1)]


def _glb(
    accessors: dict[str, Json],
    views: list[Json],
    payload: bytes,
    extras: Json | None,
    *,
    is_spz: bool = False,
) -> bytes:
    extensions = (SPLATS, SPZ_IN_GLTF) if is_spz else (SPLATS,)
    splats: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    if is_spz:
        splats["extensions"] = {SPZ_IN_GLTF: {"bufferView": 0}}
    attributes = {name: index for index, name in enumerate(accessors)}
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {SPLATS: splats}}
    document = {
        "extensionsUsed": extensions,
        **({"extensionsRequired": extensions} if is_spz else {}),
        "accessors": list(accessors.values()),
        "bufferViews": views,
    }
    return glb_of(primitive, document, payload, extras)


def glb_of(primitive: Json, rest: Json, binary: bytes, extras: Json | None = None) -> bytes:
    """Return a glb of one primitive in a z-up frame, which a node turns y-up; a ValueError: 4 GiB or more.

    `rest` is the rest of the glTF document but for its only buffer, and `extras` metadata for `asset.extras`.
    """
    document = {
        "asset": {"version": "2.0", "generator": "GeoRefGS", **({"extras": extras} if extras else {})},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": Y_UP_FROM_Z_UP}],
        "meshes": [{"primitives": [primitive]}],
        **rest,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [_chunk(_JSON_CHUNK, text, b" "), _chunk(_BINARY_CHUNK, binary, b"\0")]
    size = 12 + sum(map(len, chunks))
    if size > _LARGEST_FILE:
        raise ValueError("a glb has less than 4 GiB")
    return struct.pack("<III", _MAGIC, 2, size) + b"".join(chunks)


def _chunk(kind: int, data: bytes, filler: bytes) -> bytes:
    padding = -len(data) % 4
    return struct.pack("<II", len(data) + padding, kind) + data + filler * padding
