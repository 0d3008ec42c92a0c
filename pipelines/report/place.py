"""Place of the survey on Earth, with coordinates as text; and the overlap of its photographs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, triu
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipelines.core.types import FloatArray, IntArray
from pipelines.geodesy.enu import ecef_from_enu, lla_from_ecef
from pipelines.geodesy.operations import Operation
from pipelines.geometry.bundle import Network
from pipelines.geometry.cameras import project
from pipelines.geometry.footprints import border_rays
from pipelines.report.page import Picture, picture_of_png
from pipelines.report.plots.plans import NamedPlaces, match_plan, overlap_plan, site_plan
from pipelines.report.views import EvaluatedSurvey
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs

_SHORT_UNIT = {"metre": "m", "degree": "°"}

Texts = tuple[str, str, str]


def units_of(crs: TargetCrs) -> Texts:
    """Return the short units of the three coordinates."""
    first, second, third = (_SHORT_UNIT.get(unit, unit) for unit in crs.crs.units)
    return first, second, third


def axis_names(crs: TargetCrs) -> Texts:
    """Return the names of the three coordinates, easting or longitude first."""
    first, second = ("longitude", "latitude") if crs.crs.is_geographic else ("easting", "northing")
    return first, second, f"height ({crs.crs.vertical.name})"


def heads_of(crs: TargetCrs) -> Texts:
    first, second, third = (f"{axis} in {unit}" for axis, unit in zip(axis_names(crs), units_of(crs), strict=True))
    return first, second, third


def texts_of(crs: TargetCrs, point_in_geo: FloatArray) -> list[Texts]:
    """Return coordinates of points (N, 3) in `geo` as text; an InputError: one is outside the domain of the CRS."""
    if not len(point_in_geo):
        return []
    units = units_of(crs)
    return [
        (coordinate(x, units[0]), coordinate(y, units[1]), coordinate(z, units[2]))
        for x, y, z in crs.xyz_from_geo(point_in_geo).tolist()
    ]


def coordinate(value: float, unit: str) -> str:
    """Return a coordinate as text: 1e-7° is 1 cm, other units have three decimals."""
    return f"{value:.{7 if unit == '°' else 3}f}".replace("-", "−")


_MOST_DOTS = 12_000


@dataclass(frozen=True)
class AxisExtent:
    """Extent of the survey along one axis of a CRS."""

    name: str
    low: str
    high: str
    unit: str


@dataclass(frozen=True)
class PlaceFacts:
    """Place of a survey; its extent is that of scene and cameras, on the WGS84 ellipsoid and in the CRS.

    The operation is that between WGS84 and the CRS; the ground size is that of the scene along east and north.
    """

    survey: Survey
    crs: TargetCrs
    operation: Operation
    plan: Picture
    geographic: tuple[AxisExtent, ...]
    projected: tuple[AxisExtent, ...]
    ground_size_m: tuple[float, float]


def place_facts(evaluated: EvaluatedSurvey) -> PlaceFacts:
    survey, crs = evaluated.solved.survey, evaluated.crs
    everything = np.concatenate([evaluated.scene_in_geo, evaluated.center_in_geo])
    lla = lla_from_ecef(ecef_from_enu(everything, survey.origin))
    lla[:, 1] -= 360.0 * np.round((lla[:, 1] - lla[0, 1]) / 360.0)
    xyz = crs.xyz_from_geo(everything)
    size = np.ptp(evaluated.scene_in_geo, axis=0).tolist() if len(evaluated.scene_in_geo) else [0.0, 0.0, 0.0]
    return PlaceFacts(
        survey=survey,
        crs=crs,
        operation=crs.crs.operation(crs.lla),
        plan=_plan(evaluated),
        geographic=_axes(("longitude", "latitude", "ellipsoidal height"), ("°", "°", "m"), lla[:, [1, 0, 2]]),
        projected=_axes(axis_names(crs), units_of(crs), xyz),
        ground_size_m=(size[0], size[1]),
    )


def _plan(evaluated: EvaluatedSurvey) -> Picture:
    solved, center = evaluated.solved, evaluated.center_in_geo[:, :2]
    scene = evaluated.scene_in_geo
    step = max(1, len(scene) // _MOST_DOTS)
    png = site_plan(
        center[solved.indices("train")],
        center[solved.indices("test")],
        named_places(solved.survey.control_points),
        named_places(solved.survey.check_points),
        scene[::step, :2],
    )
    return picture_of_png(png)


def named_places(points: tuple[SurveyedPoint, ...]) -> NamedPlaces:
    place = np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
    return NamedPlaces(place, [point.name for point in points])


def _axes(names: tuple[str, ...], units: tuple[str, ...], values: FloatArray) -> tuple[AxisExtent, ...]:
    low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
    return tuple(
        AxisExtent(name, coordinate(first, unit), coordinate(last, unit), unit)
        for name, unit, first, last in zip(names, units, low, high, strict=True)
    )


ENOUGH_PHOTOGRAPHS = 5
TIED_POINTS = 15  # that two photographs share, as SfM demands of a pair
_CELLS = 120  # along the longer side
_RIM = 0.01  # fraction of the scene's points outside the raster on each side
_FARTHEST_CELLS = 6.0  # distance from a point of the scene beyond which there is no scene
_MOST_LINKS = 4000  # that are drawn


@dataclass(frozen=True)
class OverlapFacts:
    """Overlap of a survey; the map and its figures are None without a scene."""

    overlap: Picture | None
    cell_m: float | None
    median: float | None  # photographs that see half of the cells or more
    enough_share: float | None  # of the cells, that at least `enough` photographs see
    enough: int
    matches: Picture  # photographs that share points, with the strongest `drawn_links` of `links`
    links: int
    drawn_links: int
    tied_points: int  # that a pair must share to count as tied
    median_tied: float  # photographs that one is tied to; `least_tied` has fewest
    least_tied: str
    least_tied_count: int
    parts: int  # groups of photographs without a common point; 1: all are connected


def overlap_facts(evaluated: EvaluatedSurvey) -> OverlapFacts:
    center = evaluated.center_in_geo[:, :2]
    raster = _overlap_of(evaluated)
    inside = np.zeros(0) if raster is None else raster[0][raster[0] >= 0]
    pairs, shared = links_of(evaluated.network)
    strongest = np.argsort(-shared, kind="stable")[:_MOST_LINKS]
    tied, parts = ties_of(len(center), pairs, shared)
    least = int(tied.argmin())
    return OverlapFacts(
        overlap=None if raster is None else picture_of_png(overlap_plan(*raster, center)),
        cell_m=None if raster is None else raster[2],
        median=float(np.median(inside)) if len(inside) else None,
        enough_share=float((inside >= ENOUGH_PHOTOGRAPHS).mean()) if len(inside) else None,
        enough=ENOUGH_PHOTOGRAPHS,
        matches=picture_of_png(match_plan(center, pairs[strongest], shared[strongest])),
        links=len(pairs),
        drawn_links=len(strongest),
        tied_points=TIED_POINTS,
        median_tied=float(np.median(tied)),
        least_tied=evaluated.solved.sparse.image_name[least],
        least_tied_count=int(tied[least]),
        parts=parts,
    )


def _overlap_of(evaluated: EvaluatedSurvey) -> tuple[IntArray, FloatArray, float] | None:
    """Return how many photographs see each cell (R, C) of the scene, the south-western corner, and a cell's side.

    Rows run from the south, columns from the west; −1 is no scene, None a survey without one. A cell is a point on
    the surface through the SfM points. What stands before it is not asked for.
    """
    scene, surface = evaluated.scene_in_geo, evaluated.surface
    if surface is None:
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
    points = np.column_stack([place[known], surface.heights(place[known])])
    count = np.full(rows * columns, -1, dtype=np.int64)
    count[known] = photographs_that_see(evaluated, points)
    return count.reshape(rows, columns), low, cell


def photographs_that_see(evaluated: EvaluatedSurvey, point_in_geo: FloatArray) -> IntArray:
    """Return the number (K,) of registered photographs whose frame holds points (K, 3); nothing hides a point."""
    solved = evaluated.solved
    in_model = solved.geo_from_model.inverse().apply(point_in_geo)
    # Tangent of the widest angle from the axis that a camera's frame shows.
    widest = {
        key: float(np.linalg.norm(border_rays(camera)[:, :2], axis=1).max(initial=0.0)) * (1 + 1e-9)
        for key, camera in solved.sparse.cameras.items()
    }
    count = np.zeros(len(point_in_geo), dtype=np.int64)
    for index, (rotation, center) in enumerate(
        zip(solved.poses.cam_from_model, solved.poses.cam_center_in_model, strict=True)
    ):
        camera = solved.sparse.camera_of(index)
        in_cam = (in_model - center) @ rotation.T
        # Beyond the widest ray of the frame, the polynomial of a lens can fold back into it.
        ahead = np.flatnonzero(in_cam[:, 2] > 0)
        slope = np.linalg.norm(in_cam[ahead, :2], axis=1) / in_cam[ahead, 2]
        ahead = ahead[slope <= widest[int(solved.sparse.image_camera_id[index])]]
        pixel = project(camera, in_cam[ahead])
        seen = ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(axis=1)
        count[ahead[seen]] += 1
    return count


def links_of(network: Network) -> tuple[IntArray, IntArray]:
    """Return the pairs (P, 2) of photographs that share points, and the number (P,) of points that they share."""
    images, points = len(network.camera_id), len(network.point_in_world)
    seen = csr_matrix(
        (np.ones(len(network.obs_image), dtype=np.int64), (network.obs_image, network.obs_point)), (images, points)
    )
    seen.data[:] = 1  # a point that is observed twice in one photograph counts once
    shared = triu(seen @ seen.T, k=1).tocoo()
    return np.column_stack([shared.row, shared.col]).astype(np.int64), shared.data.astype(np.int64)


def ties_of(images: int, pairs: IntArray, shared: IntArray) -> tuple[IntArray, int]:
    """Return the number (n,) of photographs that each is tied to, and the number of groups without a tie."""
    strong = pairs[shared >= TIED_POINTS]
    tied = np.bincount(strong.ravel(), minlength=images).astype(np.int64)
    graph = csr_matrix((np.ones(len(strong)), (strong[:, 0], strong[:, 1])), (images, images))
    return tied, int(connected_components(graph, directed=False)[0])
