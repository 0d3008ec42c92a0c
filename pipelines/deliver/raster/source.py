"""What the rasters are made from, read from the workspace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.workspace import StageRun
from pipelines.deliver.options import ExportRasterOptions
from pipelines.deliver.predicted_sigma import predicted_sigma
from pipelines.deliver.raster.extent import GroundSampling
from pipelines.deliver.raster.plan import PlanScene
from pipelines.deliver.raster.window import RasterSource
from pipelines.formats.geotiff import RasterFrame
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.scene import photographs
from pipelines.scene.scene_extent import scene_points
from pipelines.scene.surface_views import SurfaceViews
from pipelines.scene.target_crs import TargetCrs
from pipelines.scene.trained_survey import TrainedSurvey
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.backends import rasterizer

_LEAST_OPACITY = 1 / 255
_AROUND = 0.1  # of the scene's extent: Gaussians further outside it, in plan, reach into no cell
_HAZE_VIEWS = 2  # training views that look through a Gaussian, and none that shows a surface there


@dataclass(frozen=True)
class Request:
    """What rasters are wanted of what survey."""

    trained: TrainedSurvey
    target: TargetCrs
    frame: RasterFrame
    sampling: GroundSampling
    options: ExportRasterOptions


def raster_source(stage: StageRun, wanted: Request) -> tuple[RasterSource, str]:
    """Return what the windows are made from, and the reason why σ is not known, or an empty text.

    Args:
        stage: the run; its folder holds the depth maps until the stage ends.
        wanted: the rasters.

    Raises:
        InputError: a photograph cannot be read, or the depth maps do not fit on the disk.
        DegenerateGeometryError: no Gaussian lies within the scene.
    """
    trained, target, frame = wanted.trained, wanted.target, wanted.frame
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(trained, images, rasterizer("auto", stage.progress))
    views = SurfaceViews(renderer, stage.out / "depth_maps", confirmed=True, progress=stage.progress)
    training_px = wanted.sampling.training_m / (frame.step_x * target.horizontal_unit_m)
    gaussians = _within(trained, trained.gaussians)
    scene = PlanScene(
        _without_haze(gaussians, views),
        trained.geo_from_model,
        target,
        frame,
        centers_in_model=trained.poses.cam_center_in_model[trained.indices("train")],
        training_px=training_px,
    )
    sigma, no_sigma = predicted_sigma(stage.workspace, trained)
    source = RasterSource(
        scene=scene,
        views=views,
        geo_from_model=trained.geo_from_model,
        target=target,
        sigma=sigma,
        training_px=training_px,
        height_unit_m=target.height_unit_m,
        training_gsd_m=wanted.sampling.training_m,
        min_views=wanted.options.min_views,
    )
    return source, no_sigma


def _within(trained: TrainedSurvey, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that reach into the scene; far ones may lie outside the domain of the CRS."""
    points = scene_points(trained)
    low, high = points.min(axis=0), points.max(axis=0)
    around = float(np.linalg.norm(high - low)) * np.array([_AROUND, _AROUND, 1.0])  # masts stand above all points
    in_geo = trained.geo_from_model.apply(gaussians.means.numpy())
    inside = ((in_geo >= low - around) & (in_geo <= high + around)).all(axis=1)
    solid = torch.sigmoid(gaussians.logit_opacities) >= _LEAST_OPACITY
    chosen = gaussians.select(solid & torch.from_numpy(inside))
    if len(chosen) == 0:
        raise DegenerateGeometryError("no Gaussian lies within the scene of the SfM points: train again")
    return chosen


def _without_haze(gaussians: Gaussians, views: SurfaceViews) -> Gaussians:
    """Return the Gaussians without those in the air, through which the training views look at the surface."""
    support = views.support(gaussians.means.double().numpy())
    haze = (support.views == 0) & (support.seen_through >= _HAZE_VIEWS)
    return gaussians.select(torch.from_numpy(~haze))
