"""Stage `evaluate`: positions against check points, renders against held-out photographs.

Reads survey, SfM model, adjustment, and any trained model. Writes `evaluate/report.json`, the errors point by point
as `points.csv`, the σ of every camera as `cameras.csv`, and the predicted accuracy over the scene as `accuracy.csv`
and `accuracy.png`; of a trained model also side-by-side renders. With `--reference`, the surface is compared with a
cloud; `reference_map.png` and `reference_histogram.png` show the distances. Check points enter no solution.
Residuals of observations that entered one are reported as a fit, not as an accuracy (docs/accuracy.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid, write_csv
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.figures import WAYS, Headline, ToleranceTest
from pipelines.core.products import Remark, is_checked, save_json, union
from pipelines.core.progress import SILENT, Progress
from pipelines.core.sentences import listed
from pipelines.core.stages import BY_NAME, HELD_OUT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.evaluate import check_points
from pipelines.evaluate.asprs import few_points, tolerance_test
from pipelines.evaluate.coordinates import (
    coordinates_in,
    error_array,
    report_crs,
    write_camera_sigma,
    write_point_table,
)
from pipelines.evaluate.held_out import held_out_depths
from pipelines.evaluate.options import EvaluateOptions
from pipelines.evaluate.photometric import compare_test_views
from pipelines.evaluate.reference import (
    ComparedReference,
    cautions_of_reference,
    compare_with_reference,
    draw_reference,
)
from pipelines.evaluate.surface_heights import surface_accuracy, surface_heights
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.sparse_model import SparseModel
from pipelines.report.place import map_coordinates
from pipelines.report.plots.maps import MapPoints, SigmaRaster, write_accuracy_map
from pipelines.report.plots.plans import MapCoordinates, NamedPlaces
from pipelines.surface.m3c2 import require_py4dgeo
from pipelines.surface.measured_area import area_of
from pipelines.surface.measured_cloud import CloudReader
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.area import Area
from pipelines.survey.headline import headline
from pipelines.survey.lidar_report import HeldOutDepths, HeldOutPoints
from pipelines.survey.marks import of_wrong_marks, wrong_marks
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CloudCrs, CrsOptions
from pipelines.survey.photographs import write_render
from pipelines.survey.report import (
    AccuracySummary,
    CheckPointErrors,
    CheckPoints,
    EvaluationReport,
    Fit,
    Photometric,
    PhotometricFigures,
    PointResidual,
    SimilaritySigma,
    SurfaceHeight,
)
from pipelines.survey.solution import Solution, TrainedModel, read_sfm, read_solution
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs, usable_crs


def summarise(report: EvaluationReport) -> Summary:
    """Return headline, figures, warnings and cautions of a report, for the command line."""
    test = report.test_views
    values: dict[str, Any] = {"accuracy": report.headline.model_dump()}
    if test is not None:
        names = ("views", "psnr", "psnr_over_white", "psnr_covered", "covered_share", "psnr_compensated", "ssim")
        values |= {name: getattr(test, name) for name in names}
    for way, errors in report.checkpoints.by_way.items():
        figures = ("count", "mean_h_m", "rmse_h_m", "rmse_v_m", "rmse_3d_m")
        values |= {f"{way}_{name}": getattr(errors, name) for name in figures}
    if report.distances:
        values["distances"] = [distance.model_dump() for distance in report.distances]
    if report.held_out is not None:
        values["held_out"] = report.held_out.model_dump()
    if report.tolerances:
        values["tolerances"] = [each.model_dump() for each in report.tolerances]
    key_figure = f"{report.headline.sentence}; {_test_views(test)}"
    return Summary(key_figure, values, _warnings(report), report.cautions)


def _test_views(test: PhotometricFigures | None) -> str:
    if test is None:
        return "cameras alone, not trained yet"
    if test.psnr is None:
        return "no test views"
    if test.psnr_covered is None or test.covered_share is None:
        return f"test PSNR {test.psnr:.2f} dB"
    return f"test PSNR {test.psnr:.2f} dB, {test.psnr_covered:.2f} dB on the {test.covered_share:.0%} covered"


def _warnings(report: EvaluationReport) -> tuple[Remark, ...]:
    warnings = []
    asprs = report.checkpoints.triangulated.asprs
    if asprs.points and not asprs.enough_points:
        warnings.append(Remark(code="few-check-points", sentence=few_points(asprs)))
    for way, errors in report.checkpoints.by_way.items():
        if errors.blunders:
            sentence = (
                f"{len(errors.blunders)} of {errors.count} check points, {WAYS[way]}, have errors of more than "
                f"three times the class that the others meet: {listed(errors.blunders)}."
            )
            warnings.append(Remark(code="check-point-blunders", sentence=sentence))
    crossed = report.cross_validation
    if crossed is not None and crossed.reason is not None:
        sentence = f"There is no cross-validation: {crossed.reason}."
        warnings.append(Remark(code="no-cross-validation", sentence=sentence))
    return tuple(warnings)


def draw_accuracy(
    grid: AccuracyGrid,
    survey: Survey,
    report: EvaluationReport,
    path: Path,
    *,
    center: FloatArray,
    crs: PointCrs | None,
) -> None:
    """Write a map of the predicted accuracy, with cameras, control and check points, errors and coordinates.

    The cameras (N, 3) are in `geo`, the coordinates in a CRS; None: in the UTM zone.
    """
    raster = SigmaRaster(grid.raster(grid.sigma_h_m), grid.raster(grid.sigma_v_m), grid.corner_in_geo, grid.size_m)
    points = MapPoints(
        cameras=center[:, :2],
        control=_named(survey.control_points, report.fit.gcp.points),
        check=_named(survey.check_points, report.checkpoints.triangulated.points),
    )
    write_accuracy_map(path, raster, points, _coordinates(survey, crs, center))


def _named(points: Sequence[SurveyedPoint], rows: Sequence[PointResidual]) -> NamedPlaces:
    plan = np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
    return NamedPlaces(plan, tuple(point.name for point in points), error_array(rows))


def _coordinates(survey: Survey, crs: PointCrs | None, center: FloatArray) -> MapCoordinates:
    """Return the coordinates on the axes of a map: of a CRS, None: of the UTM zone, as in the report."""
    if crs is None or crs.is_geocentric or survey.origin is None:
        return map_coordinates(usable_crs(CrsOptions(), survey.origin, center, survey.vertical))
    return map_coordinates(TargetCrs(crs, survey.origin, lla_from_enu(center, survey.origin)))


@dataclass(frozen=True)
class Rendered:
    """Comparisons of the Gaussians of a trained model: test views, check points on the surface, and any reference.

    `held_out`: errors at measured points that the training was not given; None: there are none.
    """

    photometric: Photometric
    points: CheckPointErrors
    heights: tuple[SurfaceHeight, ...]
    reference: ComparedReference | None
    held_out: HeldOutDepths | None = None


def run(stage: StageRun, options: EvaluateOptions) -> Summary:
    """Evaluate the survey, write report, renders and predicted accuracy, and return the summary.

    Raises:
        BackendUnavailableError: `--backend cuda` or `--reference`, and a part that it needs is missing; names each.
        InputError: `--reference` or `--lpips-weights` without a trained model.
        GeorefError: a product, a photograph or the LPIPS weights cannot be read, or the CRS cannot be used.
    """
    solution = read_solution(stage.workspace, similarity=options.similarity)
    sfm, survey = read_sfm(stage.workspace, solution), solution.weighted(load_survey(stage.workspace))
    crs = None if options.crs is None else report_crs(options.crs, survey)
    posterior = posterior_of(stage.workspace, solution, sfm)
    area = area_of_interest(options, stage.workspace, solution, sfm, survey, progress=stage.progress)
    if isinstance(solution, TrainedModel):
        files = _reference_reader(options)
        renderer = model_renderer(
            stage.workspace, solution, sfm, survey, backend=options.backend, progress=stage.progress
        )
        rendered = _rendered(stage, renderer, survey, posterior, options, files=files, area=area)
    else:
        rendered = None
        for flag, value in (("--reference", options.reference), ("--lpips-weights", options.lpips_weights)):
            if value is not None:
                command = stage.workspace.command_of(BY_NAME["train"])
                message = "needs a trained model."
                remedy = f"Run `{command}` first, or leave the option out."
                raise InputError("not-trained", message, field=flag, remedy=remedy)
    report = evaluate(survey, posterior, options, crs=crs, rendered=rendered, area=area)
    if posterior.grid is not None:
        write_csv(posterior.grid, survey.origin, stage.out / "accuracy.csv")
        path, center = stage.out / "accuracy.png", solution.center_in_geo
        draw_accuracy(posterior.grid, survey, report, path, center=center, crs=crs)
    write_point_table(stage.out / "points.csv", report, survey)
    if report.cameras is not None:
        write_camera_sigma(stage.out / "cameras.csv", sfm.image_name, posterior.camera_cov)
    save_json(report, stage.out / "report.json")
    summary = summarise(report)
    wrong = of_wrong_marks(wrong_marks(survey.check_points, posterior.sparse))
    return replace(summary, warnings=(*summary.warnings, *wrong))


def area_of_interest(
    options: EvaluateOptions,
    workspace: Workspace,
    solution: Solution,
    sfm: SparseModel,
    survey: Survey,
    *,
    progress: Progress = SILENT,
) -> Area | None:
    """Return the area of interest, as `area_of`; None: no ground is seen by enough photographs."""
    try:
        return area_of(options, workspace, solution, sfm, survey, progress=progress)
    except DegenerateGeometryError:
        return None


def evaluate(
    survey: Survey,
    posterior: Posterior,
    options: EvaluateOptions,
    *,
    crs: PointCrs | None = None,
    rendered: Rendered | None = None,
    area: Area | None = None,
) -> EvaluationReport:
    """Return the report on a survey; `crs` lists the check points, without `rendered` nothing is trained.

    Raises:
        InputError: a point lies outside the CRS's domain.
    """
    model = posterior.solution
    log_scale, *_, east, north, up = np.sqrt(np.maximum(np.diag(model.geo_from_model.covariance), 0.0)).tolist()
    area_km2 = None if area is None else area.hectares / 100
    triangulated = check_points.triangulated_check_points(survey, posterior, area_km2)
    heights = () if rendered is None else rendered.heights
    checkpoints = CheckPoints(
        triangulated=triangulated, surface=None if rendered is None else rendered.points, heights=heights
    )
    surface = surface_accuracy(heights, survey.check_points)
    scene = model.accuracy or AccuracySummary(cells=0, reason="the adjustment states no σ")
    reference = None if rendered is None else rendered.reference
    accuracy = headline(triangulated, scene, model.cautions, surface)
    return EvaluationReport(
        headline=accuracy,
        area_ha=None if area is None else area.hectares,
        area_measured=None if area is None else area.measured,
        photometric=None if rendered is None else rendered.photometric,
        checkpoints=checkpoints,
        cross_validation=check_points.cross_validate(survey, posterior) if options.cross_validate else None,
        accuracy=scene,
        fit=Fit(
            gnss=check_points.fix_residuals(survey, model), gcp=check_points.control_residuals(survey, posterior)
        ),
        cameras=check_points.rms_sigma(posterior.camera_cov[:, 3:, 3:]) if is_checked(model.cautions) else None,
        similarity=SimilaritySigma(sigma_ln_scale=log_scale, sigma_translation_m=(east, north, up)),
        coordinates=None if crs is None else coordinates_in(crs, checkpoints, survey),
        reference=None if reference is None else reference.comparison,
        held_out=None if rendered is None else rendered.held_out,
        distances=check_points.distance_errors(survey, posterior),
        tolerances=_tolerances(accuracy, options, area_km2),
        variance_factors=model.variance_factors,
        cautions=union(
            model.cautions,
            check_points.cautions_of_prediction(
                survey, posterior, triangulated, of_initial=options.similarity == "initial"
            ),
            check_points.dependent_check_points(survey),
            () if reference is None else cautions_of_reference(reference),
        ),
    )


def _tolerances(accuracy: Headline, options: EvaluateOptions, area_km2: float | None) -> tuple[ToleranceTest, ...]:
    """Return the tests of the required accuracies: of the triangulated points and of the surface."""
    measured = accuracy if accuracy.kind == "measured" else Headline(kind="unknown")
    wanted: list[tuple[str, float | None, float | None, int]] = [
        ("horizontal, of triangulated points", options.tolerance_h, measured.rmse_h_m, measured.check_points),
        ("vertical, of triangulated points", options.tolerance_v, measured.rmse_v_m, measured.check_points),
    ]
    for where, _, errors in () if accuracy.surface is None else accuracy.surface.parts:
        name = f"vertical, of the surface {where}".rstrip()
        wanted.append((name, options.tolerance_v, errors.rmse_v_m, errors.check_points))
    return tuple(
        tolerance_test(of, tolerance_m, rmse_m, count, area_km2)
        for of, tolerance_m, rmse_m, count in wanted
        if tolerance_m is not None
    )


def _reference_reader(options: EvaluateOptions) -> CloudReader | None:
    """Return the reader of the reference, refused before work starts: without a CRS, or without the library."""
    if options.reference is None:
        return None
    require_py4dgeo()
    stated = CloudCrs(options.reference_crs, options.reference_vertical, "--reference", options.reference_offset)
    return CloudReader(options.reference, stated)


def _rendered(
    stage: StageRun,
    renderer: ModelRenderer,
    survey: Survey,
    posterior: Posterior,
    options: EvaluateOptions,
    *,
    files: CloudReader | None,
    area: Area | None,
) -> Rendered:
    progress = stage.progress
    renderer.images.build(progress)
    renders, reference = stage.out / "renders", None
    renders.mkdir(parents=True, exist_ok=True)
    if files is not None:
        scratch = stage.out / "reference"
        reference = compare_with_reference(
            renderer, survey.origin_on_earth, files, posterior.grid, options, scratch=scratch, progress=progress
        )
        draw_reference(reference, stage.out)
    area_km2 = None if area is None else area.hectares / 100
    points = check_points.check_points_on_surface(survey.check_points, renderer, progress, area_km2)
    save_render = partial(write_render, renders)
    test = compare_test_views(renderer, options.lpips_weights, save_render, progress, saved=options.renders)
    held_out = None
    if stage.workspace.has(HELD_OUT):
        held_out = held_out_depths(renderer, HeldOutPoints.load(stage.workspace.path(HELD_OUT)), progress)
    return Rendered(
        Photometric(test=test),
        points,
        surface_heights(survey.check_points, renderer, progress),
        reference,
        held_out,
    )
