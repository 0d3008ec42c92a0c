"""The surface of a trained model as rasters, point cloud and discs take it: its views, and σ over the scene."""

from dataclasses import replace

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.extras import extra_part
from pipelines.core.products import Remark, is_checked
from pipelines.core.progress import Progress
from pipelines.core.types import joined_rows, rows_of
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver.options import TerrainOptions
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.fusion import fused_squares, fusion_settings
from pipelines.surface.ground import GroundModel, terrain_of
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.area import Area
from pipelines.survey.scene import photographs
from pipelines.survey.trained_survey import SolvedSurvey, TrainedSurvey

_GROUND_VIEWS = 3  # that agree on a point of the ground
_GROUND_SPACINGS = 2.0  # pixels on the surface between the points that the ground is told from
_AROUND_M = 30.0  # around the area: a house on its rim is told from a hill by what lies outside


def surface_views(stage: StageRun, trained: TrainedSurvey, *, colours: bool = False) -> SurfaceViews:
    """Return depth maps of the training views, in the stage's folder until closed; errors as of `SurfaceViews`."""
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(
        trained, images, rasterizer("auto", stage.progress, mip_filter=trained.model.mip_filter)
    )
    folder = stage.out / "depth_maps"
    return SurfaceViews(renderer, folder, colours=colours, confirmed=True, progress=stage.progress)


def ground_below(
    views: SurfaceViews, trained: TrainedSurvey, area: Area, options: TerrainOptions, progress: Progress
) -> tuple[GroundModel | None, tuple[Remark, ...]]:
    """Return the ground in and around the area, of views with colours; None, with a warning, if it is not known."""
    if not options.terrain:
        return None, ()
    missing = extra_part("terrain")
    if missing.found is None:
        return None, (Remark(code="no-terrain", sentence=f"There is no terrain model: {missing.remedy}."),)
    try:
        settings = fusion_settings(views, trained.geo_from_model, _GROUND_VIEWS)
        settings = replace(settings, spacing_m=_GROUND_SPACINGS * settings.spacing_m)
        squares = list(fused_squares(views, trained.geo_from_model, settings, progress))
        if not squares:  # no view shows the surface closely: what is made of it says so
            return None, ()
        cloud = joined_rows(squares)
        west, south, east, north = area.polygon.buffer(_AROUND_M).bounds
        plan = cloud.position[:, :2]
        inside = ((plan >= (west, south)) & (plan <= (east, north))).all(axis=1)
        near = rows_of(cloud, np.flatnonzero(inside))
        return terrain_of(near.position, near.normal, settings.spacing_m), ()
    except DegenerateGeometryError as error:
        return None, (Remark(code="no-terrain", sentence=f"There is no terrain model: {error}"),)


def predicted_sigma(workspace: Workspace, solved: SolvedSurvey) -> tuple[AccuracyGrid | None, str]:
    """Return the predicted σ over the scene; None, with the reason as the end of a sentence, if it is not known.

    Nothing is stated where nothing checks it.

    Raises:
        MissingProductError: the solution was stored without its covariances.
        InputError: a product is damaged.
    """
    if not is_checked(solved.model.cautions):
        return None, "nothing checks the σ of the positions"
    grid = posterior_of(workspace, solved.model, solved.sfm).grid
    return grid, "" if grid is not None else "the scene has too few points"


def without_sigma(files: str, reason: str) -> tuple[Remark, ...]:
    """Return the caution of files without σ, and what of them is empty therefore; none without a reason."""
    return (Remark(code="no-sigma", sentence=f"{files}: {reason}."),) if reason else ()
