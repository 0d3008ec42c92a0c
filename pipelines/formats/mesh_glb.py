"""Triangle meshes in binary glTF 2.0 (.glb): every triangle of the scene, by the matrices of its nodes.

glTF is y-up by its specification; vertices are returned z-up: x, −z, y. The extension CESIUM_RTC adds a centre to
the vertices: in Earth-centred metres, or, as ODM writes it, easting and northing of a map whose vertices are z-up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.json_values import Json
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.cloud_ply import check_precision
from pipelines.formats.triangle_mesh import MOST_BYTES, MOST_FACES, TriangleMesh, mesh_of
from pipelines.geometry.rotations import matrix_from_quat_xyzw

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_MOST_JSON = 256 * 1024 * 1024
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_FLOAT = 5126
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MOST_DEPTH, _MOST_NODES = 64, 1_000_000
# What changes where triangles lie and is not decoded here.
_PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_UNREAD = (*_PACKED, "EXT_mesh_gpu_instancing", "KHR_gaussian_splatting")
_EARTH_M = (6.3e6, 6.5e6)  # from the Earth's centre to its surface
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_glb_mesh(path: Path) -> TriangleMesh:
    """Return the triangles of a glb, z-up: x, −z, y of its frame.

    Raises:
        InputError: not a glb, without triangles, compressed, with parts in other files, or damaged.

    Examples:
        >>> from pipelines.formats.mesh_files import write_mesh_glb
        >>> corners, faces = np.array([[0.0, 0, 7], [1, 0, 7], [0, 1, 7]]), np.array([[0, 1, 2]])
        >>> grey = np.full((2, 2, 3), 128, np.uint8)
        >>> write_mesh_glb(Path("one.glb"), corners, faces, corners[:, :2], grey, extras={})
        >>> read_glb_mesh(Path("one.glb")).vertices.tolist()  # z-up again
        [[0.0, 0.0, 7.0], [1.0, 0.0, 7.0], [0.0, 1.0, 7.0]]
    """
    size = file_size(path, limit_bytes=MOST_BYTES, kind="glb")
    with reading(path), path.open("rb") as file:
        document, binary = _chunks(file.read(), path, size)
    try:
        return _Scene(path, document, binary).mesh()
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        message = f"The glb is damaged: {type(error).__name__} {str(error)[:160]}"
        raise InputError("file-damaged", message, path=path) from error


def _chunks(data: bytes, path: Path, size: int) -> tuple[dict[str, Any], memoryview]:
    """Return the document and the binary chunk, empty if there is none."""
    if len(data) < 20 or struct.unpack_from("<II", data) != (_MAGIC, 2):
        raise InputError("not-a-glb", "The file is not a binary glTF 2.0 (.glb).", path=path)
    length, kind = struct.unpack_from("<II", data, 12)
    if kind != _JSON or length > min(_MOST_JSON, size - 20):
        message = f"The glb states a document of {length} bytes, the file has {size}. It is cut off or damaged."
        raise InputError("size-differs", message, path=path)
    try:
        document = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise InputError("file-damaged", f"The document of the glb is damaged: {error}", path=path) from error
    if not isinstance(document, dict):
        raise InputError("file-damaged", "The document of the glb is no object.", path=path)
    rest = memoryview(data)[20 + length :]
    if len(rest) < 8:
        return document, memoryview(b"")
    length, kind = struct.unpack_from("<II", rest)
    return document, rest[8 : 8 + length] if kind == _BINARY else memoryview(b"")


class _Scene:
    """Document and binary chunk of one glb."""

    def __init__(self, path: Path, document: Json, binary: memoryview) -> None:
        self.path, self.document, self.binary = path, document, binary
        self.vertices: list[FloatArray] = []
        self.faces: list[IntArray] = []
        self.read: dict[tuple[int, int], tuple[FloatArray, IntArray] | None] = {}

    def mesh(self) -> TriangleMesh:
        used = set(self.document.get("extensionsRequired", ())) | set(self.document.get("extensionsUsed", ()))
        unread = [name for name in _UNREAD if name in used]
        if unread:
            message = f"The glb uses {', '.join(unread)}, which is not read."
            remedy = "Export it as plain triangles."
            raise InputError("glb-extension", message, path=self.path, remedy=remedy)
        faces = vertices = 0
        for number, to_scene in self._meshes():
            for part in range(len(self.document["meshes"][number]["primitives"])):
                primitive = self._primitive(number, part)
                if primitive is None:
                    continue
                vertex, corners = primitive
                if vertices + len(vertex) > 3 * MOST_FACES or faces + len(corners) > MOST_FACES:
                    message = f"The scene has more than {MOST_FACES} triangles, the limit."
                    raise InputError("mesh-too-large", message, path=self.path)
                self.faces.append(corners + vertices)
                self.vertices.append(vertex @ to_scene[:3, :3].T + to_scene[:3, 3])
                faces, vertices = faces + len(corners), vertices + len(vertex)
        vertex = np.concatenate([np.zeros((0, 3)), *self.vertices])
        corners = np.concatenate([np.zeros((0, 3), np.int64), *self.faces])
        center = self._center()
        on_map = center is not None and not _is_earth_centred(center)
        if not on_map:
            vertex = vertex @ _Z_UP_FROM_Y_UP.T
        mesh = mesh_of(self.path, vertex, (corners.ravel(), np.full(len(corners), 3, np.int64)))
        crs = "" if center is None or on_map else "EPSG:4978"
        return replace(mesh, turned=not on_map, offset=center, crs=crs)

    def _center(self) -> FloatArray | None:
        """Return the centre (3,) of CESIUM_RTC, None without; a ValueError: no three finite numbers."""
        extension = self.document.get("extensions", {}).get("CESIUM_RTC")
        if extension is None:
            return None
        center = np.array(extension["center"], dtype=np.float64).reshape(3)
        if not np.isfinite(center).all():
            raise ValueError("the centre of CESIUM_RTC is not finite")
        return center

    def _meshes(self) -> Iterator[tuple[int, FloatArray]]:
        """Yield the meshes of the scene's nodes with their matrices (4, 4), scene ← mesh."""
        nodes = self.document.get("nodes", [])
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", ())}
            roots = [number for number in range(len(nodes)) if number not in children]
        waiting, done = [(int(number), np.eye(4), 0) for number in roots], 0
        while waiting:
            number, above, depth = waiting.pop()
            done += 1
            if depth > _MOST_DEPTH or done > _MOST_NODES:
                message = f"Nodes are nested more than {_MOST_DEPTH} deep, or are more than {_MOST_NODES}."
                raise InputError("glb-nodes", message, path=self.path)
            node = nodes[number]
            matrix = above @ _matrix(node)
            if "mesh" in node:
                yield int(node["mesh"]), matrix
            waiting += [(int(child), matrix, depth + 1) for child in node.get("children", ())]

    def _primitive(self, number: int, part: int) -> tuple[FloatArray, IntArray] | None:
        """Return vertices (V, 3) and triangles (F, 3) of a primitive; None: it has none."""
        if (number, part) not in self.read:
            self.read[number, part] = self._decoded(self.document["meshes"][number]["primitives"][part])
        return self.read[number, part]

    def _decoded(self, primitive: Json) -> tuple[FloatArray, IntArray] | None:
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in {_TRIANGLES, _STRIP, _FAN} or "POSITION" not in primitive["attributes"]:
            return None
        position, is_float = self._accessor(primitive["attributes"]["POSITION"], "VEC3")
        if is_float:
            check_precision(position, np.float32, self.path)
        if "indices" in primitive:
            corners = self._accessor(primitive["indices"], "SCALAR")[0].astype(np.int64).ravel()
        else:
            corners = np.arange(len(position))
        if mode == _STRIP:
            at = np.arange(max(len(corners) - 2, 0))
            odd = at % 2
            triangles = np.column_stack([corners[at], corners[at + 1 + odd], corners[at + 2 - odd]])
        elif mode == _FAN:
            at = np.arange(max(len(corners) - 2, 0))
            triangles = np.column_stack([corners[np.zeros_like(at)], corners[at + 1], corners[at + 2]])
        else:
            triangles = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if triangles.size and (triangles.min() < 0 or triangles.max() >= len(position)):
            message = f"A face has the vertex {triangles.max()}; its part of the glb has {len(position)} vertices."
            raise InputError("mesh-corner", message, path=self.path)
        return position, triangles

    def _accessor(self, number: int, kind: str) -> tuple[FloatArray, bool]:
        """Return the values (N, k) of an accessor, and whether they are floats."""
        accessor = self.document["accessors"][number]
        if accessor["type"] != kind or "sparse" in accessor:
            what = "sparse" if "sparse" in accessor else str(accessor["type"])[:20]
            message = f"Accessor {number} is {what}, not a whole {kind}."
            raise InputError("glb-accessor", message, path=self.path)
        view = self.document["bufferViews"][accessor["bufferView"]]
        if view.get("buffer", 0) != 0 or "uri" in self.document["buffers"][0]:
            message = "The vertices of the glb lie in another file."
            remedy = "Export it with all its data inside."
            raise InputError("glb-external", message, path=self.path, remedy=remedy)
        dtype, width, count = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[kind], int(accessor["count"])
        start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        stride = int(view.get("byteStride", 0)) or width * dtype.itemsize
        last = start + (count - 1) * stride + width * dtype.itemsize
        if count < 1 or start < 0 or stride < width * dtype.itemsize or last > len(self.binary):
            message = f"Accessor {number} promises {count} values up to byte {last}, of {len(self.binary)}."
            raise InputError("size-differs", f"{message} The file is cut off or damaged.", path=self.path)
        raw: np.ndarray = np.ndarray((count, width), dtype, self.binary, start, (stride, dtype.itemsize))
        values = raw.astype(np.float64)
        is_float = accessor["componentType"] == _FLOAT
        if accessor.get("normalized") and not is_float:
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values, is_float


def _is_earth_centred(center: FloatArray) -> bool:
    """Return whether a centre (3,) is a place on Earth in Earth-centred metres; one on a map has no height."""
    return bool(center[2] != 0 and _EARTH_M[0] < np.linalg.norm(center) < _EARTH_M[1])


def _matrix(node: Json) -> FloatArray:
    """Return the matrix (4, 4) of a node, parent ← node; a ValueError: not 16 finite numbers."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        turn = matrix_from_quat_xyzw(np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64).reshape(4))
        matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64).reshape(3)
        matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=np.float64).reshape(3)
    if not np.isfinite(matrix).all():
        raise ValueError("a node has numbers that are not finite")
    return matrix
