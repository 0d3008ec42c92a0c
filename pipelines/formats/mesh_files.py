"""Files of triangle meshes: PLY with colours of the vertices, binary glTF and OBJ with a texture."""

from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData, PlyElement

from pipelines.core.json_values import Json
from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.formats.cloud_ply import COLOURS, set_columns
from pipelines.formats.gltf import glb_of

_MOST_OF_A_HEADER = 4096
SIGMAS = ("sigma_h", "sigma_v")
_FLOAT, _UNSIGNED_INT, _ARRAY, _ELEMENTS = 5126, 5125, 34962, 34963


def write_mesh_ply(
    path: Path,
    vertices: FloatArray,
    faces: IntArray,
    rgb: ByteArray,
    *,
    double: bool,
    sigma: tuple[FloatArray, FloatArray] | None = None,
) -> None:
    """Write vertices (V, 3) with colours (V, 3) and faces (F, 3); coordinates are doubles or floats.

    Args:
        sigma: horizontal and vertical σ (V,) of the vertices in metres, NaN where unknown; None: no such columns.
    """
    kind = "<f8" if double else "<f4"
    columns = [*((axis, kind) for axis in "xyz"), *((colour, "u1") for colour in COLOURS)]
    names = () if sigma is None else SIGMAS
    vertex = np.empty(len(vertices), [*columns, *((name, "<f4") for name in names)])
    set_columns(vertex, "xyz", vertices)
    set_columns(vertex, COLOURS, rgb)
    if sigma is not None:
        set_columns(vertex, SIGMAS, np.column_stack(sigma))
    face = np.empty(len(faces), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = faces
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]
    # plyfile writes lists one by one, 2 µs each. Here each begins with its length.
    rows = np.empty(len(faces), [("length", "u1"), ("vertex_indices", "<i4", (3,))])
    rows["length"], rows["vertex_indices"] = 3, faces
    with path.open("wb") as file:
        file.write((PlyData(elements, byte_order="<").header + "\n").encode("ascii"))
        file.write(vertex.data)
        file.write(rows.data)


def read_mesh_ply(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh of triangles that this program or COLMAP wrote.

    Examples:
        >>> corners, faces = np.array([[0.0, 0, 7], [1, 0, 7], [0, 1, 7]]), np.array([[0, 1, 2]])
        >>> write_mesh_ply(Path("mesh.ply"), corners, faces, np.zeros((3, 3), np.uint8), double=False)
        >>> vertices, faces = read_mesh_ply(Path("mesh.ply"))
        >>> vertices.tolist(), faces.tolist()
        ([[0.0, 0.0, 7.0], [1.0, 0.0, 7.0], [0.0, 1.0, 7.0]], [[0, 1, 2]])
    """
    with path.open("rb") as file:
        header = file.read(_MOST_OF_A_HEADER)
    corners = "vertex_indices" if b" vertex_indices" in header else "vertex_index"
    # With lists of known length, faces are one array, and not millions of lists.
    ply = PlyData.read(str(path), known_list_len={"face": {corners: 3}})
    vertices = np.column_stack([ply["vertex"][axis] for axis in "xyz"]).astype(np.float64)
    return vertices, np.asarray(ply["face"][corners]).reshape(-1, 3).astype(np.int64)


def write_oriented_points(path: Path, points: FloatArray, normals: FloatArray) -> None:
    """Write points (N, 3) with unit normals (N, 3) as a PLY of floats."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    vertex = np.empty(len(points), [(name, "<f4") for name in names])
    set_columns(vertex, names, np.column_stack([points, normals]))
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))


def texture_png(image: ByteArray) -> bytes:
    """Return an image (H, W, 3) RGB as PNG."""
    return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())


def write_mesh_glb(
    path: Path, vertices: FloatArray, faces: IntArray, uv: FloatArray, image: ByteArray, *, extras: Json
) -> None:
    """Write vertices (V, 3) of a z-up frame with a texture (H, W, 3) as a glb, which a node turns y-up.

    The material is unlit, since the photographs have the light of the day, and seen from both sides.
    """
    position, texture_uv = vertices.astype("<f4"), uv.astype("<f4")
    data = [position.tobytes(), texture_uv.tobytes(), faces.astype("<u4").tobytes(), texture_png(image)]
    start = np.cumsum([0, *(len(part) + -len(part) % 4 for part in data)]).tolist()
    targets: tuple[dict[str, int], ...] = ({"target": _ARRAY}, {"target": _ARRAY}, {"target": _ELEMENTS}, {})
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    document = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0},
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {
                "bufferView": 0, "componentType": _FLOAT, "count": len(position), "type": "VEC3",
                "min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": len(texture_uv), "type": "VEC2"},
            {"bufferView": 2, "componentType": _UNSIGNED_INT, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": first, "byteLength": len(part), **target}
            for first, part, target in zip(start, data, targets, strict=False)
        ],
    }  # fmt: skip
    binary = b"".join(part + bytes(-len(part) % 4) for part in data)
    path.write_bytes(glb_of(primitive, document, binary, extras))


def write_mesh_obj(path: Path, vertices: FloatArray, faces: IntArray, uv: FloatArray, image: ByteArray) -> None:
    """Write an OBJ with its material (.mtl) and texture (.png) beside it; vertices in millimetres or finer."""
    path.with_suffix(".png").write_bytes(texture_png(image))
    path.with_suffix(".mtl").write_text(f"newmtl photographs\nKa 0 0 0\nKd 1 1 1\nmap_Kd {path.stem}.png\n")
    with path.open("w", encoding="ascii") as file:
        file.write(f"mtllib {path.stem}.mtl\nusemtl photographs\n")
        np.savetxt(file, vertices, "v %.4f %.4f %.4f")
        np.savetxt(file, np.column_stack([uv[:, 0], 1 - uv[:, 1]]), "vt %.6f %.6f")
        np.savetxt(file, np.repeat(faces + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
