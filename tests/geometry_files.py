"""Files of measured geometry as other programs write them: E57 by libE57Format, meshes by trimesh."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from pye57 import libe57

from tests.towns import Town

IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ScanFile:
    """Scan of an E57: points (P, 3) of the file's frame, a pose (quaternion w, x, y, z), and which are invalid."""

    points: np.ndarray
    quat_wxyz: tuple[float, ...] | None = IDENTITY
    center: Sequence[float] = (0.0, 0.0, 0.0)
    invalid: np.ndarray | None = None
    colour: bool = False
    extra: dict[str, np.ndarray] = field(default_factory=dict)


def rotation_of(quat_wxyz: Sequence[float]) -> np.ndarray:
    return np.asarray(trimesh.transformations.quaternion_matrix(quat_wxyz)[:3, :3])


def write_e57(path: Path, scans: Sequence[ScanFile], *, kind: str = "double", crs: str = "") -> None:
    """Write scans whose coordinates are `double`, `single`, `scaled` integers of 0.1 mm, or `spherical`."""
    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    root = file.root()
    for name, value in {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": "{a}",
        "coordinateMetadata": crs,
    }.items():
        root.set(name, libe57.StringNode(file, value))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    data = libe57.VectorNode(file, True)
    root.set("data3D", data)
    root.set("images2D", libe57.VectorNode(file, True))
    for scan in scans:
        node = libe57.StructureNode(file)
        node.set("guid", libe57.StringNode(file, "{b}"))
        if scan.quat_wxyz is not None:
            node.set("pose", _pose(file, scan))
        columns = _columns(scan, kind)
        prototype = libe57.StructureNode(file)
        for name, values in columns.items():
            prototype.set(name, _field(file, name, values, kind))
        points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
        node.set("points", points)
        data.append(node)
        buffers = libe57.VectorSourceDestBuffer()
        for name, values in columns.items():
            buffers.append(libe57.SourceDestBuffer(file, name, values, len(values), True, True))
        writer = points.writer(buffers)
        writer.write(len(scan.points))
        writer.close()
    file.close()


def _pose(file: Any, scan: ScanFile) -> Any:
    pose, turn, shift = (libe57.StructureNode(file) for _ in range(3))
    for name, value in zip("wxyz", scan.quat_wxyz or IDENTITY, strict=True):
        turn.set(name, libe57.FloatNode(file, value))
    for name, value in zip("xyz", scan.center, strict=True):
        shift.set(name, libe57.FloatNode(file, float(value)))
    pose.set("rotation", turn)
    pose.set("translation", shift)
    return pose


def _columns(scan: ScanFile, kind: str) -> dict[str, np.ndarray]:
    local = (scan.points - np.asarray(scan.center)) @ rotation_of(scan.quat_wxyz or IDENTITY)
    names = ("cartesianX", "cartesianY", "cartesianZ")
    if kind == "spherical":
        names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
        reach = np.linalg.norm(local, axis=1)
        elevation = np.arcsin(local[:, 2] / reach)
        local = np.column_stack([reach, np.arctan2(local[:, 1], local[:, 0]), elevation])
    columns = {name: np.ascontiguousarray(local[:, axis]) for axis, name in enumerate(names)}
    if scan.invalid is not None:
        columns[f"{names[0][:9]}InvalidState"] = scan.invalid.astype(np.int8)
    if scan.colour:
        columns |= {f"color{one}": np.full(len(local), 200, np.uint8) for one in ("Red", "Green", "Blue")}
        columns["intensity"] = np.linspace(0, 1, len(local))
    return columns


def _field(file: Any, name: str, values: np.ndarray, kind: str) -> Any:
    if "State" in name:
        return libe57.IntegerNode(file, 0, 0, 2)
    if name.startswith("color"):
        return libe57.IntegerNode(file, 0, 0, 255)
    if kind == "scaled" and name.startswith("cartesian"):
        most = int(np.abs(values).max() / 1e-4) + 2
        return libe57.ScaledIntegerNode(file, 0, -most, most, 1e-4, 0.0)
    precision = libe57.E57_SINGLE if kind == "single" else libe57.E57_DOUBLE
    return libe57.FloatNode(file, 0.0, precision)


def mesh_of(town: Town, half_m: float = 24.0) -> trimesh.Trimesh:
    """The ground and the boxes of a town, as triangles."""
    boxes = [trimesh.creation.box(bounds=np.stack(box)) for box in town.boxes]
    corners = np.array([[-half_m, -half_m, 0], [half_m, -half_m, 0], [half_m, half_m, 0], [-half_m, half_m, 0]])
    ground = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    whole = trimesh.util.concatenate([ground, *boxes])
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def distance_to(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distances (P,) of points from the planes of the nearest triangles whose boxes hold them."""
    triangles, normals = mesh.triangles, mesh.face_normals
    off = np.abs(np.einsum("pfi,fi->pf", points[:, None] - triangles[None, :, 0], normals))
    slack = 0.01
    low, high = triangles.min(axis=1) - slack, triangles.max(axis=1) + slack
    inside = ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2)
    return np.asarray(np.where(inside, off, np.inf).min(axis=1))


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write an EXR of lines without compression; channels (H, W) of 16- or 32-bit floats."""

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return f"{name}\0{kind}\0".encode() + struct.pack("<I", len(data)) + data

    names = sorted(channels)
    height, width = channels[names[0]].shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<i4xii", 1 if channels[name].dtype == np.float16 else 2, 1, 1)
        for name in names
    )
    head = struct.pack("<II", 20000630, 2) + attribute("channels", "chlist", listed + b"\0")
    head += attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
    head += attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
    head += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    head += attribute("screenWindowCenter", "v2f", bytes(8))
    head += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    lines = [b"".join(channels[name][row].tobytes() for name in names) for row in range(height)]
    size = 8 + len(lines[0])
    start = len(head) + 8 * height
    table = struct.pack(f"<{height}Q", *(start + row * size for row in range(height)))
    body = b"".join(struct.pack("<ii", row, len(line)) + line for row, line in enumerate(lines))
    path.write_bytes(head + table + body)
