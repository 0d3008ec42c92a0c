"""Triangles with the data of their texture: material, a row of parameters, and a plane for its coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.types import ByteArray, Float32Array, FloatArray

Color = tuple[float, float, float]


class Material(IntEnum):
    """Material of a triangle; determines its texture."""

    TERRAIN = 0
    WALL = 1
    TILES = 2
    FLAT_ROOF = 3
    PLAIN = 4
    LEAVES = 5
    CAR = 6
    SOLAR = 7
    TARGET = 8


@dataclass(frozen=True)
class TextureParameters:
    """Parameters of the texture of one surface: a row of the table that the textures read.

    Attributes:
        base, accent: linear albedo.
        style: 0 plaster, 1 masonry, 2 panels (walls only).
        floor_m, pitch_m: height of a storey and distance between windows.
        window_m: width and height of a window; sill_m: its height above the floor.
        top_m: height above which there are no windows.
        shop: whether the ground floor has shop windows.
        shift_m: place of the surface in the noise, so that no two surfaces look alike.
    """

    base: Color
    accent: Color = (0.5, 0.5, 0.5)
    style: int = 0
    floor_m: float = 3.0
    pitch_m: float = 3.0
    window_m: tuple[float, float] = (1.2, 1.5)
    sill_m: float = 0.9
    top_m: float = 0.0
    shop: bool = False
    shift_m: tuple[float, float] = (0.0, 0.0)

    def row(self) -> tuple[float, ...]:
        """Return the row of the table; the file of textures names its columns."""
        return (
            *self.base, *self.accent, float(self.style), self.floor_m, self.pitch_m, *self.window_m,
            self.sill_m, self.top_m, float(self.shop), *self.shift_m,
        )  # fmt: skip


@dataclass(frozen=True)
class Mesh:
    """T triangles.

    Attributes:
        corners: (T, 3, 3) float64, metres in geo.
        normals: (T, 3, 3) float32, unit normals at the corners.
        material: (T,) uint8, a `Material`.
        texture: (T,) int32, row of `texture_params`.
        u_axis, v_axis: (T, 3) float32, directions of the texture's coordinates, in metres.
        uv_shift: (T, 2) float32, added to these coordinates.
        texture_params: (F, 16) float32, rows of `TextureParameters`.
    """

    corners: FloatArray
    normals: Float32Array
    material: ByteArray
    texture: NDArray[np.int32]
    u_axis: Float32Array
    v_axis: Float32Array
    uv_shift: Float32Array
    texture_params: Float32Array


class MeshBuilder:
    """Collects surfaces into a `Mesh`."""

    def __init__(self) -> None:
        self._parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._texture_params: list[tuple[float, ...]] = []

    def add_texture(self, add_texture: TextureParameters) -> int:
        """Register texture parameters, and return their row."""
        self._texture_params.append(add_texture.row())
        return len(self._texture_params) - 1

    def triangles(
        self,
        corners: FloatArray,
        material: Material,
        texture: int,
        frame: tuple[ArrayLike, ArrayLike, ArrayLike],
        normals: FloatArray | None = None,
    ) -> None:
        """Add triangles (T, 3, 3) with a common `frame`: the texture's origin, u axis and v axis."""
        if normals is None:
            flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
            normals = np.repeat(flat[:, None], 3, axis=1)
        origin, u_axis, v_axis = (np.asarray(axis, dtype=np.float64) for axis in frame)
        shared = np.concatenate([[material, texture], u_axis, v_axis, [-origin @ u_axis, -origin @ v_axis]])
        self._parts.append((corners, normals, np.broadcast_to(shared, (len(corners), len(shared)))))

    def quad(self, corners: ArrayLike, material: Material, texture: int) -> None:
        """Add a quadrilateral (4, 3), counter-clockwise from outside; u runs along its first side from corner 0."""
        a, b, c, d = np.asarray(corners, dtype=np.float64)
        u_axis = (b - a) / np.linalg.norm(b - a)
        up = d - a
        v_axis = up - (up @ u_axis) * u_axis
        v_axis /= np.linalg.norm(v_axis)
        self.triangles(np.array([[a, b, c], [a, c, d]]), material, texture, (a, u_axis, v_axis))

    def box(self, low: ArrayLike, size: ArrayLike, axes: FloatArray, material: Material, texture: int) -> None:
        """Add a box without its bottom: centre of the bottom (3,), size (3,), axes (3, 3) as rows."""
        half = np.asarray(size, dtype=np.float64) / 2
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        bottom = np.asarray(low) + (signs * half[:2]) @ axes[:2]
        top = bottom + 2 * half[2] * axes[2]
        for i in range(4):
            j = (i + 1) % 4
            self.quad([bottom[i], bottom[j], top[j], top[i]], material, texture)
        self.quad(top, material, texture)

    def build(self) -> Mesh:
        """Return the mesh of all triangles collected so far."""
        corners, normals, shared = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return Mesh(
            corners=corners,
            normals=normals.astype(np.float32),
            material=shared[:, 0].astype(np.uint8),
            texture=shared[:, 1].astype(np.int32),
            u_axis=shared[:, 2:5].astype(np.float32),
            v_axis=shared[:, 5:8].astype(np.float32),
            uv_shift=shared[:, 8:10].astype(np.float32),
            texture_params=np.array(self._texture_params, dtype=np.float32),
        )
