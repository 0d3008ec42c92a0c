"""Stage `export-raster`: orthophoto, surface model (DSM) and σ rasters in a CRS, contours, hillshade and preview.

Reads the survey, the trained model and the initial similarity. Writes `raster/orthophoto.tif`, `dsm.tif`,
`sigma_h.tif`, `sigma_v.tif` as Cloud Optimized GeoTIFF, each with its sidecar, `hillshade.png` and `preview.png`;
with `--contours` also `contours.gpkg` and `contours.dxf`. The Gaussians are rendered orthographically, window by
window: finished windows survive an interruption.
"""

from __future__ import annotations

import numpy as np

from pipelines.core.cautions import Caution, union
from pipelines.core.durable import remove
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportRasterOptions
from pipelines.deliver.raster.contours import write_contours
from pipelines.deliver.raster.extent import (
    GroundSampling,
    ground_sampling,
    make_frame,
    require_space,
)
from pipelines.deliver.raster.mosaic import Mosaic
from pipelines.deliver.raster.pictures import write_pictures
from pipelines.deliver.raster.source import Request, raster_source
from pipelines.formats.georef_sidecar import SceneSigma, median_sigma, write_sidecar
from pipelines.formats.geotiff import RasterFrame
from pipelines.scene.headline import headline_of
from pipelines.scene.scene_extent import corners, scene_points
from pipelines.scene.target_crs import TargetCrs, target_crs
from pipelines.scene.trained_survey import load_trained

_DETAIL = 1.5  # training pixels over cells, beyond which a raster shows less than its cells promise


def run(stage: StageRun, options: ExportRasterOptions) -> Summary:
    """Write the rasters, their pictures and contours, and return their key figures.

    Raises:
        MissingProductError: a stage has not been run.
        InputError: a product is damaged, the CRS cannot be used, the cells are too many, or the disk is too small.
        DegenerateGeometryError: no cell of the scene was seen.
    """
    trained = load_trained(stage.workspace)
    points, sampling = scene_points(trained), ground_sampling(trained)
    target = target_crs(options, trained.survey.origin, corners(points), trained.survey.vertical)
    frame = make_frame(target.xyz_from_geo(points)[:, :2], target, sampling.photographs_m, options)
    require_space(stage.out, frame)
    source, reason = raster_source(stage, Request(trained, target, frame, sampling, options))
    mosaic = Mosaic(stage.out / "parts", frame, target)
    mosaic.render(source, stage.progress)
    mosaic.drop_islands()
    height = mosaic.sample("dsm")
    if not len(height):
        raise DegenerateGeometryError(
            f"no cell is shown by {options.min_views} training views or more: lower --min-views"
        )
    accuracy, sigma = headline_of(stage.workspace), None if reason else _sigma(mosaic)
    west, south, east, north = frame.bounds
    bounds = [[west, south, height.min()], [east, north, height.max()]]
    cautions = union(trained.model.cautions, _cautions(sampling, source.training_px, reason))
    sidecar = target.sidecar(bounds, accuracy, sigma, cautions)
    for path in mosaic.write(stage.out, sidecar, stage.progress):
        write_sidecar(sidecar, path)
    if options.hillshade:
        write_pictures(stage.out, target.horizontal_unit_m / target.height_unit_m)
    lines = write_contours(stage.out, frame, options.contours) if options.contours else 0
    covered = mosaic.covered()
    source.views.close()
    remove(mosaic.folder)
    return Summary(
        _key_figure(frame, target, sigma),
        {
            "columns": frame.columns,
            "rows": frame.rows,
            "gsd": frame.step_x,
            "gsd_photographs_m": sampling.photographs_m,
            "gsd_training_m": sampling.training_m,
            "crs": target.crs.name,
            "heights": target.crs.vertical.name,
            "units": target.crs.units,
            "bounds": bounds,
            "covered": covered,
            "median_cell_sigma_h_m": None if sigma is None else sigma.median_sigma_h_m,
            "median_cell_sigma_v_m": None if sigma is None else sigma.median_sigma_v_m,
            "contour_lines": lines,
            "assumed": "; ".join(target.assumed),
        },
        cautions=cautions,
    )


def _sigma(mosaic: Mosaic) -> SceneSigma:
    horizontal, vertical = mosaic.sample("sigma_h"), mosaic.sample("sigma_v")
    return SceneSigma(
        counts="georeference, cameras and lens; the surface's own noise between training views",
        median_sigma_h_m=float(np.median(horizontal)),
        median_sigma_v_m=float(np.median(vertical)),
        largest_sigma_h_m=float(horizontal.max()),
        largest_sigma_v_m=float(vertical.max()),
    )


def _cautions(sampling: GroundSampling, training_px: float, reason: str) -> tuple[Caution, ...]:
    cautions = []
    if training_px > _DETAIL:
        cautions.append(
            Caution(
                code="detail-of-training",
                sentence=f"The model was trained at {sampling.training_m:.3f} m a pixel on the ground, and shows "
                "no finer detail, whatever the size of a raster's cells.",
            )
        )
    if reason:
        cautions.append(
            Caution(
                code="no-sigma",
                sentence=f"The rasters state no σ, and sigma_h.tif and sigma_v.tif are empty: {reason}.",
            )
        )
    return tuple(cautions)


def _key_figure(frame: RasterFrame, target: TargetCrs, sigma: SceneSigma | None) -> str:
    cells = f"{frame.columns} × {frame.rows} cells of {frame.step_x:g} {target.crs.units[0]} in {target.crs.name}"
    return cells + median_sigma(sigma, "cells")
