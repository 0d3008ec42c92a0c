"""Stage `export-cloud`: the surface of the trained model as a georeferenced point cloud.

Reads the trained model, the survey and the initial similarity. Writes `cloud/cloud.laz` and its sidecar, and on
request `cloud/cloud.ply` with a sidecar of its own.

The points come from the depth maps of the training views, fused, and not from the centres of the Gaussians: those
lie above and below the surface.

Points of the surface in the CRS of the file.

Figures of a cloud that is written in parts: count, bounds, and medians of σ.

Files of a cloud, written part by part.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines import __version__
from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Caution, union
from pipelines.core.stages import CLOUD
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.measurable import predicted_sigma
from pipelines.deliver.options import ExportCloudOptions
from pipelines.formats.cloud_ply import CloudPlyWriter, CloudPoints
from pipelines.formats.georef_sidecar import CrsSidecar, SceneSigma, median_sigma, write_sidecar
from pipelines.formats.las import LazWriter
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.fusion import SurfaceCloud, fused_squares, fusion_settings
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.headline import headline_of
from pipelines.survey.scene import photographs
from pipelines.survey.target_crs import TargetCrs, target_crs
from pipelines.survey.trained_survey import corners, load_trained, scene_points

_STEP_M = 10.0  # of the differences that tell the axes of a CRS


@dataclass(frozen=True)
class CloudFrame:
    """CRS of the cloud.

    Attributes:
        target: the CRS.
        middle: (3,) middle of the scene in the CRS.
        crs_from_geo: (3, 3) rotation of directions: grid north is not true north. Identity where coordinates are
            angles, which have no directions of their own: normals are East-North-Up then.
    """

    target: TargetCrs
    middle: FloatArray
    crs_from_geo: FloatArray

    def points(self, cloud: SurfaceCloud, grid: AccuracyGrid | None) -> CloudPoints:
        """Return points in the CRS, with the covariance of the georeference and of the surface together.

        Args:
            cloud: in `geo`.
            grid: predicted covariance of the georeference; None: unknown, and so is the sum.
        """
        georeference = np.full((len(cloud), 3, 3), np.nan) if grid is None else grid.cov_at(cloud.position)
        # The surface is uncertain along its normal. Along itself, a surface has no place.
        across = cloud.sigma_m[:, None] * cloud.normal
        return CloudPoints(
            self.target.xyz_from_geo(cloud.position),
            (cloud.normal @ self.crs_from_geo.T).astype(np.float32),
            cloud.rgb,
            (georeference + across[:, :, None] * across[:, None, :]).astype(np.float32),
        )


def cloud_frame(target: TargetCrs, scene_in_geo: FloatArray) -> CloudFrame:
    """Return the frame of a cloud in a CRS.

    Args:
        target: the CRS.
        scene_in_geo: (M, 3) places that span the scene.
    """
    middle = scene_in_geo.mean(axis=0)
    at = target.xyz_from_geo(middle + _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]))
    if target.crs.is_geographic:
        return CloudFrame(target, at[0], np.eye(3))
    left, _, right = np.linalg.svd((at[1:4] - at[4:7]).T)
    return CloudFrame(target, at[0], left @ right)


# Classes of the σ, 1 % wide, from 0.1 mm to 2 km: medians are known to 1 % without keeping all values.
_LEAST_M, _RATIO, _CLASSES = 1e-4, 1.01, 1700


class Tally:
    """Figures of the points so far."""

    def __init__(self) -> None:
        self.count = 0
        self.bounds = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._horizontal, self._vertical = (np.zeros(_CLASSES, dtype=np.int64) for _ in range(2))
        self._largest = np.zeros(2)

    def add(self, points: CloudPoints) -> None:
        """Add points."""
        if not len(points):
            return
        self.count += len(points)
        self.bounds[0] = np.minimum(self.bounds[0], points.position.min(axis=0))
        self.bounds[1] = np.maximum(self.bounds[1], points.position.max(axis=0))
        self._horizontal += _classes(points.sigma_h_m)
        self._vertical += _classes(points.sigma_v_m)
        self._largest = np.fmax(self._largest, [np.fmax.reduce(points.sigma_h_m), np.fmax.reduce(points.sigma_v_m)])

    def sigma(self, counts: str) -> SceneSigma | None:
        """Return medians and largest of the known σ; None: none is known.

        Args:
            counts: errors that they hold.
        """
        if not self._vertical.any():
            return None
        horizontal, vertical = self._largest.tolist()
        return SceneSigma(
            counts=counts,
            median_sigma_h_m=_median(self._horizontal),
            median_sigma_v_m=_median(self._vertical),
            largest_sigma_h_m=horizontal,
            largest_sigma_v_m=vertical,
        )


def _classes(sigma_m: FloatArray | np.ndarray) -> IntArray:
    known = np.maximum(sigma_m[np.isfinite(sigma_m)], _LEAST_M)
    place = np.round(np.log(known / _LEAST_M) / np.log(_RATIO)).astype(np.int64)
    return np.bincount(np.minimum(place, _CLASSES - 1), minlength=_CLASSES)


def _median(classes: IntArray) -> float:
    place = int(np.searchsorted(np.cumsum(classes), (classes.sum() + 1) // 2))
    return float(_LEAST_M * _RATIO**place)


SIGMA_COUNTS = "georeference, disagreement of the training views about the surface, intersection of their rays"


class CloudReader:
    """Files of a cloud: LAZ, and PLY on request.

    Args:
        frame: CRS of the points.
        folder: for the files.
        ply: write the PLY too.

    Raises:
        InputError: a LAZ file cannot state this CRS.
    """

    def __init__(self, frame: CloudFrame, folder: Path, *, ply: bool) -> None:
        self.frame = frame
        self._wkt1 = frame.target.crs.wkt1
        laz = folder / CLOUD.rpartition("/")[2]
        self.paths = (laz, laz.with_suffix(".ply")) if ply else (laz,)

    def write(self, parts: Iterable[CloudPoints]) -> Tally:
        """Write points part by part, and return their figures."""
        target, tally = self.frame.target, Tally()
        place = [f"CRS: {target.crs.name}", f"heights: {target.crs.vertical.name}, {target.crs.height_unit}"]
        lines = [*place, "sigma_h, sigma_v: predicted standard deviations in metres: " + SIGMA_COUNTS]
        lines.append("cov_ee to cov_uu: their covariance in square metres, along east, north, up")
        software = f"GeoRefGS {__version__}"
        with ExitStack() as stack:
            writers: list[LazWriter | CloudPlyWriter] = [
                LazWriter(
                    self.paths[0],
                    wkt1=self._wkt1,
                    angular=target.crs.is_geographic,
                    near=self.frame.middle,
                    software=software,
                    text="\n".join(lines),
                )
            ]
            writers += [CloudPlyWriter(path, [software, *lines]) for path in self.paths[1:]]
            for writer in writers:
                stack.enter_context(writer)
            for points in parts:
                tally.add(points)
                for writer in writers:
                    writer.write(points)
        return tally


def run(stage: StageRun, options: ExportCloudOptions) -> Summary:
    """Write the cloud with its sidecar, and return its key figures.

    Raises:
        InputError: the CRS cannot be used, the disk is too small, or a product or photograph cannot be read.
        MissingProductError: a stage has not been run.
        DegenerateGeometryError: the views agree on no point.
    """
    trained = load_trained(stage.workspace)
    geo_from_model, box = trained.geo_from_model, corners(scene_points(trained))
    target = target_crs(options, trained.survey.origin, box, trained.survey.vertical)
    frame = cloud_frame(target, box)
    files = CloudReader(frame, stage.out, ply=options.ply)
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(trained, images, rasterizer("auto", stage.progress))
    scratch = stage.out / "depth_maps"
    views = SurfaceViews(renderer, scratch, colours=True, confirmed=True, progress=stage.progress)
    settings = fusion_settings(views, geo_from_model, options.min_views, options.spacing)
    grid, no_sigma = predicted_sigma(stage.workspace, trained)
    squares = fused_squares(views, geo_from_model, settings, stage.progress)
    tally = files.write(frame.points(square, grid) for square in squares)
    if not tally.count:
        raise DegenerateGeometryError(
            f"no point of the surface is seen alike by {options.min_views} training views: train longer, or lower "
            "--min-views"
        )
    cautions = union(trained.model.cautions, _no_sigma(no_sigma))
    sidecar = target.sidecar(tally.bounds, headline_of(stage.workspace), tally.sigma(SIGMA_COUNTS), cautions)
    for path in files.paths:
        write_sidecar(sidecar, path)
    views.close()
    return _summary(tally, sidecar, settings.spacing_m)


def _no_sigma(reason: str) -> tuple[Caution, ...]:
    if not reason:
        return ()
    sentence = (
        f"The cloud states no σ, and its dimensions sigma_h, sigma_v and cov_ee to cov_uu are empty: {reason}."
    )
    return (Caution(code="no-sigma", sentence=sentence),)


def _summary(tally: Tally, sidecar: CrsSidecar, spacing_m: float) -> Summary:
    sigma = sidecar.sigma
    values = {
        "points": tally.count,
        "spacing_m": spacing_m,
        "crs": sidecar.crs,
        "vertical_datum": sidecar.vertical_datum.name,
        "bounds": sidecar.bounds,
        "median_point_sigma_h_m": None if sigma is None else sigma.median_sigma_h_m,
        "median_point_sigma_v_m": None if sigma is None else sigma.median_sigma_v_m,
        "assumed": "; ".join(sidecar.assumed),
    }
    figure = f"{tally.count} points, one in {spacing_m:.3f} m, {sidecar.crs}, heights {sidecar.vertical_datum.name}"
    return Summary(figure + median_sigma(sigma, "points"), values, cautions=sidecar.cautions)
