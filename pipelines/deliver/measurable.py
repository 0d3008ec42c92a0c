"""The splat for viewers that measure by the centres of Gaussians: discs on its surface.

A trained Gaussian shows the surface by its front side, far from its centre. A viewer that takes the centre for the
surface is wrong by a part of the Gaussian's size. So:

1. The surface of the training views is fused to points, as for the point cloud (`scene.surface_cloud`).
2. A disc lies at each point. Its colour is that of the trained renders.
3. Gaussians with their centre close to a disc are left out, and those that no training view shows, such as the
   ground plane. The others stay: their surface is shown by too few views, or is none.
4. Appearance refinement: colours and opacities are fitted to the trained renders of the training views; no centre
   moves. Where many photographs overlap, each disc is shown often in one pass over them, and fewer passes do.

Reads `ingest/survey.json`, the photographs, `sfm/sparse`, `train/model.json` and `train/gaussians.ply`. Writes
`measurable/splat.measurable.ply` and its sidecar, beside `export/splat.ply` of `export-ply`.
"""

import logging
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull, KDTree
from torch import Tensor

from pipelines.core.errors import DegenerateGeometryError, ResourceError
from pipelines.core.progress import Progress
from pipelines.core.sentences import about
from pipelines.core.stages import MEASURABLE_SPLAT
from pipelines.core.types import joined_rows, rows_of
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import MeasurableOptions
from pipelines.deliver.placement import solved_placement
from pipelines.deliver.ply import write_ply
from pipelines.deliver.splat import placed_splat, splat_values
from pipelines.deliver.surface import surface_views
from pipelines.geometry.cameras import pose_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.jobs.costs import iteration_seconds
from pipelines.splat.appearance import ShownView, refine_appearance, shuffled_passes
from pipelines.splat.densify import view_contributions
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.memory import USABLE, TrainingSize, free_memory_bytes, predicted_peak_bytes
from pipelines.splat.metrics import psnr
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.sh import coefficient_count
from pipelines.splat.surface import surface_discs
from pipelines.surface.fusion import SurfaceCloud, fused_squares, fusion_settings, pixel_on_surface_m
from pipelines.surface.measured_area import crop_of
from pipelines.surface.surface_views import ModelRenderer, SurfaceView, SurfaceViews, model_renderer
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained

log = logging.getLogger(__name__)

_SPACING_PX = 0.7  # default distance between discs
_MIN_VIEWS = 3  # that agree on a point of the surface, as in the point cloud
_LEAST_SHOWN_PX = 0.05  # sum of a Gaussian's weights in the pixels of a view, from which on the view shows it
_SAMPLED_POINTS, _LEAST_POINTS = 5000, 10  # SfM points of the estimate
_KEPT_SHARE = 0.12  # of the trained Gaussians, with no disc close to them, on a simulated flight
_PLY_VALUES = 14  # of a Gaussian, without harmonics
_SHOWINGS, _MOST_PASSES = 150.0, 7.0  # of a disc in the refinement, on average; and passes over the views at most
_OTHER_PASSES = 5  # time of depth maps, their comparison and the choice of Gaussians, in passes of the refinement
_REPLACED_SPACINGS = 1.0  # largest distance of a Gaussian's centre from the disc that replaces it


def run(stage: StageRun, options: MeasurableOptions) -> Summary:
    """Write the PLY and its sidecar, and return their key figures.

    Raises:
        ResourceError: the discs do not fit into the memory.
        DegenerateGeometryError: the views agree on no point, or no Gaussian is opaque enough.
    """
    model = read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), model.weighted(load_survey(stage.workspace))
    geo_from_model, progress = model.similarity, stage.progress
    renderer = model_renderer(stage.workspace, model, sfm, survey, progress=progress)
    log.info("export-ply --measurable: %s", _estimate(renderer, options) or "time and size cannot be estimated")
    views = surface_views(stage, renderer)
    pixel_m = pixel_on_surface_m(views, geo_from_model)
    spacing_m = options.disc_spacing or _SPACING_PX * pixel_m
    settings = fusion_settings(views, geo_from_model, _MIN_VIEWS, spacing_m)
    surface = _collected(fused_squares(views, geo_from_model, settings, progress), views, renderer.gaussians)
    gaussians = renderer.gaussians
    visible = gaussians.select(_in_views(gaussians, views, renderer.backend, progress).nonzero()[:, 0])
    replaced, discs = with_discs(visible, surface, geo_from_model, spacing_m)
    refined = refine_appearance(
        replaced,
        lambda number: _shown_view(views.view(number)),
        _order(views, surface, geo_from_model, options.appearance_passes),
        renderer.backend,
        RasterSettings(model.sh_degree, model.background),
        progress=progress,
    )
    views.close()
    change = _psnr_change_db(renderer, renderer.showing(refined), progress)
    # The place is that of the trained model, whatever the discs have replaced.
    means, accuracy = gaussians.means.numpy(), headline_of(stage.workspace)
    placement = solved_placement(model, survey, means, accuracy)
    splat = placed_splat(refined, placement, options, crop_of(stage.workspace, options))
    splat = replace(splat, mip_filter=model.mip_filter)
    write_ply(splat, stage.out / Path(MEASURABLE_SPLAT).name, options)
    psnr_text = "" if change is None else f", PSNR {change:+.2f} dB"
    return Summary(
        f"{len(splat.gaussians)} Gaussians; {discs} discs {spacing_m:.3f} m apart{psnr_text}",
        {**splat_values(splat), "discs": discs, "spacing_m": spacing_m, "psnr_change_db": change},
        cautions=splat.placement.cautions,
    )


def _estimate(renderer: ModelRenderer, options: MeasurableOptions) -> str | None:
    """Return an estimate of file size and time from SfM points and cameras, before anything is rendered.

    The time is that of the machine of docs/benchmarks.md. None: too few SfM points to know the surface's extent.
    """
    points, gaussians = renderer.model.point_in_model(renderer.sfm), renderer.gaussians
    points = points[:: max(1, len(points) // _SAMPLED_POINTS)]
    cameras, views_of_point, pixels_m = renderer.model.indices("train"), np.zeros(len(points), int), []
    for pose in map(renderer.pose, cameras):
        in_cam = (points - pose.center_in_model) @ pose.cam_from_model.T
        inside = pose.pinhole.contains(pose.pinhole.project(in_cam))
        views_of_point += inside
        if inside.any():
            pixels_m.append(np.median(in_cam[inside, 2]) / pose.pinhole.fx)
    seen = renderer.geo_from_model.apply(points[views_of_point >= _MIN_VIEWS])[:, :2]
    low, high = np.quantile(seen, [0.01, 0.99], axis=0) if len(seen) else (0.0, 0.0)
    ground = seen[((seen >= low) & (seen <= high)).all(axis=1)]
    if len(ground) < _LEAST_POINTS:
        return None
    spacing_m = options.disc_spacing or _SPACING_PX * renderer.geo_from_model.scale * float(np.median(pixels_m))
    discs = round(ConvexHull(ground).volume / spacing_m**2)
    count = discs + round(_KEPT_SHARE * len(gaussians))
    size_bytes = count * 4 * (_PLY_VALUES + 3 * coefficient_count(gaussians.sh_degree))
    pixels = [pinhole.width * pinhole.height for pinhole in map(renderer.images.pinhole, cameras)]
    pass_s = iteration_seconds(float(np.mean(pixels)), count, len(cameras), surface=False)  # over one view
    passes: float | None = options.appearance_passes
    if passes is None:
        passes = passes_showing(float(views_of_point[views_of_point >= _MIN_VIEWS].mean()))
    seconds = (passes + _OTHER_PASSES) * len(cameras) * pass_s
    return (
        f"about {discs} discs {spacing_m:.3f} m apart, {size_bytes / 1e6:.3g} MB and {about(seconds)}; a larger "
        "--disc-spacing makes it smaller"
    )


def with_discs(
    gaussians: Gaussians, surface: SurfaceCloud, geo_from_model: Similarity, spacing_m: float
) -> tuple[Gaussians, int]:
    """Return the Gaussians that are not close to a disc, then the discs, and the number of the discs.

    The Gaussians are in `model`, the points of the surface in `geo`, about `spacing_m` apart.
    """
    center_in_model = geo_from_model.inverse().apply(surface.position)
    spacing_in_model = spacing_m / geo_from_model.scale
    normal_in_model = surface.normal @ geo_from_model.rotation
    discs = surface_discs(center_in_model, normal_in_model, surface.rgb, spacing_in_model, gaussians.sh_degree)
    away, _ = KDTree(center_in_model).query(
        gaussians.means.numpy().astype(np.float64), distance_upper_bound=_REPLACED_SPACINGS * spacing_in_model
    )
    kept = gaussians.select(torch.from_numpy(np.isinf(away)))
    return Gaussians.concatenate([kept, discs]), len(discs)


def passes_showing(views_of_disc: float) -> float:
    """Return the passes over the views, also a part of one, in which a disc is shown `_SHOWINGS` times."""
    return float(np.clip(_SHOWINGS / max(views_of_disc, 1.0), 1.0, _MOST_PASSES))


def _order(
    views: SurfaceViews, surface: SurfaceCloud, geo_from_model: Similarity, passes: float | None
) -> list[int]:
    """Return the numbers of the views in their order in the refinement; no number of passes: `passes_showing`."""
    if passes is None:
        sample = surface.position[:: max(1, len(surface.position) // _SAMPLED_POINTS)]
        passes = passes_showing(float(views.support(geo_from_model.inverse().apply(sample)).views.mean()))
    whole = shuffled_passes(len(views), math.ceil(passes), np.random.default_rng(0))
    return whole[: round(passes * len(views))]


def _in_views(gaussians: Gaussians, views: SurfaceViews, backend: Rasterizer, progress: Progress) -> Tensor:
    """Return the mask (N,) of the Gaussians that at least one view shows."""
    most_px = torch.zeros(len(gaussians))
    with progress.task("Gaussians in view", len(views)) as task:
        for number in range(len(views)):
            view = views.view(number)
            no_error = torch.zeros(view.pinhole.height, view.pinhole.width)
            contributions = view_contributions(gaussians, _pose(view), view.pinhole, no_error, backend)
            most_px = torch.maximum(most_px, contributions.weight_px.cpu())
            task.advance()
    return most_px >= _LEAST_SHOWN_PX


def _collected(squares: Iterable[SurfaceCloud], views: SurfaceViews, gaussians: Gaussians) -> SurfaceCloud:
    """Return the points of all squares that have a normal.

    Raises:
        ResourceError: discs at these points would not fit into the memory.
        DegenerateGeometryError: there is none.
    """
    free_bytes = free_memory_bytes(torch.device("cpu"))
    largest = max(views.pinholes, key=lambda pinhole: pinhole.width * pinhole.height)
    parts, count = [], 0
    for square in squares:
        parts.append(rows_of(square, np.flatnonzero(np.isfinite(square.normal).all(axis=1))))
        count += len(parts[-1].position)
        size = TrainingSize(len(gaussians) + count, largest, gaussians.sh_degree, 0)
        if free_bytes is not None and predicted_peak_bytes(size) > USABLE * free_bytes:
            raise ResourceError(
                "memory-discs",
                (f"{count} discs on the surface need more than {USABLE * free_bytes / 2**30:.1f} GiB of memory."),
                remedy="Choose a larger --disc-spacing.",
            )
    if not count:
        raise DegenerateGeometryError(
            "no-surface-points",
            (
                f"No point of the surface has the same depth in {_MIN_VIEWS} training views: too few photographs "
                "overlap there, or the training was too short."
            ),
            remedy="Add photographs, train longer, or hand over export/splat.ply alone.",
        )
    return joined_rows(parts)


def _shown_view(view: SurfaceView) -> ShownView:
    assert view.rgb is not None
    colour = torch.from_numpy(np.array(view.rgb)).float() / 255
    return ShownView(_pose(view), view.pinhole, colour)


def _pose(view: SurfaceView) -> Tensor:
    return torch.from_numpy(pose_matrix(view.cam_from_model, view.cam_center_in_model)).float()


def _psnr_change_db(before: ModelRenderer, after: ModelRenderer, progress: Progress) -> float | None:
    """Return the mean change of PSNR over the test views, masks applied; None without any."""
    indices, changes = before.model.indices("test"), []
    with progress.task("test views", len(indices)) as task:
        for index in indices:
            photo = torch.from_numpy(np.array(before.images.image(index))).float() / 255
            mask = torch.from_numpy(np.array(before.images.mask(index)))
            was, now = (
                psnr(renderer.render(index).colour.clamp(0, 1).cpu(), photo, mask) for renderer in (before, after)
            )
            changes.append(now - was)
            task.advance()
    return float(np.mean(changes)) if changes else None
