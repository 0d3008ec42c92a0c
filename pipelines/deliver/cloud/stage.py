"""Stage `export-cloud`: the surface of the trained model as a georeferenced point cloud.

Reads the trained model, the survey and the initial similarity. Writes `cloud/cloud.laz` and its sidecar, and on
request `cloud/cloud.ply` with a sidecar of its own.

The points come from the depth maps of the training views, fused, and not from the centres of the Gaussians: those
lie above and below the surface.
"""

from __future__ import annotations

from pipelines.core.cautions import Caution, union
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.cloud.files import SIGMA_COUNTS, CloudFiles
from pipelines.deliver.cloud.frame import cloud_frame
from pipelines.deliver.cloud.tally import Tally
from pipelines.deliver.options import ExportCloudOptions
from pipelines.deliver.predicted_sigma import predicted_sigma
from pipelines.formats.georef_sidecar import CrsSidecar, median_sigma, write_sidecar
from pipelines.scene.headline import headline_of
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.scene import photographs
from pipelines.scene.scene_extent import corners, scene_points
from pipelines.scene.surface_cloud.fusion import fused_squares, fusion_settings
from pipelines.scene.surface_views import SurfaceViews
from pipelines.scene.target_crs import target_crs
from pipelines.scene.trained_survey import load_trained
from pipelines.splat.rasterizer.backends import rasterizer


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
    files = CloudFiles(frame, stage.out, ply=options.ply)
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
