"""Tie points of an OPF calibration: glTF points with `OPF_mesh_primitive_matches`.

glTF's scene is y-up, and OPF's coordinates are z-up: (x, y, z) there is (x, −z, y) here. Ranges of matches pack an
offset of 40 bits and a count of 24 into two integers of 32. Buffers are files beside the glTF; every count is held
against the file before memory is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.alias_generators import to_camel

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.json_values import JsonValue
from pipelines.core.products import load_json
from pipelines.core.types import FloatArray
from pipelines.formats.solved_cameras import Foreign, TiePoints, vector_of

MATCHES = "OPF_mesh_primitive_matches"
_MOST_BUFFER_BYTES = 16 << 30
_MOST_SHARED = 4  # observations for each match and point of a file: the specification's own example has 2.5
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_FLOAT, _UNSIGNED, _BYTE = 5126, 5125, 5121
_DTYPES: dict[int, np.dtype[Any]] = {_FLOAT: np.dtype("<f4"), _UNSIGNED: np.dtype("<u4"), _BYTE: np.dtype("u1")}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class _Part(Foreign):
    """Base of the parts of a glTF document, whose keys are in camel case."""

    model_config = ConfigDict(alias_generator=to_camel)


class _Buffer(_Part):
    uri: str | None = None


class _View(_Part):
    buffer: int = Field(ge=0)
    byte_offset: int = Field(0, ge=0)
    byte_length: int = Field(ge=0)
    byte_stride: int | None = None


class _Accessor(_Part):
    buffer_view: int = Field(ge=0)
    byte_offset: int = Field(0, ge=0)
    component_type: int
    count: int = Field(ge=0)
    type: str


class _ImagePoints(_Part):
    pixel_coordinates: int = Field(ge=0)


class _Matches(_Part):
    camera_uids: list[int]
    camera_ids: int = Field(ge=0)
    point_index_ranges: int = Field(ge=0)
    image_points: _ImagePoints | None = None


class _Extensions(_Part):
    matches: _Matches | None = Field(None, alias=MATCHES)


class _Primitive(_Part):
    attributes: dict[str, int]
    extensions: _Extensions | None = None


class _Mesh(_Part):
    primitives: list[_Primitive]


class _Node(_Part):
    mesh: int | None = Field(None, ge=0)
    matrix: list[float] | None = None


class _Gltf(_Part):
    buffers: list[_Buffer] = Field(default_factory=list)
    buffer_views: list[_View] = Field(default_factory=list)
    accessors: list[_Accessor] = Field(default_factory=list)
    meshes: list[_Mesh] = Field(default_factory=list)
    nodes: list[_Node] = Field(default_factory=list)


def read_tracks(
    path: Path, photograph_of: Mapping[int, int], beside: Callable[[str, Path], Path]
) -> TiePoints | None:
    r"""Read the points of all nodes with their matches; None: no node has matches with pixels.

    `photograph_of` gives the photograph by UID of its camera, and `beside` the path of a URI in a file.

    Raises:
        InputError: unreadable, not glTF, or indices, ranges and sizes that do not fit each other.

    Examples:
        >>> from pipelines.formats.colmap import read_sparse
        >>> from pipelines.formats.opf_writer import OpfFrame, OpfPhotograph, OpfScene, uid_of, write_opf
        >>> _ = Path("cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
        >>> images = "1 1 0 0 0 0 0 5 1 a.jpg\n235 150 1\n2 1 0 0 0 -1 0 5 1 b.jpg\n165 150 1\n"
        >>> _ = Path("images.txt").write_text(images)
        >>> _ = Path("points3D.txt").write_text("1 0.5 0 0 90 90 90 0.1 1 0 2 0\n")
        >>> frame = OpfFrame("EPSG:4979", shift=np.zeros(3))
        >>> photographs = [OpfPhotograph("a.jpg"), OpfPhotograph("b.jpg")]
        >>> _ = write_opf(Path(), OpfScene("flight", frame, read_sparse(Path()), photographs, []))
        >>> number = {uid_of("a.jpg"): 0, uid_of("b.jpg"): 1}
        >>> ties = read_tracks(Path("tracks.gltf"), number, lambda uri, file: file.with_name(uri))
        >>> ties.position.tolist(), ties.obs_photograph.tolist(), ties.obs_xy_px.tolist()
        ([[0.5, 0.0, 0.0]], [0, 1], [[235.0, 150.0], [165.0, 150.0]])
    """
    file = _File(path, load_json(_Gltf, path), beside)
    parts = []
    for node in file.document.nodes:
        if node.mesh is None:
            continue
        for primitive in file.one(file.document.meshes, node.mesh, "mesh").primitives:
            matches = None if primitive.extensions is None else primitive.extensions.matches
            if matches is not None and matches.image_points is not None and "POSITION" in primitive.attributes:
                parts.append(_part(file, node, primitive.attributes, matches, photograph_of))
    if not parts:
        return None
    first = np.cumsum([0, *(len(part.position) for part in parts[:-1])])
    return TiePoints(
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.rgb for part in parts]),
        np.concatenate([part.obs_point + at for part, at in zip(parts, first, strict=True)]),
        np.concatenate([part.obs_photograph for part in parts]),
        np.concatenate([part.obs_xy_px for part in parts]),
    )


@dataclass(frozen=True)
class _File:
    """glTF document and its file."""

    path: Path
    document: _Gltf
    beside: Callable[[str, Path], Path]

    def one(self, items: list[JsonValue], index: int, what: str) -> Any:
        if not 0 <= index < len(items):
            message = f"There is no {what} {index}: the file has {len(items)}."
            raise InputError("index-missing", message, path=self.path, field=what)
        return items[index]

    def array(self, index: int, component: int, width: int, what: str) -> NDArray[Any]:
        """Return the values (count, width) of an accessor, which must have that type."""
        accessor = self.one(self.document.accessors, index, "accessor")
        if accessor.component_type != component or _WIDTHS.get(accessor.type) != width:
            message = f"The accessor {index} of {what} has another type than OPF demands."
            raise InputError("accessor-type", message, path=self.path, field="accessors")
        view = self.one(self.document.buffer_views, accessor.buffer_view, "bufferView")
        buffer = self.one(self.document.buffers, view.buffer, "buffer")
        if not buffer.uri:
            raise InputError("buffer-missing", "A buffer has no file of its own.", path=self.path, field="buffers")
        source = self.beside(buffer.uri, self.path)
        dtype = _DTYPES[component]
        size = accessor.count * width * dtype.itemsize
        begin = view.byte_offset + accessor.byte_offset
        whole = file_size(source, limit_bytes=_MOST_BUFFER_BYTES, kind="buffer")
        tight = view.byte_stride in (None, width * dtype.itemsize)
        if not tight or accessor.byte_offset + size > view.byte_length or begin + size > whole:
            message = f"{accessor.count} values of {what} do not fit into {source.name}, of {whole} bytes."
            raise InputError("file-cut-off", message, path=self.path, field="accessors")
        with reading(source), source.open("rb") as stream:
            stream.seek(begin)
            data = stream.read(size)
        values: NDArray[Any] = np.frombuffer(data, dtype)
        return values.reshape(accessor.count, width)


def _part(
    file: _File, node: _Node, attributes: Mapping[str, int], matches: _Matches, photograph_of: Mapping[int, int]
) -> TiePoints:
    assert matches.image_points is not None
    position = file.array(attributes["POSITION"], _FLOAT, 3, "POSITION").astype(np.float64)
    position = _placed(position, node, file.path) @ _Z_UP_FROM_Y_UP.T
    packed = file.array(matches.point_index_ranges, _UNSIGNED, 2, "pointIndexRanges").astype(np.int64)
    owner = file.array(matches.camera_ids, _UNSIGNED, 1, "cameraIds")[:, 0].astype(np.int64)
    pixels = file.array(matches.image_points.pixel_coordinates, _FLOAT, 2, "pixelCoordinates").astype(np.float64)
    offset, count = packed[:, 0] | (packed[:, 1] & 0xFF) << 32, packed[:, 1] >> 8
    fits = (offset + count <= len(owner)) | (count == 0)
    sound = len(packed) == len(position) and len(owner) == len(pixels) and fits.all()
    # Points may share matches, but forged ranges could ask for each match as often as there are points.
    most = _MOST_SHARED * (len(owner) + len(packed))
    if not sound or count.sum() > most or (len(owner) and owner.max() >= len(matches.camera_uids)):
        message = "Points, ranges of matches, cameras and pixels do not fit each other."
        raise InputError("file-damaged", message, path=file.path, field=MATCHES)
    point = np.repeat(np.arange(len(position)), count)
    match = np.arange(len(point)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(offset, count)
    photograph = np.array([photograph_of.get(uid, -1) for uid in matches.camera_uids] or [-1], dtype=np.int64)
    rgb = np.zeros((len(position), 3), np.uint8)
    if "COLOR_0" in attributes:
        rgb = file.array(attributes["COLOR_0"], _BYTE, 4, "COLOR_0")[:, :3]
    if len(rgb) != len(position):
        raise InputError("file-damaged", "Points and colours differ in number.", path=file.path, field="COLOR_0")
    return TiePoints(position, rgb, point, photograph[owner[match]], pixels[match])


def _placed(position: FloatArray, node: _Node, path: Path) -> FloatArray:
    """Return the points in glTF's scene, which a node's matrix, column by column, leads to."""
    if node.matrix is None:
        return position
    try:
        matrix = vector_of(node.matrix, 16).reshape(4, 4).T
    except ValueError as error:
        raise InputError("matrix-form", "The matrix of a node is not of 4×4 numbers.", path=path) from error
    return np.asarray(position @ matrix[:3, :3].T + matrix[:3, 3])
