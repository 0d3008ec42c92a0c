"""The surface of a trained model as rasters, point cloud and discs take it: its views, and σ over the scene."""

import hashlib
import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.extras import extra_part
from pipelines.core.files import read_npz, remove
from pipelines.core.products import Remark, is_checked, save_npz
from pipelines.core.progress import Progress
from pipelines.core.types import joined_rows, rows_of
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver.options import TerrainOptions
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.surface.fusion import FusionSettings, SurfaceCloud, fused_squares, fusion_settings
from pipelines.surface.ground import GroundModel, terrain_of
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.area import Area
from pipelines.survey.solution import Solution

log = logging.getLogger(__name__)

_SQUARES_LAYOUT = 1  # of the kept files, and of how they are fused
_GROUND_VIEWS = 3  # that agree on a point of the ground
_GROUND_SPACINGS = 2.0  # pixels on the surface between the points that the ground is told from
_AROUND_M = 30.0  # around the area: a house on its rim is told from a hill by what lies outside


def surface_views(stage: StageRun, renderer: ModelRenderer) -> SurfaceViews:
    """Return depth maps and colours of the training views; errors as of `SurfaceViews`.

    They stay in the workspace's cache for the other deliverables, until those of another model are asked for.
    """
    renderer.images.build(stage.progress)
    rendered = stage.workspace.cache / "rendered"
    folder = rendered / renderer.key()
    for other in rendered.iterdir() if rendered.is_dir() else ():
        if other != folder:
            remove(other)
    return SurfaceViews(renderer, folder, colours=True, confirmed=True, progress=stage.progress)


def shared_squares(
    views: SurfaceViews, geo_from_model: Similarity, settings: FusionSettings, progress: Progress
) -> Iterator[SurfaceCloud]:
    """Yield `fused_squares`, which stay beside the depth maps for the other deliverables that ask for the same."""
    similarity = (geo_from_model.scale, geo_from_model.rotation.tolist(), geo_from_model.translation.tolist())
    key = hashlib.sha256(repr((_SQUARES_LAYOUT, settings, similarity)).encode()).hexdigest()[:32]
    kept = views.folder / f"squares-{key}"
    if kept.is_dir():
        for path in sorted(kept.iterdir()):
            yield SurfaceCloud(**read_npz(path))
        return
    partial = kept.with_suffix(".partial")
    remove(partial)
    partial.mkdir()
    for number, square in enumerate(fused_squares(views, geo_from_model, settings, progress)):
        if partial.is_dir():
            try:
                save_npz(partial / f"{number:06d}.npz", vars(square))
            except OSError as error:  # A full disk costs the others their time, and this one nothing.
                log.debug("the fused surface is not kept: %s", error)
                remove(partial)
        yield square
    if partial.is_dir():
        partial.rename(kept)


def ground_below(
    views: SurfaceViews, geo_from_model: Similarity, area: Area, options: TerrainOptions, progress: Progress
) -> tuple[GroundModel | None, tuple[Remark, ...]]:
    """Return the ground in and around the area, of views with colours; None, with a warning, if it is not known."""
    if not options.terrain:
        return None, ()
    missing = extra_part("terrain")
    if missing.found is None:
        return None, (
            Remark(code="no-terrain", sentence="There is no terrain model.", remedy=f"{missing.remedy}."),
        )
    try:
        settings = fusion_settings(views, geo_from_model, _GROUND_VIEWS)
        settings = replace(settings, spacing_m=_GROUND_SPACINGS * settings.spacing_m)
        squares = list(shared_squares(views, geo_from_model, settings, progress))
        if not squares:  # no view shows the surface closely: what is made of it says so
            return None, ()
        cloud = joined_rows(squares)
        west, south, east, north = area.polygon.buffer(_AROUND_M).bounds
        plan = cloud.position[:, :2]
        inside = ((plan >= (west, south)) & (plan <= (east, north))).all(axis=1)
        near = rows_of(cloud, np.flatnonzero(inside))
        return terrain_of(near.position, near.normal, settings.spacing_m), ()
    except DegenerateGeometryError as error:
        return None, (
            Remark(code="no-terrain", sentence=f"There is no terrain model: {error.fault}", remedy=error.remedy),
        )


def predicted_sigma(workspace: Workspace, solution: Solution, sfm: SparseModel) -> tuple[AccuracyGrid | None, str]:
    """Return the predicted σ over the scene; None, with the reason as the end of a sentence, if it is not known.

    Nothing is stated where nothing checks it.

    Raises:
        MissingProductError: the solution was stored without its covariances.
        InputError: a product is damaged.
    """
    if not is_checked(solution.cautions):
        return None, "nothing checks the σ of the positions"
    grid = posterior_of(workspace, solution, sfm).grid
    return grid, "" if grid is not None else "the scene has too few points"


def without_sigma(files: str, reason: str) -> tuple[Remark, ...]:
    """Return the caution of files without σ, and what of them is empty therefore; none without a reason."""
    return (Remark(code="no-sigma", sentence=f"{files}: {reason}."),) if reason else ()
