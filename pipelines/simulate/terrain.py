"""Terrain: gentle relief in the town, hills towards the horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray
from pipelines.simulate.mesh import Material, MeshBuilder, TextureParameters

HORIZON_M = 1600.0
_INNER_M, _CELL_M = 150.0, 2.5


@dataclass(frozen=True)
class Terrain:
    """Terrain whose height is a sum of waves, zero at the origin.

    Attributes:
        waves: (W, 2) radians per metre, east and north.
        phases: (W,) radians.
        near_m, far_m: (W,) amplitudes in the town and at the horizon.
    """

    waves: FloatArray
    phases: FloatArray
    near_m: FloatArray
    far_m: FloatArray

    def height(self, xy: ArrayLike) -> FloatArray:
        """Return heights (…,) in metres of places (…, 2)."""
        place = np.asarray(xy, dtype=np.float64)
        raised = np.sin(place @ self.waves.T + self.phases) - np.sin(self.phases)
        distance = np.linalg.norm(place, axis=-1)
        hills = np.clip((distance - 160.0) / 500.0, 0.0, 1.0)[..., None] ** 2
        return np.asarray((raised * (self.near_m + hills * self.far_m)).sum(axis=-1))

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
