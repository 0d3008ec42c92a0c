"""Stage `export-cloud`: the surface of the trained model as a georeferenced point cloud.

Reads the trained model, the survey and the initial similarity. Writes `cloud/cloud.laz` and its sidecar, and on
request `cloud/cloud.ply` with a sidecar of its own. Points of the ground have class 2, all others class 1.

The points come from the depth maps of the training views, fused, and not from the centres of the Gaussians: those
lie above and below the surface. They are written part by part; medians of σ are counted in classes meanwhile.
"""

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from pipelines import __version__
from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import union
from pipelines.core.stages import CLOUD
from pipelines.core.types import FloatArray, IntArray, rows_of
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportCloudOptions
from pipelines.deliver.placement import median_values
from pipelines.deliver.surface import ground_below, predicted_sigma, shared_squares, surface_views, without_sigma
from pipelines.formats.cloud_ply import CloudPlyWriter, CloudPoints
from pipelines.formats.copc import write_copc
from pipelines.formats.georef_sidecar import SceneSigma, median_sigma, write_sidecar
from pipelines.formats.las import LazWriter
from pipelines.surface.fusion import SurfaceCloud, fusion_settings
from pipelines.surface.ground import GroundModel
from pipelines.surface.measured_area import area_of
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.area import corners, scene_points
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.survey.target_crs import TargetCrs, target_crs

GROUND, OTHER = 2, 1  # classes of LAS
SIGMA_COUNTS = "georeference, disagreement of the training views about the surface, intersection of their rays"
_STEP_M = 10.0  # of the differences that tell the axes of a CRS
# Classes of the σ, 1 % wide, from 0.1 mm to 2 km: medians are known to 1 % without keeping all values.
_LEAST_M, _RATIO, _CLASSES = 1e-4, 1.01, 1700


def run(stage: StageRun, options: ExportCloudOptions) -> Summary:
    """Write the cloud with its sidecar, return its figures; a DegenerateGeometryError: the views agree nowhere."""
    model = read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), model.weighted(load_survey(stage.workspace))
    geo_from_model, box = model.similarity, corners(scene_points(model, sfm))
    target = target_crs(options, survey.origin, box, survey.vertical)
    middle, crs_from_geo = _middle_and_axes(target, box)
    wkt1 = target.crs.wkt1  # a CRS that LAZ cannot state is refused before the work begins
    laz = stage.out / Path(CLOUD).name
    paths = (laz, laz.with_suffix(".ply")) if options.ply else (laz,)
    renderer = model_renderer(stage.workspace, model, sfm, survey, progress=stage.progress)
    views = surface_views(stage, renderer)
    settings = fusion_settings(views, geo_from_model, options.min_views, options.spacing)
    area = area_of(options, stage.workspace, model, sfm, survey, progress=stage.progress)
    terrain, warnings = ground_below(views, geo_from_model, area, options, stage.progress)
    grid, no_sigma = predicted_sigma(stage.workspace, model, sfm)
    squares = shared_squares(views, geo_from_model, settings, stage.progress)
    kept = (rows_of(square, area.contains(square.position)) for square in squares)
    points = (_points_in_crs(square, target, crs_from_geo, grid, terrain) for square in kept)
    tally = _write_points(paths, points, target, wkt1, middle)
    if not tally.count:
        raise DegenerateGeometryError(
            "no-surface-points",
            (
                f"No point of the surface has the same depth in {options.min_views} training views: too few "
                "photographs overlap, or the training was too short."
            ),
            remedy="Add photographs, train longer, or lower --min-views.",
        )
    empty = "The cloud states no σ, and its dimensions sigma_h, sigma_v and cov_ee to cov_uu are empty"
    cautions = union(model.cautions, without_sigma(empty, no_sigma))
    sidecar = target.sidecar(tally.bounds, headline_of(stage.workspace), tally.sigma(), cautions)
    if options.copc:
        copc = laz.with_suffix(".copc.laz")
        write_copc(laz, copc)
        paths = (*paths, copc)
    for path in paths:
        write_sidecar(sidecar, path)
    views.close()
    values = {
        "points": tally.count,
        "ground_points": tally.ground,
        "area_ha": area.hectares,
        "spacing_m": settings.spacing_m,
        "crs": sidecar.crs,
        "vertical_datum": sidecar.vertical_datum.name,
        "bounds": sidecar.bounds,
        **median_values(sidecar.sigma, "point"),
        "assumed": "; ".join(sidecar.assumed),
    }
    figure = f"{tally.count} points, one in {settings.spacing_m:.3f} m, {sidecar.crs}, heights "
    figure += sidecar.vertical_datum.name + median_sigma(sidecar.sigma, "points")
    return Summary(figure, values, warnings, sidecar.cautions)


def _middle_and_axes(target: TargetCrs, scene_in_geo: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middle (3,) of the scene in the CRS, and the rotation (3, 3) of directions CRS ← `geo`.

    Grid north is not true north. Where coordinates are angles, which have no directions of their own, the rotation
    is the identity: normals are East-North-Up then. The scene is given by places (M, 3) that span it.
    """
    middle = scene_in_geo.mean(axis=0)
    at = target.xyz_from_geo(middle + _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]))
    if target.crs.is_geographic:
        return at[0], np.eye(3)
    left, _, right = np.linalg.svd((at[1:4] - at[4:7]).T)
    return at[0], left @ right


def _points_in_crs(
    cloud: SurfaceCloud,
    target: TargetCrs,
    crs_from_geo: FloatArray,
    grid: AccuracyGrid | None,
    terrain: GroundModel | None,
) -> CloudPoints:
    """Return points in the CRS, with the covariance of the georeference and of the surface together.

    Without a grid, the covariance of the georeference is unknown, and so is the sum.
    """
    georeference = np.full((len(cloud.position), 3, 3), np.nan) if grid is None else grid.cov_at(cloud.position)
    # The surface is uncertain along its normal. Along itself, a surface has no place.
    across = cloud.sigma_m[:, None] * cloud.normal
    ground = np.zeros(len(cloud.position), np.uint8)
    if terrain is not None:
        ground = np.where(terrain.is_ground(cloud.position), GROUND, OTHER).astype(np.uint8)
    return CloudPoints(
        target.xyz_from_geo(cloud.position),
        (cloud.normal @ crs_from_geo.T).astype(np.float32),
        cloud.rgb,
        (georeference + across[:, :, None] * across[:, None, :]).astype(np.float32),
        ground,
    )


class Tally:
    """Figures of the points so far: count, bounds, and σ in classes."""

    def __init__(self) -> None:
        self.count = self.ground = 0
        self.bounds = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._horizontal, self._vertical = (np.zeros(_CLASSES, dtype=np.int64) for _ in range(2))
        self._largest = np.zeros(2)

    def add(self, points: CloudPoints) -> None:
        if not len(points):
            return
        self.count += len(points)
        self.ground += int((points.classification == GROUND).sum())
        self.bounds[0] = np.minimum(self.bounds[0], points.position.min(axis=0))
        self.bounds[1] = np.maximum(self.bounds[1], points.position.max(axis=0))
        self._horizontal += _classes(points.sigma_h_m)
        self._vertical += _classes(points.sigma_v_m)
        self._largest = np.fmax(self._largest, [np.fmax.reduce(points.sigma_h_m), np.fmax.reduce(points.sigma_v_m)])

    def sigma(self) -> SceneSigma | None:
        """Return medians and largest of the known σ; None: none is known."""
        if not self._vertical.any():
            return None
        horizontal, vertical = self._largest.tolist()
        return SceneSigma(
            counts=SIGMA_COUNTS,
            median_sigma_h_m=_median(self._horizontal),
            median_sigma_v_m=_median(self._vertical),
            largest_sigma_h_m=horizontal,
            largest_sigma_v_m=vertical,
        )


def _classes(sigma_m: FloatArray | np.ndarray) -> IntArray:
    known = np.maximum(sigma_m[np.isfinite(sigma_m)], _LEAST_M)
    rank = np.round(np.log(known / _LEAST_M) / np.log(_RATIO)).astype(np.int64)
    return np.bincount(np.minimum(rank, _CLASSES - 1), minlength=_CLASSES)


def _median(classes: IntArray) -> float:
    rank = int(np.searchsorted(np.cumsum(classes), (classes.sum() + 1) // 2))
    return float(_LEAST_M * _RATIO**rank)


def _write_points(
    paths: tuple[Path, ...], parts: Iterable[CloudPoints], target: TargetCrs, wkt1: str, near: FloatArray
) -> Tally:
    """Write points part by part as LAZ and, to any further path, as PLY; return their figures."""
    tally, software = Tally(), f"GeoRefGS {__version__}"
    lines = [
        f"CRS: {target.crs.name}",
        f"heights: {target.crs.vertical.name}, {target.crs.height_unit}",
        "sigma_h, sigma_v: predicted standard deviations in metres: " + SIGMA_COUNTS,
        "cov_ee to cov_uu: their covariance in square metres, along east, north, up",
    ]
    with ExitStack() as stack:
        laz = LazWriter(
            paths[0],
            wkt1=wkt1,
            angular=target.crs.is_geographic,
            near=near,
            software=software,
            text="\n".join(lines),
        )
        ply = [CloudPlyWriter(path, [software, *lines]) for path in paths[1:]]
        writers: list[LazWriter | CloudPlyWriter] = [laz, *ply]
        for writer in writers:
            stack.enter_context(writer)
        for points in parts:
            tally.add(points)
            for writer in writers:
                writer.write(points)
    return tally
