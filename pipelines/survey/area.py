"""Area of interest: the user's boundary, or the ground that enough photographs see.

Files are cut to it: a photograph shows far more than it measures.
"""

from dataclasses import dataclass
from typing import Any

import contourpy
import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely import MultiPolygon, Polygon

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef, lla_from_enu
from pipelines.geometry.cameras import project
from pipelines.geometry.footprints import PointSurface, border_rays
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.boundaries import Outlines, read_outlines
from pipelines.survey.options import LEAST_PHOTOGRAPHS, AreaOptions
from pipelines.survey.solution import Solution
from pipelines.survey.target_crs import TargetCrs

_CELLS = 120  # along the longer side of the scene
_OUTSIDE = 0.002  # fraction of the SfM points outside the extent of files on each side
_RIM = 0.01  # fraction of the scene's points outside the raster on each side
_FARTHEST_CELLS = 6.0  # distance from a point of the scene beyond which there is no scene
_COARSEST = 1.5  # largest width of a pixel on the ground over the median: beyond, rasters would promise too much
_SMOOTHED_CELLS = 4.0  # width of tongues that are left out, and of bays that are taken in, halved
_EDGES = 200  # pieces of a boundary's longer side, which may be bent in another CRS
_PLACES = 2000  # of the scene that tell units and layers of a drawing apart
LEAST_RAYS = 3  # of a point of the scene
_OUTLIERS = 0.005  # fraction of the points that are taken for errors above, and below


@dataclass(frozen=True)
class Area:
    """Area of interest in plan, east and north of `geo` in metres.

    `level_m` is the height of the ground, at which its outline goes through other coordinate systems.
    """

    polygon: Polygon | MultiPolygon
    level_m: float
    source: str  # file of the boundary, or whence the area is known
    measured: float | None = None  # share of it that the training views measure; None: there is no trained model
    is_outline: bool = False  # of what is measured, with the holes that `--fill` closes; else all is delivered

    @property
    def hectares(self) -> float:
        return float(self.polygon.area) / 1e4

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 2 or 3) in `geo` lie in the area."""
        shapely.prepare(self.polygon)
        return np.asarray(shapely.contains_xy(self.polygon, points[:, 0], points[:, 1]))

    def in_crs(self, target: TargetCrs) -> Any:
        """Return the polygon in the plan of a CRS; an InputError: it lies outside its domain."""

        def moved(plan: FloatArray) -> FloatArray:
            return target.xyz_from_geo(np.column_stack([plan, np.full(len(plan), self.level_m)]))[:, :2]

        return shapely.transform(_with_short_edges(self.polygon), moved)


@dataclass(frozen=True)
class Overlap:
    """How many photographs see each cell (R, C) of the scene: rows from the south, columns from the west.

    −1: no scene. `corner` is the south-western one of the first cell, in `geo`.
    """

    count: IntArray
    corner: FloatArray
    cell_m: float


def seen_area(solution: Solution, sfm: SparseModel, scene: FloatArray) -> Area:
    """Return the ground that enough photographs see, of a scene with points (N, 3) in `geo`.

    Raises:
        DegenerateGeometryError: there is none.
    """
    level_m = float(np.median(scene[:, 2])) if len(scene) else 0.0
    return Area(_seen_ground(solution, sfm, scene), level_m, f"ground that {LEAST_PHOTOGRAPHS} photographs see")


def boundary_area(options: AreaOptions, scene: FloatArray, origin: Origin | None) -> Area | None:
    """Return the area that the user states, of a survey with points (N, 3) in `geo`; None: none is stated.

    Raises:
        InputError: the boundary cannot be read, states no CRS, or holds none of the points; or the survey has no
            place on Earth.
    """
    if options.boundary is None:
        return None
    if origin is None:
        message = "The survey has a local metric frame, in which a boundary has no place."
        remedy = "Remove --boundary."
        raise InputError("not-on-earth", message, field="--boundary", remedy=remedy)
    path = options.boundary
    outlines = read_outlines(
        path,
        lla_from_enu(scene[:: max(len(scene) // _PLACES, 1)], origin),
        field="--boundary",
        crs=options.boundary_crs,
        crs_field="--boundary-crs",
    )

    def moved(one: Outlines) -> Any:
        def to_geo(plan: FloatArray) -> FloatArray:
            lla = one.lla(plan, path)
            # At the height of the survey: a place far above another has another plan in `geo`.
            lla[:, 2] = origin.alt_m
            return enu_from_ecef(ecef_from_lla(lla), origin)[:, :2]

        return shapely.make_valid(shapely.transform(_with_short_edges(shapely.union_all(one.polygons)), to_geo))

    polygon = shapely.union_all([moved(one) for one in outlines])
    area = Area(polygon, float(np.median(scene[:, 2])) if len(scene) else 0.0, path.name)
    if not area.contains(scene).any():
        message = "holds no point of the survey."
        remedy = "Check its CRS (--boundary-crs), and that it is of this place."
        raise InputError("boundary-elsewhere", message, path=path, field="--boundary", remedy=remedy)
    return area


def _with_short_edges(polygon: shapely.Geometry) -> Any:
    west, south, east, north = shapely.bounds(polygon).tolist()
    return shapely.segmentize(polygon, max(east - west, north - south) / _EDGES)


def scene_points(solution: Solution, sfm: SparseModel) -> FloatArray:
    """Return the SfM points (P, 3) in `geo` that lie within the scene: those at its rim are left out.

    Raises:
        DegenerateGeometryError: the SfM model has no points.
    """
    if not len(sfm.point_in_local):
        raise DegenerateGeometryError("no-sfm-points", "The SfM model has no points, so the extent is unknown.")
    points = solution.similarity.apply(solution.point_in_model(sfm))
    low, high = np.quantile(points[:, :2], [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    return np.asarray(points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)])


def corners(points: FloatArray) -> FloatArray:
    """Return the corners (8, 3) of the box around points."""
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)


def scene_in_geo(solution: Solution, sfm: SparseModel) -> FloatArray:
    """Return the SfM points (N, 3) in `geo` that three photographs show, without the highest and lowest."""
    rays = np.bincount(sfm.obs_point, minlength=len(sfm.point_in_local))
    return without_outliers(solution.similarity.apply(solution.point_in_model(sfm)[rays >= LEAST_RAYS]))


def without_outliers(points: FloatArray) -> FloatArray:
    """Return points (N, 3), z up, without the highest and lowest."""
    if not len(points):
        return points
    low, high = np.quantile(points[:, 2], [_OUTLIERS, 1 - _OUTLIERS])
    return np.asarray(points[(points[:, 2] >= low) & (points[:, 2] <= high)])


def overlap_of(
    solution: Solution, sfm: SparseModel, scene: FloatArray, *, coarsest_m: float = np.inf
) -> Overlap | None:
    """Return the overlap of the photographs over the scene's points (N, 3); None: they span no area.

    A cell is a point on the surface through these points. What stands before it is not asked for. A photograph
    whose pixels are wider there than `coarsest_m` does not count.
    """
    if not len(scene):
        return None
    low, high = np.quantile(scene[:, :2], [_RIM, 1 - _RIM], axis=0)
    cell = float((high - low).max()) / _CELLS
    if cell <= 0:
        return None
    columns, rows = np.maximum(np.ceil((high - low) / cell).astype(int), 1).tolist()
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    place = low + (grid + 0.5) * cell
    distance, _ = cKDTree(scene[:, :2]).query(place)
    known = np.flatnonzero(distance <= _FARTHEST_CELLS * cell)
    points = np.column_stack([place[known], PointSurface(scene).heights(place[known])])
    count = np.full(rows * columns, -1, dtype=np.int64)
    count[known] = photographs_that_see(solution, sfm, points, coarsest_m)
    return Overlap(count.reshape(rows, columns), low, cell)


def _seen_ground(solution: Solution, sfm: SparseModel, scene: FloatArray) -> Polygon:
    """Return the largest part of the ground that enough photographs see, without holes, smoothly bounded."""
    depth_m, focal_px = depths_of_observations(solution, sfm)
    overlap = overlap_of(solution, sfm, scene, coarsest_m=_COARSEST * float(np.median(depth_m / focal_px)))
    parts: list[Polygon] = []
    if overlap is not None:
        seen = np.pad(overlap.count >= LEAST_PHOTOGRAPHS, 1).astype(np.float64)
        middle = overlap.cell_m * (np.arange(max(seen.shape)) - 0.5)
        x, y = overlap.corner[0] + middle[: seen.shape[1]], overlap.corner[1] + middle[: seen.shape[0]]
        rings = [Polygon(ring) for ring in contourpy.contour_generator(x, y, seen).lines(0.5)]
        reach = _SMOOTHED_CELLS * overlap.cell_m
        opened = shapely.union_all(shapely.make_valid(rings)).buffer(-reach).buffer(2 * reach).buffer(-reach)
        parts = [part for part in shapely.get_parts(opened) if part.area > 0]
    if overlap is None or not parts:
        message = f"No ground is seen by {LEAST_PHOTOGRAPHS} photographs."
        remedy = "Give the area of interest with --boundary, or add photographs."
        raise DegenerateGeometryError("no-common-ground", message, remedy=remedy)
    largest = Polygon(max(parts, key=lambda part: float(part.area)).exterior)
    return max(shapely.get_parts(largest.simplify(overlap.cell_m / 2)), key=lambda part: float(part.area))


def depths_of_observations(solution: Solution, sfm: SparseModel) -> tuple[FloatArray, FloatArray]:
    """Return the depth (K,) of each observation in metres on the ground, and its camera's focal length (K,)."""
    poses = solution.poses
    arm = solution.point_in_model(sfm)[sfm.obs_point] - poses.cam_center_in_model[sfm.obs_image]
    depth = np.einsum("kj,kj->k", poses.cam_from_model[sfm.obs_image][:, 2], arm)
    return solution.similarity.scale * depth, solution.with_lenses(sfm).focal_px[sfm.obs_image]


def ground_sampling_m(solution: Solution, sfm: SparseModel) -> float | None:
    """Return the ground sampling distance, the median of a pixel's size at the SfM points; None: no points."""
    depth_m, focal_px = depths_of_observations(solution, sfm)
    return float(np.median(depth_m / focal_px)) if len(depth_m) else None


def photographs_that_see(
    solution: Solution, sfm: SparseModel, point_in_geo: FloatArray, coarsest_m: float = np.inf
) -> IntArray:
    """Return the number (K,) of registered photographs whose frame holds points (K, 3); nothing hides a point.

    Photographs whose pixels are wider there than `coarsest_m` do not count.
    """
    sparse, poses, geo_from_model = solution.with_lenses(sfm), solution.poses, solution.similarity
    in_model = geo_from_model.inverse().apply(point_in_geo)
    # Tangent of the widest angle from the axis that a camera's frame shows.
    widest = {
        key: float(np.linalg.norm(border_rays(camera)[:, :2], axis=1).max(initial=0.0)) * (1 + 1e-9)
        for key, camera in sparse.cameras.items()
    }
    count = np.zeros(len(point_in_geo), dtype=np.int64)
    for index, (rotation, center) in enumerate(zip(poses.cam_from_model, poses.cam_center_in_model, strict=True)):
        camera = sparse.camera_of(index)
        in_cam = (in_model - center) @ rotation.T
        farthest = coarsest_m * camera.mean_focal_px / geo_from_model.scale
        # Beyond the widest ray of the frame, the polynomial of a lens can fold back into it.
        ahead = np.flatnonzero((in_cam[:, 2] > 0) & (in_cam[:, 2] <= farthest))
        slope = np.linalg.norm(in_cam[ahead, :2], axis=1) / in_cam[ahead, 2]
        ahead = ahead[slope <= widest[int(sparse.image_camera_id[index])]]
        pixel = project(camera, in_cam[ahead])
        seen = ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(axis=1)
        count[ahead[seen]] += 1
    return count
