"""The surface of a trained model as rasters, point cloud and discs take it: its views, and σ over the scene."""

from __future__ import annotations

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.solution import posterior_of
from pipelines.core.products import Remark, is_checked
from pipelines.core.workspace import StageRun, Workspace
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.scene import photographs
from pipelines.survey.trained_survey import SolvedSurvey, TrainedSurvey


def surface_views(stage: StageRun, trained: TrainedSurvey, *, colours: bool = False) -> SurfaceViews:
    """Return depth maps of the training views, in the stage's folder until closed; errors as of `SurfaceViews`."""
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(trained, images, rasterizer("auto", stage.progress))
    folder = stage.out / "depth_maps"
    return SurfaceViews(renderer, folder, colours=colours, confirmed=True, progress=stage.progress)


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
