"""Point clouds of OPF projects as glTF: tie points with their matches, and the surface, written part by part.

Each array has a file of its own, as OPF demands. A node turns the z-up axes of the processing CRS to glTF's y-up.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np

from pipelines.core.files import remove, replace_text
from pipelines.core.json_values import Json
from pipelines.core.products import dump_json
from pipelines.core.types import AnyArray, ByteArray, Float32Array, FloatArray
from pipelines.formats.gltf import Y_UP_FROM_Z_UP

GLTF, BUFFER = "model/gltf+json", "application/gltf-buffer+bin"
_COMPONENTS = {"f": 5126, "u": 5125, "B": 5121}
_DTYPES = {"f": "<f4", "u": "<u4", "B": "u1"}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_UNLIT = "KHR_materials_unlit"
_ASSET = "OPF_asset_version"


@dataclass
class ArrayFile:
    """File of one array of a glTF.

    Attributes:
        kind: of its numbers: `f` float32, `u` uint32, `B` uint8.
        width, count: numbers in a row, and rows.
        more: what else its accessor says.
    """

    name: str
    kind: str
    width: int
    count: int = 0
    more: Json = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, name: str, values: AnyArray) -> ArrayFile:
        """Write an array (N,) or (N, width), and return its file."""
        kind = {"f": "f", "u": "B" if values.dtype.itemsize == 1 else "u"}[values.dtype.kind]
        (folder / f"{name}.bin").write_bytes(np.ascontiguousarray(values, _DTYPES[kind]).tobytes())
        return cls(name, kind, 1 if values.ndim == 1 else values.shape[1], len(values))

    @property
    def uri(self) -> str:
        return f"{self.name}.bin"

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.count * self.width * np.dtype(_DTYPES[self.kind]).itemsize


def write_points(
    folder: Path, name: str, arrays: list[ArrayFile], attributes: dict[str, int], extensions: Json | None = None
) -> list[Json]:
    """Write the glTF of points whose arrays are in the folder, and return its resources, relative to the folder.

    `attributes` and `extensions` of the primitive name arrays by their place in the list.
    """
    accessors = [
        {
            "bufferView": number,
            "componentType": _COMPONENTS[array.kind],
            "count": array.count,
            "type": _TYPES[array.width],
            **array.more,
        }
        for number, array in enumerate(arrays)
    ]
    primitive: Json = {"attributes": attributes, "mode": 0, "material": 0}
    if extensions:
        primitive["extensions"] = extensions
    document = {
        "asset": {"version": "2.0", "generator": "GeoRefGS", "extensions": {_ASSET: {"version": "1.0"}}},
        "accessors": accessors,
        "bufferViews": [{"buffer": number, "byteLength": array.size} for number, array in enumerate(arrays)],
        "buffers": [{"uri": array.uri, "byteLength": array.size} for array in arrays],
        "extensionsRequired": [_UNLIT],
        "extensionsUsed": [_UNLIT, _ASSET, *(extensions or {})],
        "materials": [{"extensions": {_UNLIT: {}}}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0, "matrix": list(Y_UP_FROM_Z_UP)}],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
    }
    replace_text(folder / f"{name}.gltf", dump_json(document) + "\n")
    return [{"uri": f"{name}.gltf", "format": GLTF}, *({"uri": array.uri, "format": BUFFER} for array in arrays)]


class SurfaceWriter:
    """Writer of a point cloud into `FOLDER/NAME/`, which exists only if it was completed.

    Attributes:
        count: of the points so far.
        resources: of the completed cloud, relative to the folder of the project; empty without points.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.resources: list[Json] = []
        self._folder, self._name = folder / name, name
        self._arrays = [ArrayFile("positions", "f", 3), ArrayFile("normals", "f", 3), ArrayFile("colors", "B", 4)]
        self._bounds = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._files: list[IO[bytes]] = []
        self._open = ExitStack()

    @property
    def count(self) -> int:
        return self._arrays[0].count

    def __enter__(self) -> SurfaceWriter:
        self._folder.mkdir()
        self._files = [self._open.enter_context((self._folder / array.uri).open("wb")) for array in self._arrays]
        return self

    def write(self, position: FloatArray, normal: FloatArray | Float32Array, rgb: ByteArray) -> None:
        """Append points (P, 3) in the processing CRS, with unit normals (P, 3) and colours (P, 3)."""
        if not len(position):
            return
        single = position.astype("<f4")
        self._bounds[0] = np.minimum(self._bounds[0], single.min(axis=0))
        self._bounds[1] = np.maximum(self._bounds[1], single.max(axis=0))
        opaque = np.column_stack([rgb, np.full(len(rgb), 255, np.uint8)])
        for file, array, values in zip(
            self._files, self._arrays, (single, normal.astype("<f4"), opaque), strict=True
        ):
            file.write(np.ascontiguousarray(values).tobytes())
            array.count += len(values)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
        if kind is not None or not self.count:
            remove(self._folder)
            return
        low, high = self._bounds.tolist()
        self._arrays[0].more = {"min": low, "max": high}
        self._arrays[2].more = {"normalized": True}
        attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
        resources = write_points(self._folder, self._name, self._arrays, attributes)
        self.resources = [{**resource, "uri": f"{self._name}/{resource['uri']}"} for resource in resources]
