"""Surface through an oriented point cloud as a mesh: screened Poisson, cut where nothing was measured.

COLMAP's solver after Kazhdan and Hoppe (doi 10.1145/2487228.2487237) gives a surface without gaps. It also invents
one far from all points, which is cut; narrow gaps between points stay closed. Native code hears no interrupt, and
runs in a child process.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from pipelines.core.child import run_in_child
from pipelines.core.json_values import JsonValue
from pipelines.core.machine import thread_count
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.colmap import quiet_colmap
from pipelines.formats.mesh_files import read_mesh_ply, write_mesh_ply, write_oriented_points
from pipelines.surface.mesh import RawMesh, compact, parts_of
from pipelines.surface.mesh_rims import with_long_rims, with_smooth_rims

_CUBE = 1.1  # side of the octree over the longest side of the points' box
_SHALLOWEST, _DEEPEST = 5, 14  # of the octree
_RIM = (
    1.75  # spacings by which the surface may go beyond the points: farther, it was mostly wrong by 0.1 m and more
)
_CLOSED, _CLOSED_M = 10.0, 2.0  # widest gap that is closed: spacings, and metres, whichever is more
_CERTAIN = 0.5  # spacings: largest σ of a certain point
_POINT_WEIGHT = 4.0  # of the points' places over their normals; of 1, 4 and 16 the best on a simulated flight
_RIM_WEIGHT = 1.0  # of an open edge over the faces in the simplification: rims move by its error at most
_RIM_ERRORS = 2.0  # of the simplification: by so much its rims may move once more
_REMEDY = "Give a larger --voxel or a smaller --boundary."
_POINTS, _SURFACE, _CUT, _SIMPLE = "points.ply", "surface.ply", "cut.ply", "simple.ply"


@dataclass(frozen=True)
class MeasuredPoints:
    """N points of a surface in a frame, in metres."""

    position: FloatArray  # (N, 3)
    normal: FloatArray  # (N, 3) unit vectors, outwards
    sigma_m: FloatArray  # (N,) of the surface along the normal
    spacing_m: float

    @cached_property
    def tree(self) -> KDTree:
        """Tree of the places, which searches share."""
        return KDTree(self.position, balanced_tree=False)  # built in a third of the time, and asked once or twice


def poisson_depth(points: MeasuredPoints, voxel_m: float) -> int:
    """Return the depth of the octree whose finest cells are one to two voxels wide.

    A level more takes four times the time, and brought nothing on a simulated flight.
    """
    side_m = _CUBE * float(np.ptp(points.position, axis=0).max())
    return int(np.clip(np.floor(np.log2(max(side_m, voxel_m) / voxel_m)), _SHALLOWEST, _DEEPEST))


def rim_m(spacing_m: float) -> float:
    """Return how far the surface may go beyond the points."""
    return _RIM * spacing_m


def closed_gap_m(spacing_m: float) -> float:
    """Return the width of the widest gap between points that the surface closes."""
    return max(_CLOSED * spacing_m, _CLOSED_M)


def poisson_mesh(points: MeasuredPoints, voxel_m: float, folder: Path, progress: Progress = SILENT) -> RawMesh:
    """Return the surface through points, without what lies far from them; a scratch folder holds files meanwhile.

    1. Points with a large σ are left out near others (`certain_points`), and the solver runs.
    2. Faces farther than `rim_m` from all points, those with a large σ too, are cut. Otherwise a gap would be open
       between points that are used and the uncertain ones beyond them.
    3. Connected faces cut so are put back if none of them is farther than half of `closed_gap_m`: they close a gap.

    Raises:
        ResourceError: the memory is too small.
        CrashError: the solver failed.
    """
    used = certain_points(points)
    write_oriented_points(folder / _POINTS, used.position, used.normal)
    arguments = {
        "points": str(folder / _POINTS),
        "surface": str(folder / _SURFACE),
        "depth": poisson_depth(points, voxel_m),
    }
    try:
        run_in_child(f"{__name__}:solve_poisson", arguments, _REMEDY, progress, writes=folder)
        whole = RawMesh(*read_mesh_ply(folder / _SURFACE))
    finally:
        _remove(folder, _POINTS, _SURFACE)
    return near_points(whole, points)


def certain_points(points: MeasuredPoints) -> MeasuredPoints:
    """Return points without those with σ above half a spacing that have a better one within `closed_gap_m`.

    They blur what the others measure, and the surface closes gaps of that width. Farther away, they are all that is
    known.
    """
    uncertain = points.sigma_m > _CERTAIN * points.spacing_m
    if uncertain.all() or not uncertain.any():
        return points
    tree = KDTree(points.position[~uncertain], balanced_tree=False)
    rows = np.flatnonzero(uncertain)
    distance, _ = tree.query(points.position[rows], distance_upper_bound=closed_gap_m(points.spacing_m), workers=-1)
    kept = ~uncertain
    kept[rows] = np.isinf(distance)
    return MeasuredPoints(points.position[kept], points.normal[kept], points.sigma_m[kept], points.spacing_m)


def near_points(mesh: RawMesh, points: MeasuredPoints) -> RawMesh:
    """Return the faces of a mesh near points or in narrow gaps between them, as `poisson_mesh` says."""
    if not len(mesh.faces):
        return mesh
    widest_m = closed_gap_m(points.spacing_m) / 2
    beyond_m = max(widest_m, rim_m(points.spacing_m))
    distance, _ = points.tree.query(mesh.vertices, distance_upper_bound=1.01 * beyond_m, workers=-1)
    of_face = distance[mesh.faces].max(axis=1)
    kept = of_face <= rim_m(points.spacing_m)
    cut = np.flatnonzero(~kept)
    if len(cut):
        count, part = parts_of(RawMesh(mesh.vertices, mesh.faces[cut]))
        farthest = np.zeros(count)
        np.maximum.at(farthest, part, of_face[cut])
        kept[cut] = farthest[part] <= widest_m
    return compact(RawMesh(mesh.vertices, mesh.faces[kept]))


def solve_poisson(arguments: Mapping[str, JsonValue], progress: Progress) -> None:
    """Write the surface through the points of a file, in a child process.

    Threads share sums in an order that changes from run to run: the last digits of the vertices do too.
    """
    with quiet_colmap() as colmap, progress.task("surface"):
        options = colmap.PoissonMeshingOptions(
            depth=arguments["depth"], point_weight=_POINT_WEIGHT, trim=0.0, color=False, num_threads=thread_count()
        )
        colmap.poisson_meshing(arguments["points"], arguments["surface"], options)


def simplified(mesh: RawMesh, error_m: float, folder: Path, progress: Progress = SILENT) -> RawMesh:
    """Return a mesh with fewer faces; its open borders are smoothed before, and get fewer edges after it.

    Edges collapse as long as the distances of the new vertex from the planes of the faces that it replaces are not
    above `error_m`, as a root of the sum of squares (Garland and Heckbert, doi 10.1145/258734.258849).
    Borders, whose course nothing measures, move by twice as much (`with_long_rims`).
    """
    if error_m <= 0 or not len(mesh.faces):
        return mesh
    grey = np.zeros((len(mesh.vertices), 3), np.uint8)
    write_mesh_ply(folder / _CUT, with_smooth_rims(mesh).vertices, mesh.faces, grey, double=False)
    arguments = {"mesh": str(folder / _CUT), "simple": str(folder / _SIMPLE), "error": error_m}
    try:
        run_in_child(f"{__name__}:simplify", arguments, _REMEDY, progress, writes=folder)
        simple = compact(RawMesh(*read_mesh_ply(folder / _SIMPLE)))
    finally:
        _remove(folder, _CUT, _SIMPLE)
    return with_long_rims(simple, _RIM_ERRORS * error_m)


def simplify(arguments: Mapping[str, JsonValue], progress: Progress) -> None:
    """Write the simplified mesh of a file, in a child process."""
    with quiet_colmap() as colmap, progress.task("simplification"):
        options = colmap.MeshSimplificationOptions(
            target_face_ratio=np.finfo(np.float64).tiny,
            max_error=arguments["error"] ** 2,
            boundary_weight=_RIM_WEIGHT,
            interpolate_colors=False,
            num_threads=thread_count(),
        )
        colmap.simplify_mesh(arguments["mesh"], arguments["simple"], options)


def surface_sigma_at(vertices: FloatArray, points: MeasuredPoints) -> FloatArray:
    """Return σ (V,) in metres of vertices along their normal: that of the nearest point, and the way to it.

    Beside a point, within two spacings, only the distance from its plane counts; farther from all points, the whole
    distance, since nothing was measured there.
    """
    distance, nearest = points.tree.query(vertices, workers=-1)
    off = np.abs(np.einsum("vi,vi->v", vertices - points.position[nearest], points.normal[nearest]))
    beside: BoolArray = distance <= 2 * points.spacing_m
    return np.asarray(np.hypot(points.sigma_m[nearest], np.where(beside, off, distance)))


def _remove(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)
