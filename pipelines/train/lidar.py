"""LiDAR of a training, from its files to the surface of the depth losses.

1. Cloud of the scene, in `model`.
2. Registration against the depth maps: a shift beyond 3 σ is refused, or taken out on request. It is never taken
   out unasked. Its planes are then observations of the adjustment.
3. Confidence, places that have changed, and space that beams have crossed and in which nothing stands.

Whole squares of the plan are held out of the training, since a point's neighbours would tell it its place. The
surface that a depth map shows is compared with a held-out point's plane, along its normal: half a pixel beside the
point counts for nothing.
"""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from pipelines.adjust.terms import Planes
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, FloatArray, rows_of
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.similarity import Similarity, SimilarityRecord, covariance_at
from pipelines.geometry.statistics import mad_sigma
from pipelines.report.plots.maps import DrawnArea, write_lidar_map
from pipelines.splat.losses import FreeSpace
from pipelines.surface.crossings import count_beams, seen_surfels
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.lidar_cloud import LidarCloud, ScannerTrack, joined_clouds, read_cloud
from pipelines.surface.measured_cloud import MeasuredFiles
from pipelines.surface.photo_depths import PhotoDepths
from pipelines.surface.registration import Registration, registration
from pipelines.surface.visibility import DepthViews, Viewpoints
from pipelines.survey.lidar_report import HeldOutPoints, LidarArea, LidarRegistration, LidarReport
from pipelines.survey.scene import SparseScene
from pipelines.survey.survey import Survey
from pipelines.train.lidar_surface import CloudVerdict, FusedSurface, surfels_of, verdict
from pipelines.train.options import LidarOptions
from pipelines.train.surface import SceneSurface


def held_out_points(
    held: LidarCloud, changed: BoolArray, used: LidarCloud, maps: DepthMaps, share: float
) -> HeldOutPoints:
    """Return the held-out points that a training view shows, with the error of its depth map of stereo at each.

    Left out are those that have changed (P,). What `used` and `held` points hide from a view, it does not show. A
    point belongs to the view that is nearest along its axis, whether or not stereo found a depth there.
    """
    standing = rows_of(held, ~changed)
    both, poses = joined_clouds(standing, used), maps.scene.poses
    surfels, count = surfels_of(both), len(standing)
    nearest_m = np.full(count, np.inf)
    view, before_m, normal = np.full(count, -1, np.int64), np.full(count, np.nan), standing.normal_in_model.copy()
    for index in map(int, maps.scene.train):
        rotation, center, camera = poses.cam_from_model[index], poses.cam_center_in_model[index], maps.camera(index)
        seen = seen_surfels(surfels, rotation, center, camera)
        seen = rows_of(seen, seen.rows < count)
        seen = rows_of(seen, seen.depth_m < nearest_m[seen.rows])
        rows, depth_m = seen.rows, np.asarray(maps.depth(index))[seen.row, seen.column].astype(np.float64)
        nearest_m[rows], view[rows] = seen.depth_m, index
        towards = _towards(standing.position_in_model[rows], standing.normal_in_model[rows], center)
        ray = camera.rays(np.stack([seen.column, seen.row], axis=1) + 0.5) @ rotation
        surface_in_model = center + depth_m[:, None] * ray
        off_m = np.einsum("pi,pi->p", surface_in_model - standing.position_in_model[rows], towards)
        normal[rows], before_m[rows] = towards, np.where(depth_m > 0, off_m, np.nan)
    shown_rows = view >= 0
    return HeldOutPoints(
        point_in_model=standing.position_in_model[shown_rows],
        normal_in_model=normal[shown_rows],
        view=view[shown_rows],
        before_m=before_m[shown_rows],
        share=np.array(share),
        changed=np.array(changed.sum()),
        unseen=np.array((~shown_rows).sum()),
    )


def _towards(point: FloatArray, normal: FloatArray, eye: FloatArray) -> FloatArray:
    """Return normals (P, 3) turned to the side of an eye (3,)."""
    side = np.einsum("pi,pi->p", eye - point, normal)
    return np.where(side[:, None] < 0, -normal, normal)


log = logging.getLogger(__name__)

_GATE_SIGMAS = 3.0
_ANOTHER_DATUM_M = 1.0
_HEIGHT_CELL_M = 4.0
_STRIDE = 3  # of rows and columns of the depth maps, for the surface that they show
_MOST_LISTED = 50
_DATUM = (
    "vertical datums or units of height differ. State the LiDAR's datum with --lidar-vertical or --lidar-crs, and "
    "the survey's with `georef ingest --vertical`."
)
_PLACE = "the cloud is of another place or time, or its CRS is wrong (--lidar-crs)."
_UNIT = "the unit (--depth-unit), the direction (--depth-along) and the camera (--depth-camera) of the depth maps."
# Of the planes that the adjustment takes.
_CLUSTER_M = 5.0
_LEAST_POINTS = 5
_LEAST_SIGMA_M = 1e-3
# Of the free space.
_LEAST_CELL_M, _CELL_SPACINGS = 1.0, 3.0  # least sides of a cell
_MOST_CELLS = 40_000_000
_GROWTH = 1.3
_LEAST_BEAMS = 3


@dataclass(frozen=True)
class ComparedLidar:
    """Cloud of the scene, in `model`, compared with the photographs and not moved."""

    cloud: LidarCloud
    held: LidarCloud | None  # points that the training is not given; None: none
    maps: DepthMaps  # depth maps of the training views
    views: DepthViews  # the same as one set
    surface_in_model: FloatArray  # (S, 3) surface that they show
    pixel_m: float  # size of their pixels on the surface
    registration: Registration  # shift of the cloud, and its record
    record: LidarRegistration


@dataclass(frozen=True)
class LidarSurface:
    """Surface of stereo and LiDAR, the registered cloud in `model`, and the photographs' verdict on it."""

    surface: FusedSurface
    report: LidarReport
    verdict: CloudVerdict
    cloud: LidarCloud
    held_out: HeldOutPoints | None = None


def compared_lidar(
    options: LidarOptions,
    files: MeasuredFiles,
    maps: DepthMaps,
    survey: Survey,
    *,
    track: ScannerTrack | None,
    georeference: SimilarityRecord,
    seed: int,
    progress: Progress,
) -> ComparedLidar:
    """Return the scene's cloud, compared with the photographs; an InputError: it lies elsewhere, or off by 3 σ.

    The georeference is the initial similarity to `geo`, with covariance. Track None: it is unknown.
    """
    if isinstance(files, PhotoDepths):
        files.check(maps)
    pixel_m, views, surface = _pixel_size_m(maps), _depth_views(maps), SceneSurface(maps)
    cloud, held = read_cloud(
        files, maps.scene, survey, pixel_m, progress=progress, track=track, held_out=options.lidar_held_out
    )
    surface_in_model = np.concatenate([surface.points(index, _STRIDE) for index in map(int, maps.scene.train)])
    registered = registration_of(cloud, surface_in_model, views, seed, depths=isinstance(files, PhotoDepths))
    record = _checked(registered, cloud, maps.scene, georeference, options)
    return ComparedLidar(cloud, held, maps, views, surface_in_model, pixel_m, registered, record)


def lidar_surface(
    compared: ComparedLidar, files: MeasuredFiles, survey: Survey, options: LidarOptions, shift_m: FloatArray | None
) -> LidarSurface:
    """Return the surface of stereo and LiDAR, without a shift (3,) of the LiDAR, axes of geo; None: none."""
    shift = np.zeros(3) if shift_m is None else shift_m

    def judgement(points: LidarCloud) -> CloudVerdict:
        return verdict(
            points, compared.views, compared.surface_in_model, sigma_m=options.lidar_sigma, pixel_m=compared.pixel_m
        )

    cloud = compared.cloud.moved(-shift)
    judged, kept_free, held_out = judgement(cloud), compared.surface_in_model, None
    if compared.held is not None:
        held = compared.held.moved(-shift)
        gone = judgement(held).rejected
        held_out = held_out_points(
            held, gone, rows_of(cloud, ~judged.rejected), compared.maps, options.lidar_held_out
        )
        kept_free = np.concatenate([compared.surface_in_model, held.position_in_model])
    report = LidarReport(
        **asdict(files.tally),
        crs=files.crs_names,
        points=len(cloud),
        held_out=0 if compared.held is None else len(compared.held),
        voxel_m=cloud.voxel_m,
        registration=compared.record,
        rejected_share=float(judged.rejected.mean()),
        confidence=float(np.median(judged.confidence)),
        areas=_listed_areas(judged, compared.maps.scene, survey),
        assumptions=files.assumptions,
    )
    free = free_space(cloud, judged.rejected, kept_free)
    surface = FusedSurface(compared.maps, cloud, judged, compared.pixel_m, loss=options.lidar_loss, free=free)
    return LidarSurface(surface, report, judged, cloud, held_out)


def draw_changes(path: Path, lidar: LidarSurface, scene: SparseScene) -> None:
    """Write the map of the places that have changed as PNG."""
    shift = scene.geo_from_model.translation  # a pure shift at the start of the training
    areas = [
        DrawnArea(area.kind, area.area_m2, area.cells + shift[:2], area.cell_m) for area in lidar.verdict.areas
    ]
    write_lidar_map(path, lidar.cloud.position_in_model + shift, areas)


def _pixel_size_m(maps: DepthMaps) -> float:
    """Return the size of a pixel of the depth maps on the surface, the median over all training views."""
    sizes = []
    for index in map(int, maps.scene.train):
        depth = maps.depth(index)[::8, ::8]
        if (depth > 0).any():
            sizes.append(float(np.median(depth[depth > 0])) / maps.camera(index).fx)
    return float(np.median(sizes)) if sizes else 0.1


def _depth_views(maps: DepthMaps) -> DepthViews:
    """Return the depth maps of all training views as one set, in `model`."""
    train, poses = [int(index) for index in maps.scene.train], maps.scene.poses
    rotations, centers = poses.cam_from_model[train], poses.cam_center_in_model[train]
    cameras = Viewpoints(rotations, centers, tuple(map(maps.camera, train)))
    return DepthViews.of(cameras, np.concatenate([np.asarray(maps.depth(index)).ravel() for index in train]))


def registration_of(
    cloud: LidarCloud, surface_in_model: FloatArray, views: DepthViews, seed: int, *, depths: bool = False
) -> Registration:
    """Return the shift of a cloud against the depth maps of stereo; `depths`: it is of measured depth maps.

    Raises:
        InputError: the cloud lies above or below the surface of the photographs by more than the search reaches,
            or the two have no surface in common.
    """
    height_m, cells = _height_difference(cloud.position_in_model, surface_in_model)
    if cells and abs(height_m) > _ANOTHER_DATUM_M:
        raise InputError(
            "lidar-height-offset",
            f"The LiDAR lies {abs(height_m):.2f} m {'above' if height_m > 0 else 'below'} the surface of the "
            f"photographs (median of {cells} places): {'check ' + _UNIT if depths else _DATUM}",
            field="--lidar",
        )
    try:
        return registration(cloud, views, seed)
    except DegenerateGeometryError as error:
        raise InputError(
            error.code,
            f"{error}: {'check ' + _UNIT if depths else _PLACE}",
            field="--lidar",
        ) from error


def plane_observations(registered: Registration, geo_from_model: Similarity) -> Planes:
    """Return one plane for each cluster of 5 m and each direction that planes face there.

    The errors of neighbouring points are not independent: the median of a cluster is one observation. Its σ is the
    robust spread of these medians about the shift of the registration, which is part of the observations again. The
    initial similarity is a pure shift.
    """
    matches = registered.matches
    distance = matches.distance_m - registered.wall_bias_m * matches.wall
    facing = np.abs(matches.normal_in_model).argmax(axis=1)
    side = np.sign(np.take_along_axis(matches.normal_in_model, facing[:, None], axis=1))[:, 0]
    cell = np.floor(matches.point_in_model / _CLUSTER_M).astype(np.int64)
    key = np.column_stack([cell, facing, side.astype(np.int64)])
    _, cluster, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort((distance, cluster.ravel()))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    middle = order[first + count // 2][count >= _LEAST_POINTS]
    normal, off = matches.normal_in_model[middle], distance[middle]
    measured = matches.point_in_model[middle]
    sigma_m = max(mad_sigma(off), _LEAST_SIGMA_M)
    return Planes(
        point_in_model=measured + off[:, None] * normal,
        position_in_geo=geo_from_model.apply(measured + registered.shift_m),
        normal_in_geo=normal,
        cov=np.full((len(middle), 1, 1), sigma_m**2),
    )


def free_space(cloud: LidarCloud, gone: BoolArray, surface_in_model: FloatArray) -> FreeSpace | None:
    """Return the cells that beams have crossed and in which nothing is seen; None: no beam is known.

    Beams of points (P,) that are `gone` do not count. Where the photographs show a surface (S, 3), nothing is free;
    nor is anything where points are held out.
    """
    if cloud.scanner_in_model is None:
        return None
    beams = np.flatnonzero(np.isfinite(cloud.scanner_in_model[:, 0]) & ~gone)
    if not len(beams):
        return None
    end = cloud.position_in_model
    low, high = end[beams].min(axis=0), end[beams].max(axis=0)
    cell_m = max(_LEAST_CELL_M, _CELL_SPACINGS * cloud.voxel_m)
    while np.prod(np.ceil((high - low) / cell_m) + 1) > _MOST_CELLS:
        cell_m *= _GROWTH
    shape = (np.ceil((high - low) / cell_m) + 1).astype(np.int64)
    count = count_beams(end[beams], cloud.scanner_in_model[beams], low, cell_m, shape)
    taken = np.zeros(shape, dtype=bool)
    for points in (end, surface_in_model):
        cell = np.floor((points - low) / cell_m).astype(np.int64)
        cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
        taken[tuple(cell.T)] = True
    taken = ndimage.binary_dilation(taken, np.ones((3, 3, 3)))
    return FreeSpace(low, cell_m, (count >= _LEAST_BEAMS) & ~taken)


def _checked(
    compared: Registration,
    cloud: LidarCloud,
    scene: SparseScene,
    georeference: SimilarityRecord,
    options: LidarOptions,
) -> LidarRegistration:
    """Return the record of a registration; a shift beyond 3 σ is an error, unless it is to be taken out."""
    middle = scene.geo_from_model.apply(np.median(cloud.position_in_model, axis=0))[None]
    of_georeference = covariance_at(middle, georeference.covariance, georeference.pivot)[0]
    variance = np.diag(compared.covariance_m2 + of_georeference) + options.lidar_sigma**2
    sigma = np.sqrt(variance)
    record = LidarRegistration(
        shift_m=compared.shift_m.tolist(),
        sigma_m=sigma.tolist(),
        sigma_comparison_m=np.sqrt(np.diag(compared.covariance_m2)).tolist(),
        points=len(compared.matches.distance_m),
        spread_m=compared.spread_m,
        wall_bias_m=compared.wall_bias_m,
        removed=options.lidar_register,
    )
    text = ", ".join(f"{value:+.3f} ± {one:.3f}" for value, one in zip(compared.shift_m, sigma, strict=True))
    log.info("lidar: shift east, north, up %s m against the photographs, of %d points", text, record.points)
    if (np.abs(compared.shift_m) > _GATE_SIGMAS * sigma).any() and not options.lidar_register:
        remedy = (
            "Check its CRS, its datum and the survey's georeference. --lidar-register removes the shift; "
            "--lidar-sigma states a lower accuracy."
        )
        if options.depth_unit is not None:
            remedy = f"Check {_UNIT} --lidar-sigma states a lower accuracy."
        raise InputError(
            "lidar-shifted",
            f"The LiDAR is shifted by {text} m (east, north, up) from the photographs, more than 3 σ. {remedy}",
            field="--lidar",
        )
    return record


def _height_difference(cloud: FloatArray, surface_in_model: FloatArray) -> tuple[float, int]:
    """Return the median height of the cloud above the photographs' surface, and the number of cells compared."""
    low = np.minimum(cloud.min(axis=0), surface_in_model.min(axis=0))[:2]
    medians = []
    for points in (cloud, surface_in_model):
        cell = np.floor((points[:, :2] - low) / _HEIGHT_CELL_M).astype(np.int64)
        key = cell[:, 0] * 10_000_000 + cell[:, 1]
        order = np.lexsort((points[:, 2], key))
        cells, first, count = np.unique(key[order], return_index=True, return_counts=True)
        medians.append((cells, points[order, 2][first + count // 2]))
    common, mine, theirs = np.intersect1d(medians[0][0], medians[1][0], return_indices=True)
    if not len(common):
        return 0.0, 0
    return float(np.median(medians[0][1][mine] - medians[1][1][theirs])), len(common)


def _listed_areas(judged: CloudVerdict, scene: SparseScene, survey: Survey) -> tuple[LidarArea, ...]:
    areas = []
    for area in judged.areas[:_MOST_LISTED]:
        center = scene.geo_from_model.apply(area.center_in_model)
        lat, lon, _ = lla_from_enu(center, survey.origin_on_earth)
        areas.append(
            LidarArea(
                kind=area.kind,
                area_m2=area.area_m2,
                points=area.points,
                center_in_geo=center.tolist(),
                lat_deg=float(lat),
                lon_deg=float(lon),
            )
        )
    return tuple(areas)
