"""Triangles with what a texture needs to know: material, a row of parameters, and a plane for its coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.types import ByteArray, Float32Array, FloatArray

Color = tuple[float, float, float]


class Material(IntEnum):
    """What a triangle is made of; decides which texture it gets."""

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
class Finish:
    """Parameters of one surface's texture: a row of the table that the textures read.

    Attributes:
        base, accent: linear albedo.
        style: 0 plaster, 1 masonry, 2 panels (walls only).
        floor_m, pitch_m: height of a storey and distance between windows.
        window_m: width and height of a window; sill_m: its height above the floor.
        top_m: windows end here.
        shop: whether the ground floor has shop windows.
        shift_m: where in the noise the surface lies, so that no two look alike.
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
        """As a row of the table; the textures name the columns in `COLUMNS`."""
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
        finish: (T,) int32, row of `finishes`.
        u_axis, v_axis: (T, 3) float32, directions of the texture's coordinates, in metres.
        uv_shift: (T, 2) float32, added to them.
        finishes: (F, 16) float32.
    """

    corners: FloatArray
    normals: Float32Array
    material: ByteArray
    finish: NDArray[np.int32]
    u_axis: Float32Array
    v_axis: Float32Array
    uv_shift: Float32Array
    finishes: Float32Array


class MeshBuilder:
    """Collects surfaces into a `Mesh`."""

    def __init__(self) -> None:
        self._parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._finishes: list[tuple[float, ...]] = []

    def finish(self, finish: Finish) -> int:
        """Register a finish; returns its row."""
        self._finishes.append(finish.row())
        return len(self._finishes) - 1

    def triangles(
        self,
        corners: FloatArray,
        material: Material,
        finish: int,
        frame: tuple[ArrayLike, ArrayLike, ArrayLike],
        normals: FloatArray | None = None,
    ) -> None:
        """Add triangles (T, 3, 3); `frame` is the texture's origin, u axis and v axis, one for all."""
        if normals is None:
            flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
            normals = np.repeat(flat[:, None], 3, axis=1)
        origin, u_axis, v_axis = (np.asarray(axis, dtype=np.float64) for axis in frame)
        shared = np.concatenate([[material, finish], u_axis, v_axis, [-origin @ u_axis, -origin @ v_axis]])
        self._parts.append((corners, normals, np.broadcast_to(shared, (len(corners), len(shared)))))

    def quad(self, corners: ArrayLike, material: Material, finish: int) -> None:
        """Add a quadrilateral (4, 3), counter-clockwise from outside; u runs along its first side from corner 0."""
        a, b, c, d = np.asarray(corners, dtype=np.float64)
        u_axis = (b - a) / np.linalg.norm(b - a)
        up = d - a
        v_axis = up - (up @ u_axis) * u_axis
        v_axis /= np.linalg.norm(v_axis)
        self.triangles(np.array([[a, b, c], [a, c, d]]), material, finish, (a, u_axis, v_axis))

    def box(self, low: ArrayLike, size: ArrayLike, axes: FloatArray, material: Material, finish: int) -> None:
        """Add a box without its bottom: centre of the bottom (3,), size (3,), axes (3, 3) as rows."""
        half = np.asarray(size, dtype=np.float64) / 2
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        bottom = np.asarray(low) + (signs * half[:2]) @ axes[:2]
        top = bottom + 2 * half[2] * axes[2]
        for i in range(4):
            j = (i + 1) % 4
            self.quad([bottom[i], bottom[j], top[j], top[i]], material, finish)
        self.quad(top, material, finish)

    def build(self) -> Mesh:
        """All triangles collected so far."""
        corners, normals, shared = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return Mesh(
            corners=corners,
            normals=normals.astype(np.float32),
            material=shared[:, 0].astype(np.uint8),
            finish=shared[:, 1].astype(np.int32),
            u_axis=shared[:, 2:5].astype(np.float32),
            v_axis=shared[:, 5:8].astype(np.float32),
            uv_shift=shared[:, 8:10].astype(np.float32),
            finishes=np.array(self._finishes, dtype=np.float32),
        )
