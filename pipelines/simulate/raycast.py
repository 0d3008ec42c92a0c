"""Ray casting against a mesh with Embree (the sole home of embreex)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.errors import BackendUnavailableError
from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.simulate.mesh import Mesh

MISS = -1


@dataclass(frozen=True)
class Hits:
    """First hits of N rays.

    Attributes:
        triangle: (N,) int32, or `MISS`.
        distance: (N,) float32, in units of the direction's length.
        barycentric: (N, 2) float32, weights of the triangle's corners 1 and 2.
    """

    triangle: NDArray[np.int32]
    distance: Float32Array
    barycentric: Float32Array


class Raycaster:
    """Ray caster of a mesh.

    Raises:
        BackendUnavailableError: embreex is not installed (it has no wheel for this platform).
    """

    def __init__(self, mesh: Mesh) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise BackendUnavailableError(
                "the simulator needs the ray caster `embreex`: pip install embreex "
                "(wheels exist for Linux x86-64, macOS and Windows)"
            ) from error
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
