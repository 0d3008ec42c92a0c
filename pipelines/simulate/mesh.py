"""Mesh of the scene, its terrain, and ray casting against it with Embree (the sole home of embreex)."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.extras import require
from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray

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
    TAG = 9


@dataclass(frozen=True)
class TextureParameters:
    """Parameters of the texture of one surface: a row of the table that the textures read."""

    base: Color  # linear albedo
    accent: Color = (0.5, 0.5, 0.5)  # linear albedo
    style: int = 0  # of walls: 0 plaster, 1 masonry, 2 panels; of tags: their dictionary
    floor_m: float = 3.0  # height of a storey
    pitch_m: float = 3.0  # distance between windows
    window_m: tuple[float, float] = (1.2, 1.5)  # width and height
    sill_m: float = 0.9  # height of a window above the floor
    top_m: float = 0.0  # above it there are no windows
    shop: bool = False  # the ground floor has shop windows
    # Place in the noise, so that no two surfaces look alike; of tags: their number, and 0
    shift_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Mesh:
    """T triangles."""

    corners: FloatArray  # (T, 3, 3) float64, metres in geo
    normals: Float32Array  # (T, 3, 3) float32, unit normals at the corners
    material: ByteArray  # (T,) uint8, a `Material`
    texture: NDArray[np.int32]  # (T,) int32, row of `texture_params`
    u_axis: Float32Array  # (T, 3) float32, direction of the texture's coordinate, in metres
    v_axis: Float32Array  # (T, 3) float32
    uv_shift: Float32Array  # (T, 2) float32, added to these coordinates
    texture_params: Float32Array  # (F, 16) float32, rows of `TextureParameters`


class MeshBuilder:
    def __init__(self) -> None:
        self._parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._texture_params: list[tuple[float, ...]] = []

    def add_texture(self, texture: TextureParameters) -> int:
        """Register texture parameters, and return their row; the file of textures names its columns."""
        self._texture_params.append((
            *texture.base, *texture.accent, float(texture.style), texture.floor_m, texture.pitch_m,
            *texture.window_m, texture.sill_m, texture.top_m, float(texture.shop), *texture.shift_m,
        ))  # fmt: skip
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
        v_axis = (d - a) - ((d - a) @ u_axis) * u_axis
        v_axis /= np.linalg.norm(v_axis)
        self.triangles(np.array([[a, b, c], [a, c, d]]), material, texture, (a, u_axis, v_axis))

    def box(self, low: ArrayLike, size: ArrayLike, axes: FloatArray, material: Material, texture: int) -> None:
        """Add a box without its bottom: centre of the bottom (3,), size (3,), axes (3, 3) as rows."""
        half = np.asarray(size, dtype=np.float64) / 2
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        bottom = np.asarray(low) + (signs * half[:2]) @ axes[:2]
        top = bottom + 2 * half[2] * axes[2]
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
            self.quad([bottom[i], bottom[j], top[j], top[i]], material, texture)
        self.quad(top, material, texture)

    @property
    def count(self) -> int:
        """Number of triangles so far."""
        return sum(len(corners) for corners, _, _ in self._parts)

    def build(self) -> Mesh:
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


MISS = -1


@dataclass(frozen=True)
class Hits:
    """First hits of N rays."""

    triangle: NDArray[np.int32]  # (N,) int32, or `MISS`
    distance: Float32Array  # (N,) float32, in units of the direction's length
    barycentric: Float32Array  # (N, 2) float32, weights of the triangle's corners 1 and 2


class Raycaster:
    """Ray caster of a mesh; a BackendUnavailableError: embreex is not installed."""

    def __init__(self, mesh: Mesh) -> None:
        require("simulator")
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._mesh = mesh
        self._scene = EmbreeScene(robust=True)
        corners = np.ascontiguousarray(mesh.corners.reshape(-1, 3), dtype=np.float32)
        self._geometry = TriangleMesh(self._scene, corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))

    def first_hits(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the first hits of rays from origins (N, 3) along directions (N, 3)."""
        hits = self._scene.run(*_rays(origins, directions), output=1)
        return Hits(hits["primID"], hits["tfar"], np.stack([hits["u"], hits["v"]], axis=1))

    def blocked(self, origins: ArrayLike, directions: ArrayLike) -> BoolArray:
        """Return whether rays hit any triangle: (N,)."""
        hit: BoolArray = self._scene.run(*_rays(origins, directions), query="OCCLUDED") != MISS
        return hit

    def exact_distance(self, origin: FloatArray, directions: FloatArray, hits: Hits) -> FloatArray:
        """Return distances (N,) in float64 to the planes of the triangles that rays hit; NaN for a miss.

        Embree's own distances are single precision, which means centimetres at the horizon.
        """
        corners = self._mesh.corners[hits.triangle]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.einsum("ni,ni->n", corners[:, 0] - origin, normal) / np.einsum(
                "ni,ni->n", directions, normal
            )
        return np.where(hits.triangle == MISS, np.nan, distance)


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Float32Array, Float32Array]:
    towards = np.ascontiguousarray(directions, dtype=np.float32)
    start = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, dtype=np.float32), towards.shape))
    return start, towards


HORIZON_M = 1600.0
_INNER_M, _CELL_M = 150.0, 2.5


@dataclass(frozen=True)
class Mound:
    """Round heap on the terrain, or a pit if its height is negative: half a period of a cosine from its middle (2,)
    in geo to its rim.
    """

    middle: FloatArray
    radius_m: float
    height_m: float


@dataclass(frozen=True)
class Terrain:
    """Terrain whose height is a sum of W waves (W, 2) in radians per metre, east and north; zero at the origin.

    The amplitudes (W,) are those in the town and at the horizon.
    """

    waves: FloatArray
    phases: FloatArray
    near_m: FloatArray
    far_m: FloatArray
    mounds: tuple[Mound, ...] = ()

    def height(self, xy: ArrayLike) -> FloatArray:
        """Return heights (…,) in metres of places (…, 2)."""
        place = np.asarray(xy, dtype=np.float64)
        raised = np.sin(place @ self.waves.T + self.phases) - np.sin(self.phases)
        distance = np.linalg.norm(place, axis=-1)
        hills = np.clip((distance - 160.0) / 500.0, 0.0, 1.0)[..., None] ** 2
        height = np.asarray((raised * (self.near_m + hills * self.far_m)).sum(axis=-1))
        for mound in self.mounds:
            share = np.minimum(np.linalg.norm(place - mound.middle, axis=-1) / mound.radius_m, 1.0)
            height = height + mound.height_m * (0.5 + 0.5 * np.cos(np.pi * share))
        return height

    def normal(self, xy: FloatArray) -> FloatArray:
        """Return upward unit normals (N, 3) at places (N, 2)."""
        step = 0.5 * np.eye(2)
        east, north = (self.height(xy + aside) - self.height(xy - aside) for aside in step)
        normal = np.stack([-east, -north, np.ones(len(xy))], axis=1)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def make_terrain(relief_m: float, rng: np.random.Generator) -> Terrain:
    """Return terrain whose height in the town varies by about ± `relief_m`."""
    lengths = np.array([420.0, 260.0, 150.0, 90.0])
    bearing = rng.uniform(0, 2 * np.pi, len(lengths))
    waves = 2 * np.pi / lengths[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    shares = np.array([0.5, 0.3, 0.15, 0.05])
    return Terrain(
        waves, rng.uniform(0, 2 * np.pi, len(lengths)), relief_m * shares, np.array([16.0, 9.0, 3.0, 0.5])
    )


def add_terrain(builder: MeshBuilder, terrain: Terrain, axes: FloatArray, texture: TextureParameters) -> None:
    """Add the terrain as a grid, fine in the town and coarse beyond; `axes` (3, 3) are the town's."""
    inner = np.arange(0.0, _INNER_M + _CELL_M / 2, _CELL_M)
    outer = np.geomspace(_INNER_M, HORIZON_M, 40)[1:]
    half = np.concatenate([inner, outer])
    line = np.concatenate([-half[:0:-1], half])
    east, north = np.meshgrid(line, line, indexing="ij")
    places = np.stack([east.ravel(), north.ravel()], axis=1)
    vertices = np.concatenate([places, terrain.height(places)[:, None]], axis=1)
    index = np.arange(len(places)).reshape(len(line), len(line))
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    builder.triangles(
        vertices[faces],
        Material.TERRAIN,
        builder.add_texture(texture),
        (np.zeros(3), axes[0], axes[1]),
        terrain.normal(places)[faces],
    )
