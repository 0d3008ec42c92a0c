"""Open borders of a mesh: smoothed before it is simplified, and with fewer edges after it.

A rim is where the surface was cut at the measured points or at the area: nothing was measured of its course, which
follows the faces of a voxel that were there. A simplification keeps each of their steps.
"""

from heapq import heapify, heappop, heappush

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.surface.mesh import RawMesh, compact, edges_of

_SMOOTHED = 10  # times that a vertex of a border moves half of the way to the middle of its neighbours
_TURNED = 0.4  # least cosine between the normals of a face before and after one of its vertices has moved
_TINY = 1e-12


def with_smooth_rims(mesh: RawMesh) -> RawMesh:
    """Return a mesh whose open borders run straight where they were steps of its faces.

    Vertices of a border move by less than the length of its edges, mostly. Where borders meet, they stay.
    """
    border, vertices = border_of(mesh), mesh.vertices.copy()
    simple = np.bincount(border.ravel(), minlength=len(vertices)) == 2
    for _ in range(_SMOOTHED):
        around = np.zeros_like(vertices)
        for own, other in ((0, 1), (1, 0)):
            np.add.at(around, border[:, own], vertices[border[:, other]])
        vertices[simple] = vertices[simple] / 2 + around[simple] / 4
    return RawMesh(vertices, mesh.faces)


def with_long_rims(mesh: RawMesh, tolerance_m: float) -> RawMesh:
    """Return a mesh without the vertices of its borders that lie within a tolerance of the border without them.

    Such a vertex is joined to one of its neighbours along the border, those that change it least first. A vertex
    stays where borders meet, and where a face would turn over.
    """
    rims = _Rims(mesh)
    waiting = [(rims.change_m(vertex), vertex) for vertex in rims.simple]
    heapify(waiting)
    while waiting:
        change_m, vertex = heappop(waiting)
        if change_m > tolerance_m:
            break
        if vertex not in rims.simple:
            continue
        now_m = rims.change_m(vertex)
        if now_m > change_m + _TINY:
            heappush(waiting, (now_m, vertex))
            continue
        for neighbour in rims.remove(vertex):
            if neighbour in rims.simple:
                heappush(waiting, (rims.change_m(neighbour), neighbour))
    return rims.mesh()


def border_of(mesh: RawMesh) -> IntArray:
    """Return the edges (E, 2) that have one face, in its direction."""
    edge, count = edges_of(mesh.faces)
    return np.asarray(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)[count[edge] == 1])


class _Rims:
    """Borders of a mesh as chains of vertices, from which single ones are removed."""

    def __init__(self, mesh: RawMesh) -> None:
        border, size = border_of(mesh), len(mesh.vertices)
        self._vertices, self._faces = mesh.vertices, mesh.faces.copy()
        self._kept = np.ones(len(mesh.faces), dtype=bool)
        once = (np.bincount(border[:, 0], minlength=size) == 1) & (np.bincount(border[:, 1], minlength=size) == 1)
        self.simple = set(np.flatnonzero(once).tolist())  # one border passes through each of these
        self._after = dict(border.tolist())
        self._before = {second: first for first, second in border.tolist()}
        on_rim = np.zeros(size, dtype=bool)
        on_rim[border] = True
        self._around: dict[int, set[int]] = {vertex: set() for vertex in np.flatnonzero(on_rim).tolist()}
        for face in np.flatnonzero(on_rim[mesh.faces].any(axis=1)).tolist():
            for vertex in self._faces[face].tolist():
                if vertex in self._around:
                    self._around[vertex].add(face)
        self._removed: dict[tuple[int, int], list[int]] = {}  # vertices that an edge stands for

    def mesh(self) -> RawMesh:
        return compact(RawMesh(self._vertices, self._faces[self._kept]))

    def change_m(self, vertex: int) -> float:
        """Return how far the border without a vertex is from that one and from those removed beside it."""
        first, last = self._before[vertex], self._after[vertex]
        points = self._vertices[
            [vertex, *self._removed.get((first, vertex), ()), *self._removed.get((vertex, last), ())]
        ]
        start = self._vertices[first]
        arm, way = points - start, self._vertices[last] - start
        along = np.clip(arm @ way / max(float(way @ way), _TINY), 0.0, 1.0)
        return float(np.sqrt(np.square(arm - along[:, None] * way).sum(axis=1).max()))

    def remove(self, vertex: int) -> tuple[int, ...]:
        """Join a vertex to a neighbour along the border, and return both neighbours; none: it has to stay."""
        first, last = self._before[vertex], self._after[vertex]
        ends = {first, last}
        # Borders of three edges are left alone: two would be none.
        if not ends <= self.simple or first == last or self._after[last] == first:
            return ()
        length = {end: float(np.linalg.norm(self._vertices[end] - self._vertices[vertex])) for end in ends}
        for end in sorted(ends, key=lambda each: (length[each], each)):
            if self._join(vertex, end, last if end == first else first):
                joined = [vertex, *self._removed.pop((first, vertex), ()), *self._removed.pop((vertex, last), ())]
                self._removed[first, last] = joined
                self._after[first], self._before[last] = last, first
                self.simple.discard(vertex)
                return first, last
        return ()

    def _join(self, vertex: int, end: int, other: int) -> bool:
        """Move a vertex to an end of its border's edge, if the mesh keeps its form."""
        around = self._neighbours(end)
        # The edge's face goes. Another vertex between both would leave an edge of three faces.
        if len(self._neighbours(vertex) & around) != 1 or other in around:
            return False
        moved = [face for face in self._around[vertex] if end not in self._faces[face]]
        faces = self._faces[moved]
        new = np.where(faces == vertex, end, faces)
        if self._turned(faces, new):
            return False
        for face in self._around.pop(vertex):
            if end in self._faces[face]:
                self._kept[face] = False
                for corner in self._faces[face].tolist():
                    if corner in self._around:
                        self._around[corner].discard(face)
        self._faces[moved] = new
        self._around[end].update(moved)
        return True

    def _neighbours(self, vertex: int) -> set[int]:
        return set(self._faces[list(self._around[vertex])].ravel().tolist()) - {vertex}

    def _turned(self, faces: IntArray, new: IntArray) -> bool:
        before, after = self._normals(faces), self._normals(new)
        sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        turned = np.einsum("fi,fi->f", before, after) < _TURNED * sizes
        return bool(turned.any() or (np.linalg.norm(after, axis=1) < _TINY).any())

    def _normals(self, faces: IntArray) -> FloatArray:
        a, b, c = (self._vertices[faces[:, corner]] for corner in range(3))
        return np.asarray(np.cross(b - a, c - a))
