"""Stage `evaluate`: positions against check points, renders against held-out photographs.

Reads survey, SfM model, adjustment, and any trained model. Writes `evaluate/report.json`, the errors point by point
as `points.csv`, the σ of every camera as `cameras.csv`, and the predicted accuracy over the scene as `accuracy.csv`
and `accuracy.png`; of a trained model also side-by-side renders. With `--reference`, the surface is compared with a
cloud; `reference_map.png` and `reference_histogram.png` show the distances. Check points enter no solution.
Residuals of observations that entered one are reported as a fit, not as an accuracy (docs/accuracy.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from pipelines.adjust.accuracy_grid import write_csv
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.cautions import is_checked, union
from pipelines.core.errors import InputError
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import StageRun, Summary
from pipelines.evaluate.accuracy_picture import draw_accuracy
from pipelines.evaluate.cautions import cautions_of_prediction, dependent_check_points
from pipelines.evaluate.check_points import (
    check_points_on_surface,
    cross_validate,
    fit_residuals,
    triangulated_check_points,
)
from pipelines.evaluate.coordinates import coordinates_in, target_crs
from pipelines.evaluate.options import EvaluateOptions
from pipelines.evaluate.photometric import compare_test_views
from pipelines.evaluate.point_report import rms_sigma
from pipelines.evaluate.point_table import write_camera_sigma, write_point_table
from pipelines.evaluate.reference.cautions import cautions_of_reference
from pipelines.evaluate.reference.comparison import ComparedReference, compare_with_reference, open_reference
from pipelines.evaluate.reference.pictures import draw_reference
from pipelines.evaluate.summary import summarise
from pipelines.geodesy.crs import PointCrs
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.scene.headline import headline
from pipelines.scene.render_files import write_render
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.report import (
    AccuracySummary,
    CheckPointErrors,
    CheckPoints,
    EvaluationReport,
    Photometric,
    SimilaritySigma,
    write_report,
)
from pipelines.scene.scene import photographs
from pipelines.scene.trained_survey import SolvedSurvey, TrainedSurvey, load_solved
from pipelines.splat.rasterizer.backends import rasterizer


@dataclass(frozen=True)
class Rendered:
    """What the Gaussians of a trained model show.

    Attributes:
        photometric: figures of the test views.
        points: errors of the check points on the rendered surface.
        reference: comparison with a reference cloud; None: not asked for.
    """

    photometric: Photometric
    points: CheckPointErrors
    reference: ComparedReference | None


def run(stage: StageRun, options: EvaluateOptions) -> Summary:
    """Evaluate the survey, write report, renders and predicted accuracy, and return the summary.

    Raises:
        BackendUnavailableError: `--backend cuda` or `--reference`, and a part that it needs is missing; names each.
        InputError: `--reference` or `--lpips-weights` without a trained model.
        GeorefError: a product, a photograph or the LPIPS weights cannot be read, or the CRS cannot be used.
    """
    solved = load_solved(stage.workspace, options.similarity)
    crs = None if options.crs is None else target_crs(options.crs, solved.survey)
    posterior = posterior_of(stage.workspace, solved.model, solved.sfm)
    if isinstance(solved, TrainedSurvey):
        rendered = _rendered(stage, solved, posterior, options)
    else:
        rendered = None
        _refuse_what_needs_gaussians(stage, options)
    report = evaluate(solved, posterior, options, crs=crs, rendered=rendered)
    if posterior.grid is not None:
        write_csv(posterior.grid, solved.survey.origin, stage.out / "accuracy.csv")
        draw_accuracy(posterior.grid, solved, report, crs, stage.out / "accuracy.png")
    write_point_table(stage.out / "points.csv", report, solved.survey)
    if report.cameras is not None:
        write_camera_sigma(stage.out / "cameras.csv", solved.sfm.image_name, posterior.camera_cov)
    write_report(report, stage.out / "report.json")
    return summarise(report)


def evaluate(
    solved: SolvedSurvey,
    posterior: Posterior,
    options: EvaluateOptions,
    *,
    crs: PointCrs | None = None,
    rendered: Rendered | None = None,
) -> EvaluationReport:
    """Return the report on a solved survey.

    Args:
        solved: the survey.
        posterior: its covariances.
        options: of the stage.
        crs: CRS in which the report lists the check points too; None: none.
        rendered: what the Gaussians show; None: nothing is trained yet.

    Raises:
        InputError: a point lies outside the CRS's domain.
    """
    model = solved.model
    camera = triangulated_check_points(solved, posterior)
    checkpoints = CheckPoints(camera=camera, model=None if rendered is None else rendered.points)
    scene = model.accuracy or AccuracySummary(cells=0, reason="the adjustment states no σ")
    reference = None if rendered is None else rendered.reference
    return EvaluationReport(
        headline=headline(camera, scene, model.cautions),
        photometric=None if rendered is None else rendered.photometric,
        checkpoints=checkpoints,
        cross_validation=cross_validate(solved) if options.cross_validate else None,
        accuracy=scene,
        fit=fit_residuals(solved),
        cameras=rms_sigma(posterior.camera_cov[:, 3:, 3:]) if is_checked(model.cautions) else None,
        similarity=_similarity_sigma(model.geo_from_model),
        coordinates=None if crs is None else coordinates_in(crs, checkpoints, solved.survey),
        reference=None if reference is None else reference.comparison,
        variance_factors=model.variance_factors,
        cautions=union(
            model.cautions,
            cautions_of_prediction(solved, posterior, camera, of_initial=options.similarity == "initial"),
            dependent_check_points(solved.survey),
            () if reference is None else cautions_of_reference(reference),
        ),
    )


def _rendered(stage: StageRun, trained: TrainedSurvey, posterior: Posterior, options: EvaluateOptions) -> Rendered:
    """Return what the Gaussians show, with the pictures written."""
    files, progress = open_reference(options), stage.progress
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(progress)
    renderer = ModelRenderer(trained, images, rasterizer(options.backend, progress))
    renders, reference = stage.out / "renders", None
    renders.mkdir(parents=True, exist_ok=True)
    if files is not None:
        scratch = stage.out / "reference"
        reference = compare_with_reference(
            renderer, files, posterior.grid, options, scratch=scratch, progress=progress
        )
        draw_reference(reference, stage.out)
    points = check_points_on_surface(renderer, progress)
    save_render = partial(write_render, renders)
    test = compare_test_views(renderer, options.lpips_weights, save_render, progress, saved=options.renders)
    return Rendered(Photometric(test=test), points, reference)


def _refuse_what_needs_gaussians(stage: StageRun, options: EvaluateOptions) -> None:
    """Refuse options that ask for what only a trained model shows.

    Raises:
        InputError: names the option, and the command that trains.
    """
    for flag, value in (("--reference", options.reference), ("--lpips-weights", options.lpips_weights)):
        if value is not None:
            command = stage.workspace.command_of(BY_NAME["train"])
            raise InputError(f"needs a trained model: run `{command}` first, or leave the option out", field=flag)


def _similarity_sigma(record: SimilarityRecord) -> SimilaritySigma:
    """Return σ of ln s and of the translation, from a covariance in the order ln s, three angles, translation."""
    log_scale, *_, east, north, up = np.sqrt(np.diag(record.covariance)).tolist()
    return SimilaritySigma(sigma_ln_scale=log_scale, sigma_translation_m=(east, north, up))
