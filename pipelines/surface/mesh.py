"""Triangle meshes: areas, normals, distances, evenly spread points, connected parts, holes and what closes them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pipelines.core.types import BoolArray, FloatArray, IntArray

_NEAR_FACES = 4  # of those nearest a vertex whose distance is measured
_MOST_SAMPLES = 60_000_000
# Steps of the two coordinates within triangles: multiples of them fill a square evenly (doi 10.1016/0022-314X(89)
# 90035-5: the generalised golden ratio).
_STEPS = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True)
class RawMesh:
    """V vertices (V, 3) in metres, F faces (F, 3), anticlockwise seen from outside."""

    vertices: FloatArray
    faces: IntArray


def vertex_normals(mesh: RawMesh) -> FloatArray:
    """Return unit normals (V, 3): means of those of the faces, weighted by their areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    cross, normal = np.cross(b - a, c - a), np.zeros_like(mesh.vertices)
    for axis in range(3):
        normal[:, axis] = np.bincount(mesh.faces.ravel(), np.repeat(cross[:, axis], 3), len(normal))
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30))


def compact(mesh: RawMesh) -> RawMesh:
    """Return a mesh without the vertices that no face has."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    return RawMesh(mesh.vertices[used], (np.cumsum(used) - 1)[mesh.faces])


def distances_from_mesh(points: FloatArray, mesh: RawMesh, step_m: float) -> FloatArray:
    """Return distances (N,) of points from a mesh, or slightly more; samples `step_m` apart find the faces."""
    from trimesh.triangles import closest_point

    corners = mesh.vertices[mesh.faces]
    area = triangle_areas(mesh.vertices, mesh.faces)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    count = np.ceil(np.maximum(2 * area / step_m**2, longest / step_m)).astype(np.int64) + 1
    face = np.repeat(np.arange(len(corners)), count)
    weight = np.sort(np.random.default_rng(0).random((len(face), 2)), axis=1)
    weights = np.column_stack([weight[:, 0], weight[:, 1] - weight[:, 0], 1 - weight[:, 1]])
    tree = KDTree(np.einsum("nk,nkj->nj", weights, corners[face]), balanced_tree=False)
    _, near = tree.query(points, k=min(_NEAR_FACES, len(face)), workers=-1)
    near = np.reshape(near, (len(points), -1))
    distances = [np.linalg.norm(closest_point(corners[face[column]], points) - points, axis=1) for column in near.T]
    return np.asarray(np.min(distances, axis=0))


def without_islands(mesh: RawMesh, least_m2: float) -> tuple[RawMesh, int]:
    """Return the largest connected part and others of at least an area, and the number of the parts left out."""
    number, part = parts_of(mesh)
    area = triangle_areas(mesh.vertices, mesh.faces)
    areas = np.bincount(part, area, number)
    kept = areas >= min(least_m2, areas.max())
    return compact(RawMesh(mesh.vertices, mesh.faces[kept[part]])), int((~kept & (areas > 0)).sum())


def parts_of(mesh: RawMesh) -> tuple[int, IntArray]:
    """Return the number of connected parts, and that of each face (F,)."""
    edges, size = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices)
    number, of_vertex = connected_components(coo_array((np.ones(len(edges)), tuple(edges.T)), (size, size)))
    return number, of_vertex[mesh.faces[:, 0]]


def closed(mesh: RawMesh, depth_m: float) -> tuple[RawMesh, int]:
    """Return a watertight mesh, and the number of its first faces that are those of the surface.

    Each part's outer rim falls plumb to a common base `depth_m` below the lowest vertex. A fan joins the rim of any
    other hole to its middle: it follows no surface that anybody has seen. Faces at edges of more than two faces are
    dropped before.
    """
    while True:
        edge, count = edges_of(mesh.faces)
        crowded = count[edge] > 2
        if not crowded.any():
            break
        mesh = compact(RawMesh(mesh.vertices, mesh.faces[~crowded.reshape(-1, 3).any(axis=1)]))
    loops, outer = _rims(mesh)
    base_m = float(mesh.vertices[:, 2].min()) - depth_m
    vertices, faces, total = [mesh.vertices], [mesh.faces], len(mesh.vertices)
    for number, loop in enumerate(loops):
        ring, middle = loop, mesh.vertices[loop].mean(axis=0)
        if number in outer:
            after, foot = np.roll(loop, -1), total + np.arange(len(loop))
            vertices.append(np.column_stack([mesh.vertices[loop, :2], np.full(len(loop), base_m)]))
            faces += [np.column_stack([after, loop, foot]), np.column_stack([after, foot, np.roll(foot, -1)])]
            ring, middle, total = foot, np.array([*middle[:2], base_m]), total + len(loop)
        vertices.append(middle[None])
        faces.append(np.column_stack([np.roll(ring, -1), ring, np.full(len(ring), total)]))
        total += 1
    return RawMesh(np.concatenate(vertices), np.concatenate(faces)), len(mesh.faces)


@dataclass(frozen=True)
class Hole:
    """Hole of a mesh: the middle of the box around its rim, and the longest side of that."""

    middle: FloatArray
    width_m: float


def holes_of(mesh: RawMesh) -> list[Hole]:
    """Return the holes inside the outer rims of a mesh's parts, the widest first."""
    loops, outer = _rims(mesh)
    rims = [mesh.vertices[loop] for number, loop in enumerate(loops) if number not in outer]
    holes = [Hole((rim.min(axis=0) + rim.max(axis=0)) / 2, float(np.ptp(rim, axis=0).max())) for rim in rims]
    return sorted(holes, key=lambda hole: -hole.width_m)


def open_share(mesh: RawMesh) -> float:
    """Return the share of the edges that have one face."""
    _, count = edges_of(mesh.faces)
    return float(np.mean(count == 1)) if len(count) else 0.0


def _rims(mesh: RawMesh) -> tuple[list[IntArray], set[int]]:
    """Return the rims of a mesh as cycles of vertices, and the numbers of each part's outer rim: widest in plan."""
    edge, count = edges_of(mesh.faces)
    loops = _cycles(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)[count[edge] == 1])
    _, part = parts_of(mesh)
    of_vertex = np.zeros(len(mesh.vertices), np.int64)
    of_vertex[mesh.faces] = part[:, None]
    reach = [float(np.linalg.norm(np.ptp(mesh.vertices[loop, :2], axis=0))) for loop in loops]
    outer: dict[int, int] = {}
    for number in np.argsort(reach, kind="stable"):
        outer[int(of_vertex[loops[number][0]])] = int(number)
    return loops, set(outer.values())


def edges_of(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the number of the edge (3F,) at each side of each face, and how many faces each edge has."""
    first, second = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T.astype(np.int64)
    # One number for both ends: it sorts fifteen times as fast as pairs do.
    side = np.minimum(first, second) * (int(faces.max(initial=0)) + 1) + np.maximum(first, second)
    _, edge, count = np.unique(side, return_inverse=True, return_counts=True)
    return edge, count


def _cycles(edges: IntArray) -> list[IntArray]:
    """Return directed edges (E, 2) as cycles that visit no vertex twice."""
    following: dict[int, list[int]] = {}
    for first, second in edges.tolist():
        following.setdefault(first, []).append(second)
    cycles = []
    for start in list(following):
        while following[start]:
            path, place = [start], {start: 0}
            while True:
                step = following[path[-1]].pop()
                if step not in place:
                    place[step] = len(path)
                    path.append(step)
                    continue
                cycle = path[place[step] :]
                cycles.append(np.array(cycle, dtype=np.int64))
                for vertex in cycle[1:]:
                    del place[vertex]
                path = path[: place[step] + 1]
                if len(path) == 1:
                    break
    return cycles


def triangle_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return the areas (F,) of triangles (F, 3) of vertices (V, 3)."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2)


def meets_box(
    vertices: FloatArray, faces: IntArray, low: FloatArray | float, high: FloatArray | float
) -> BoolArray:
    """Return whether the box around a triangle meets the box from `low` (3,) to `high` (3,), for each (F,)."""
    corners = vertices[faces]
    return np.asarray(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))


def samples(vertices: FloatArray, faces: IntArray, spacing_m: float, size: int) -> Iterator[FloatArray]:
    """Yield points (P, 3) on triangles (F, 3) of vertices (V, 3) in metres, P ≤ `size`, as a cloud has them.

    Each stands for an area of `spacing_m` squared: their number follows the area, however small the triangles.
    With more than 60 million points, they lie further apart.
    """
    until = np.cumsum(triangle_areas(vertices, faces))
    whole = float(until[-1]) if len(until) else 0.0
    if whole <= 0:
        return
    count = int(np.ceil(min(whole / spacing_m**2, _MOST_SAMPLES)))
    for first in range(0, count, size):
        number = np.arange(first, min(first + size, count))
        triangle = np.searchsorted(until, (number + 0.5) / count * whole)
        along = ((number[:, None] + 1) * _STEPS) % 1.0
        # The half of the square beyond the diagonal is folded onto the triangle.
        along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
        corner, second, third = (vertices[faces[triangle, place]] for place in range(3))
        yield corner + along[:, :1] * (second - corner) + along[:, 1:] * (third - corner)
