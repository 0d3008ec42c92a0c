"""Comparison of the surface of a trained survey with a reference cloud, square by square in bounded memory.

1. The model's cloud is the one that `export-cloud` writes: fused depth maps, and not the centres of Gaussians.
2. The reference is read twice. A first pass keeps one point a voxel of 0.25 m, for what photographs saw and for the
   shift between the clouds. A second pass sorts all points into squares on the disk.
3. In each square, distances are measured both ways and along the reference's normals (`distances`).
4. Recall counts points that three photographs saw, and precision the model's points where the reference covers the
   plan.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.files import remove
from pipelines.core.products import Remark, is_checked
from pipelines.core.progress import Progress
from pipelines.core.stages import REFERENCE_HISTOGRAM, REFERENCE_MAP
from pipelines.core.types import FloatArray
from pipelines.evaluate.options import EvaluateOptions
from pipelines.evaluate.reference_distances import (
    CLASSES,
    THRESHOLDS_M,
    Box,
    ComparisonSettings,
    CorePoints,
    DistanceTally,
    compare_square,
    m3c2_level_of_detection,
)
from pipelines.geodesy.enu import Origin
from pipelines.geometry.footprints import first_of_voxels
from pipelines.geometry.similarity import Similarity
from pipelines.report.plots.charts import write_distance_histogram, write_distance_map
from pipelines.surface.fusion import FusionSettings, fused_squares, fusion_settings
from pipelines.surface.m3c2 import TiledPoints, plane_normals, spacing_of
from pipelines.surface.measured_cloud import CloudReader, MeasuredCloud, Thinning, read_thinned
from pipelines.surface.registration import fit_alignment
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.surface.visibility import Viewpoints, seen_surface
from pipelines.survey.area import scene_points
from pipelines.survey.reference_comparison import ReferenceComparison, ReferenceShift
from pipelines.survey.solution import Solution

_SQUARE_M = 32.0  # two million points of the reference at the most, in voxels of 0.025 m
_OVERVIEW_M, _MOST_OVERVIEW = 0.25, 10_000_000
_MARGIN_M, _MARGIN_UP_M = 10.0, 100.0  # around the SfM points: heights of a wrong datum are off by up to 100 m
_LEAST_VIEWS = 3  # that agree on a point of the model, as in `export-cloud`


@dataclass(frozen=True)
class ComparedReference:
    """Figures of the comparison, and the core points with their levels of detection for map and histogram."""

    comparison: ReferenceComparison
    cores: CorePoints
    lod_m: FloatArray
    assumptions: tuple[Remark, ...]


def compare_with_reference(
    renderer: ModelRenderer,
    origin: Origin,
    files: CloudReader,
    grid: AccuracyGrid | None,
    options: EvaluateOptions,
    *,
    scratch: Path,
    progress: Progress,
) -> ComparedReference:
    """Return the comparison of the surface of a survey from an `origin` with a reference.

    Without `grid`, the σ of the georeference is not known. The folder `scratch` holds depth maps and sorted points,
    and is removed at the end.

    Raises:
        InputError: a damaged file, a missing grid, a reference of another place, or no room on the disk.
        DegenerateGeometryError: the views agree on no point of a surface, or nothing tells how to move the model.
    """
    assert options.reference is not None  # the caller opened its files
    points = scene_points(renderer.model, renderer.sfm)
    margin = np.array([_MARGIN_M, _MARGIN_M, _MARGIN_UP_M])  # a reference may lie above or below the scene
    box = points.min(axis=0) - margin, points.max(axis=0) + margin
    thinning = Thinning(_OVERVIEW_M, _MOST_OVERVIEW, *box)
    overview = read_thinned(files, origin, thinning, progress)
    model, fusion, shift, moved = _model(renderer, overview, options, scratch, progress)
    seen = seen_surface(_viewpoints(renderer, moved), overview.position_in_geo, overview.voxel_m, progress)
    reference = _sorted_reference(files, origin, box, scratch / "reference", progress)
    spacing_m = spacing_of(reference, min(THRESHOLDS_M) / 2)
    settings = ComparisonSettings.of_spacings(spacing_m, fusion.spacing_m, min(THRESHOLDS_M), box)
    tally, squares = DistanceTally(), sorted({*reference.count, *model.count})
    with progress.task("squares of the reference", len(squares)) as task:
        for square in squares:
            tally.add(compare_square(square, reference, model, seen, settings))
            task.advance()
    cores = tally.cores()
    sigma_m = _georeference_sigma(cores.position, cores.normal, renderer.model, grid)
    known = np.zeros(len(cores.position)) if sigma_m is None or moved is not None else sigma_m
    lod_m = m3c2_level_of_detection(cores.noise_m, np.hypot(known, options.reference_sigma))
    comparison = ReferenceComparison(
        name=options.reference.name,
        crs=files.crs_names,
        points=tally.points,
        seen=tally.seen / max(tally.points, 1),
        spacing_m=spacing_m,
        model_points=sum(model.count.values()),
        model_spacing_m=fusion.spacing_m,
        sigma_m=options.reference_sigma,
        georeference_sigma_m=None if sigma_m is None or not len(sigma_m) else float(np.median(sigma_m)),
        shift=shift,
        aligned="none" if moved is None else options.reference_align,
        cylinder_m=settings.core_m,
        groups=tally.groups(cores, lod_m),
    )
    remove(scratch)
    return ComparedReference(comparison, cores, lod_m, files.assumptions)


def _model(
    renderer: ModelRenderer, overview: MeasuredCloud, options: EvaluateOptions, scratch: Path, progress: Progress
) -> tuple[TiledPoints, FusionSettings, ReferenceShift | None, Similarity | None]:
    """Return the model's cloud, its shift against the reference, and any similarity by which it was moved."""
    geo_from_model = renderer.geo_from_model
    views = SurfaceViews(renderer, scratch / "depth_maps", colours=True, confirmed=True, progress=progress)
    settings = fusion_settings(views, geo_from_model, _LEAST_VIEWS)
    delivered = TiledPoints(scratch / "delivered", _SQUARE_M)
    sample = []
    for square in fused_squares(views, geo_from_model, settings, progress):
        delivered.append(square.position, square.normal, None)
        sample.append(square.position[first_of_voxels(square.position, 2 * _OVERVIEW_M)])
    views.close()
    if not delivered.count:
        message = "No point of the surface has the same depth in three training views: too few photographs "
        message += "overlap, or the training was too short. Add photographs, or train longer."
        raise DegenerateGeometryError("surface-not-seen", message)
    sparse = overview.position_in_geo[first_of_voxels(overview.position_in_geo, 2 * _OVERVIEW_M)]
    normal, kind = plane_normals(sparse, 2 * _OVERVIEW_M), options.reference_align
    alignment = fit_alignment(np.concatenate(sample), sparse, normal, 2 * _OVERVIEW_M, kind)
    if kind == "none":
        return delivered, settings, None if alignment is None else alignment[1], None
    if alignment is None:
        raise DegenerateGeometryError(
            "reference-not-aligned",
            "The surface and the reference overlap too little, or their shape leaves an axis open, so that the "
            f"{kind} between them cannot be estimated.",
            remedy="Compare with --reference-align none.",
        )
    similarity, shift = alignment
    moved = TiledPoints(scratch / "moved", delivered.side_m)
    for name in sorted(delivered.count):
        rows, inside = delivered.around(name, 0.0)
        moved.append(
            similarity.apply(rows["position"][inside]), rows["normal"][inside] @ similarity.rotation.T, None
        )
    return moved, settings, shift, similarity


def _viewpoints(renderer: ModelRenderer, moved: Similarity | None) -> Viewpoints:
    """Return the training cameras in geo, moved as the model's cloud was."""
    cameras, poses = renderer.model.indices("train"), renderer.poses
    similarity = renderer.geo_from_model if moved is None else moved @ renderer.geo_from_model
    return Viewpoints(
        poses.cam_from_model[cameras] @ similarity.rotation.T,
        similarity.apply(poses.cam_center_in_model[cameras]),
        tuple(renderer.images.pinhole(index) for index in cameras),
    )


def _sorted_reference(
    files: CloudReader, origin: Origin, box: Box, folder: Path, progress: Progress
) -> TiledPoints:
    (low, high), reference = box, TiledPoints(folder, _SQUARE_M)
    for chunk in files.chunks(origin, progress):
        position = chunk.position_in_geo
        inside = ((position >= low) & (position <= high)).all(axis=1)
        reference.append(position[inside], None, chunk.classification[inside])
    return reference


def _georeference_sigma(
    position: FloatArray, normal: FloatArray, solution: Solution, grid: AccuracyGrid | None
) -> FloatArray | None:
    """Return the predicted σ (C,) of the georeference along normals; None: not known."""
    if grid is None or not len(position) or not is_checked(solution.cautions):
        return None
    return np.asarray(np.sqrt(np.einsum("ci,cij,cj->c", normal, grid.cov_at(position), normal)))


_SHIFTED_SIGMAS = 3.0
_SEEN = 0.05


def cautions_of_reference(compared: ComparedReference) -> tuple[Remark, ...]:
    """Return the limits of a comparison: assumptions, coarse points, a shift of the whole, unseen places."""
    comparison = compared.comparison
    cautions = list(compared.assumptions)
    fine = max(comparison.spacing_m, comparison.model_spacing_m)
    least = comparison.groups[0].scores[0].threshold_m
    if fine > least:
        apart = (
            f"Points are {fine:.3f} m apart. Shares within shorter distances, and C2C, depend on this spacing; "
            "M3C2 does not."
        )
        cautions.append(Remark(code="reference-spacing", sentence=apart))
    shift = comparison.shift
    if shift is not None and comparison.aligned == "none":
        sigma = [max(s, comparison.georeference_sigma_m or 0.0, comparison.sigma_m) for s in shift.sigma_m]
        if any(abs(value) > _SHIFTED_SIGMAS * s for value, s in zip(shift.enu_m, sigma, strict=True)):
            off = (
                "The model is shifted against the reference by more than three times the σ of both: the best fit "
                f"moves it by {shift.enu_m[0]:+.3f} m east, {shift.enu_m[1]:+.3f} m north and "
                f"{shift.enu_m[2]:+.3f} m up."
            )
            remedy = "To compare the shape alone, use --reference-align shift."
            cautions.append(Remark(code="reference-shifted", sentence=off, remedy=remedy))
    if comparison.seen < _SEEN:
        seen = f"Photographs saw {100 * comparison.seen:.1f} % of the reference's points within the scene."
        cautions.append(Remark(code="reference-unseen", sentence=seen))
    return tuple(cautions)


def draw_reference(compared: ComparedReference, folder: Path) -> None:
    """Write map and histogram of the distances along the normals; nothing if none was measured."""
    cores, lod_m = compared.cores, compared.lod_m
    known = np.isfinite(cores.distance_m)
    if not known.any():
        return
    distance_m, kind = cores.distance_m[known], cores.kinds.of_class[known]
    groups = {name: distance_m[kind == index] for index, name in enumerate(CLASSES) if (kind == index).any()}
    if len(groups) == 1:
        groups = {"all": distance_m}
    position, size_m = cores.position[known], compared.comparison.cylinder_m
    write_distance_map(folder / Path(REFERENCE_MAP).name, position[:, :2], distance_m, size_m)
    write_distance_histogram(folder / Path(REFERENCE_HISTOGRAM).name, groups, float(np.median(lod_m[known])))
