"""Triangle meshes of other programs: PLY, OBJ and binary glTF, as vertices and triangles in the file's frame.

Polygons are cut into triangles. Sizes are checked before memory is allocated, and nothing outside the file is read:
materials and textures do not matter here.
"""

from __future__ import annotations

import array
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.cloud_ply import open_cloud_ply
from pipelines.formats.splat_ply import PLY_TYPES, ply_header

MOST_BYTES = 8 * 1024**3
MOST_FACES = 100_000_000
_CORNERS = ("vertex_indices", "vertex_index")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_CORNERS = 255


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles (F, 3) of vertices (V, 3), the third axis up.

    `states_axes`: the format says which axis is up. `turned`: it was the second one, and the vertices are x, −z, y
    of the file. `offset` (3,) and `crs` are what the file itself says of its place, None and empty: nothing.
    """

    path: Path
    vertices: FloatArray
    faces: IntArray
    states_axes: bool = True
    turned: bool = False
    offset: FloatArray | None = None
    crs: str = ""

    def with_up(self, axis: str) -> TriangleMesh:
        """Return the mesh with another axis of the file up: `y` or `z`."""
        if (axis == "y") == self.turned:
            return replace(self, states_axes=True)
        x, y, z = self.vertices.T
        vertices = np.column_stack([x, -z, y] if axis == "y" else [x, z, -y])
        return replace(self, vertices=vertices, states_axes=True, turned=axis == "y")


def has_faces(path: Path) -> bool:
    """Return whether the header of a PLY names faces; an InputError: no such file, or no PLY."""
    lines, _, _ = ply_header(path)
    return any(line[:2] == ["element", "face"] and line[2:] != ["0"] for line in lines)


def read_ply_mesh(path: Path) -> TriangleMesh:
    r"""Return the triangles of a PLY, binary or ASCII.

    Raises:
        InputError: not a PLY of faces, coordinates of too little precision, cut off or damaged.

    Examples:
        >>> _ = Path("one.ply").write_text(
        ...     "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        ...     "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        ...     "0 0 7\n1 0 7\n0 1 7\n3 0 1 2\n"
        ... )
        >>> mesh = read_ply_mesh(Path("one.ply"))
        >>> mesh.vertices.tolist(), mesh.faces.tolist()
        ([[0.0, 0.0, 7.0], [1.0, 0.0, 7.0], [0.0, 1.0, 7.0]], [[0, 1, 2]])
    """
    cloud = open_cloud_ply(path)
    chunks = [chunk.position for chunk in cloud.chunks(1_000_000)]
    lines, _, size = ply_header(path)
    form = next(line[1] for line in lines if line[:1] == ["format"])
    elements = [number for number, line in enumerate(lines) if line[:1] == ["element"]]
    second = lines[elements[1]] if len(elements) > 1 else []
    until = elements[2] if len(elements) > 2 else len(lines)
    if second[:2] != ["element", "face"] or not second[2:] or not second[2].isdecimal() or len(second[2]) > 12:
        message = "The second element of the PLY is not a number of faces, after the vertices."
        raise InputError("ply-elements", message, path=path)
    columns = _face_columns(path, [line for line in lines[elements[1] + 1 : until] if line[:1] == ["property"]])
    count = int(second[2])
    if form == "ascii":
        corners = _ascii_faces(cloud.rest(), count, columns, path)
    else:
        start = cloud.offset + cloud.count * cloud.dtype.itemsize
        if count > min(MOST_FACES, size - start):
            message = f"The header promises {count} faces, the file has {max(size - start, 0)} bytes for them."
            raise InputError("size-differs", message, path=path)
        with reading(path), path.open("rb") as file:
            file.seek(start)
            corners = _binary_faces(file.read(), count, columns, _ORDERS[form], path)
    return mesh_of(path, np.concatenate(chunks), corners)


# Name, type, and type of the length of a list; None: no list.
_Column = tuple[str, str, str | None]


def _face_columns(path: Path, lines: list[list[str]]) -> list[_Column]:
    columns: list[_Column] = []
    for line in lines:
        is_list = line[1:2] == ["list"] and len(line) == 5
        kinds = line[2:4] if is_list else line[1:2]
        if not (is_list or len(line) == 3) or any(kind not in PLY_TYPES for kind in kinds):
            message = f"The property {' '.join(line[1:])[:60]!r} of the faces is not known."
            raise InputError("ply-properties", message, path=path)
        length = PLY_TYPES[kinds[0]] if is_list else None
        columns.append((line[-1], PLY_TYPES[kinds[-1]], length))
    lists = [column for column in columns if column[0] in _CORNERS]
    if len(lists) != 1 or lists[0][2] is None or "f" in lists[0][1] + lists[0][2]:
        message = "The faces have no list vertex_indices of integers, or two."
        raise InputError("ply-properties", message, path=path)
    return columns


def _binary_faces(
    body: bytes, count: int, columns: list[_Column], order: str, path: Path
) -> tuple[IntArray, IntArray]:
    """Return the corners of all faces one after the other, and the number of each (F,)."""
    same = _equal_faces(body, count, columns, order)
    if same is not None:
        return same
    corners, numbers, at = array.array("q"), array.array("q"), 0
    for _ in range(count):
        for name, kind, length in columns:
            many = 1
            if length is not None:
                many = int(_values(body, at, 1, order + length, path)[0])
                at += np.dtype(length).itemsize
            values = _values(body, at, many, order + kind, path)
            at += values.nbytes
            if name in _CORNERS:
                corners.extend(values.astype(np.int64).tolist())
                numbers.append(many)
    return np.frombuffer(corners, np.int64), np.frombuffer(numbers, np.int64)


def _values(body: bytes, at: int, many: int, kind: str, path: Path) -> np.ndarray:
    if not 0 <= many <= (len(body) - at) // np.dtype(kind).itemsize:
        raise InputError("size-differs", "The faces of the PLY are cut off or damaged.", path=path)
    return np.frombuffer(body, kind, many, at)


def _equal_faces(body: bytes, count: int, columns: list[_Column], order: str) -> tuple[IntArray, IntArray] | None:
    """Return what `_binary_faces` does where all faces have lists as long as the first; None: they have not."""
    at, fields = 0, []
    for number, (_, kind, length) in enumerate(columns):
        many = 1
        if length is not None:
            head = np.dtype(order + length)
            if at + head.itemsize > len(body):
                return None
            many = int(np.frombuffer(body, head, 1, at)[0])
            if not 0 <= many <= _MOST_CORNERS:
                return None
            fields.append((f"n{number}", order + length, (1,)))
            at += head.itemsize
        fields.append((f"v{number}", order + kind, (many,)))
        at += many * np.dtype(kind).itemsize
    dtype = np.dtype(fields)
    if count < 1 or count * dtype.itemsize > len(body):
        return None
    rows = np.frombuffer(body, dtype, count)
    for number, (_, _, length) in enumerate(columns):
        if length is not None and not (rows[f"n{number}"] == rows[f"v{number}"].shape[1]).all():
            return None
    column_number = next(number for number, column in enumerate(columns) if column[0] in _CORNERS)
    corners = rows[f"v{column_number}"].astype(np.int64)
    return corners.ravel(), np.full(count, corners.shape[1], dtype=np.int64)


def _ascii_faces(lines: list[bytes], count: int, columns: list[_Column], path: Path) -> tuple[IntArray, IntArray]:
    if count > len(lines):
        message = f"The header promises {count} faces, the file has {len(lines)} lines for them."
        raise InputError("size-differs", message, path=path)
    corners, numbers = array.array("q"), array.array("q")
    try:
        for line in lines[:count]:
            words, at = line.split(), 0
            for name, _, length in columns:
                many = 1 if length is None else int(words[at])
                at += length is not None
                if not 0 <= many <= len(words) - at:
                    raise ValueError("a line is too short")
                if name in _CORNERS:
                    corners.extend(map(int, words[at : at + many]))
                    numbers.append(many)
                at += many
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError("file-damaged", f"The faces of the PLY are damaged: {error}", path=path) from error
    return np.frombuffer(corners, np.int64), np.frombuffer(numbers, np.int64)


def read_obj(path: Path) -> TriangleMesh:
    r"""Return the triangles of an OBJ; an InputError: too large, no faces, or a line that is none of OBJ.

    Examples:
        >>> _ = Path("one.obj").write_text("v 0 0 7\nv 1 0 7\nv 0 1 7\nf 1 2 3\n")
        >>> mesh = read_obj(Path("one.obj"))
        >>> mesh.vertices.tolist(), mesh.faces.tolist()
        ([[0.0, 0.0, 7.0], [1.0, 0.0, 7.0], [0.0, 1.0, 7.0]], [[0, 1, 2]])
    """
    if file_size(path, limit_bytes=MOST_BYTES, kind="OBJ") == 0:
        raise InputError("file-empty", "The file is empty.", path=path)
    position, corners, numbers = array.array("d"), array.array("q"), array.array("q")
    with reading(path), path.open("rb") as file:
        for number, line in enumerate(file, 1):
            try:
                if line.startswith((b"v ", b"v\t")):
                    x, y, z = line.split(None, 4)[1:4]
                    position.extend((float(x), float(y), float(z)))
                elif line.startswith((b"f ", b"f\t")):
                    known = len(position) // 3
                    words = _whole_line(line, file).split()[1:]
                    indices = [int(word.partition(b"/")[0]) for word in words]
                    # A negative index counts from the last vertex so far; 1 is the first of all.
                    corners.extend(index + known if index < 0 else index - 1 for index in indices)
                    numbers.append(len(indices))
            except (ValueError, OverflowError) as error:
                text = line[:60].decode("ascii", "replace").strip()
                message = f"The line {text!r} is not one of an OBJ: {error}"
                raise InputError("obj-line", message, path=path, line=number) from error
    shape = np.frombuffer(corners, np.int64), np.frombuffer(numbers, np.int64)
    mesh = mesh_of(path, np.frombuffer(position).reshape(-1, 3), shape)
    return replace(mesh, states_axes=False)


def _whole_line(line: bytes, file: object) -> bytes:
    """Return a line with those that continue it."""
    while line.rstrip(b"\r\n").endswith(b"\\"):
        following = next(file, b"")  # type: ignore[call-overload]
        line = line.rstrip(b"\r\n")[:-1] + b" " + following
    return line


def mesh_of(path: Path, vertices: FloatArray, shape: tuple[IntArray, IntArray]) -> TriangleMesh:
    """Return the mesh of polygons, whose corners lie one after the other and whose numbers of corners are (F,).

    Raises:
        InputError: no triangle, a corner that is no vertex, or coordinates that are not finite.
    """
    corners, numbers = shape
    if corners.size and (corners.min() < 0 or corners.max() >= len(vertices)):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        message = f"A face has the vertex {wrong}; the file has {len(vertices)} vertices."
        raise InputError("mesh-corner", message, path=path)
    first = np.concatenate([[0], np.cumsum(numbers)[:-1]]).astype(np.int64) if len(numbers) else numbers
    fans = np.maximum(numbers - 2, 0)
    if not len(numbers) or not 0 < fans.sum() <= MOST_FACES:
        message = f"The file has {fans.sum()} triangles; a mesh has from 1 to {MOST_FACES}."
        raise InputError("mesh-empty", f"{message} A cloud of points is LAS, LAZ, E57 or PLY.", path=path)
    start = np.repeat(first, fans)
    step = np.arange(len(start)) - np.repeat(np.cumsum(fans) - fans, fans)
    faces = np.column_stack([corners[start], corners[start + step + 1], corners[start + step + 2]])
    if not np.isfinite(vertices[faces.ravel()]).all():
        raise InputError("not-finite", "contains coordinates that are not finite.", path=path)
    return TriangleMesh(path, vertices, faces)
