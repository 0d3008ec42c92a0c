"""Stage `evaluate`: renders against held-out photographs, positions against check points.

Reads the trained model, the survey and the initial similarity. Writes `evaluate/report.json`, the errors point by
point as `points.csv`, side-by-side renders, and the predicted accuracy over the scene as `accuracy.csv` and
`accuracy.png`. With `--reference`, the surface is compared with a cloud; `reference_map.png` and
`reference_histogram.png` show the distances. Check points enter no solution. Residuals of observations that entered
one are reported as a fit, not as an accuracy (docs/accuracy.md).
"""

from __future__ import annotations

from functools import partial

import numpy as np

from pipelines.adjust.accuracy_grid import write_csv
from pipelines.adjust.error_propagation import (
    ErrorPropagation,
    NoErrorPropagation,
    accuracy_summary,
    propagate_errors,
)
from pipelines.core.cautions import union
from pipelines.core.progress import Progress
from pipelines.core.workspace import StageRun, Summary
from pipelines.evaluate.accuracy_picture import draw_accuracy
from pipelines.evaluate.cautions import cautions_of_prediction, dependent_check_points
from pipelines.evaluate.check_points import cross_validate, fit_residuals, measure_check_points
from pipelines.evaluate.coordinates import coordinates_in, target_crs
from pipelines.evaluate.options import EvaluateOptions
from pipelines.evaluate.photometric import SaveRender, compare_test_views
from pipelines.evaluate.point_table import write_point_table
from pipelines.evaluate.reference.cautions import cautions_of_reference
from pipelines.evaluate.reference.comparison import ComparedReference, compare_with_reference, open_reference
from pipelines.evaluate.reference.pictures import draw_reference
from pipelines.evaluate.summary import summarise
from pipelines.geodesy.crs import PointCrs
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.scene.headline import headline
from pipelines.scene.render_files import write_render
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.report import EvaluationReport, Photometric, SimilaritySigma, write_report
from pipelines.scene.scene import photographs
from pipelines.scene.trained_survey import load_trained
from pipelines.splat.rasterizer.backends import rasterizer


def run(stage: StageRun, options: EvaluateOptions) -> Summary:
    """Evaluate the trained survey, write report, renders and predicted accuracy, and return the summary.

    Raises:
        BackendUnavailableError: `--backend cuda` or `--reference`, and a part that it needs is missing; names each.
        GeorefError: a product, a photograph or the LPIPS weights cannot be read, or the CRS cannot be used.
    """
    trained = load_trained(stage.workspace, options.similarity)
    reference_files = open_reference(options)
    crs = None if options.crs is None else target_crs(options.crs, trained.survey)
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(trained, images, rasterizer(options.backend, stage.progress))
    propagation = propagate_errors(stage.workspace, trained)
    renders = stage.out / "renders"
    renders.mkdir(parents=True, exist_ok=True)
    save_render = partial(write_render, renders)
    reference = None
    if reference_files is not None:
        scratch = stage.out / "reference"
        reference = compare_with_reference(
            renderer, reference_files, propagation, options, scratch=scratch, progress=stage.progress
        )
        draw_reference(reference, stage.out)
    report = evaluate(
        renderer,
        propagation,
        options,
        crs=crs,
        reference=reference,
        save_render=save_render,
        progress=stage.progress,
    )
    if isinstance(propagation, ErrorPropagation) and propagation.grid is not None:
        write_csv(propagation.grid, trained.survey.origin, stage.out / "accuracy.csv")
        draw_accuracy(propagation.grid, trained, report, crs, stage.out / "accuracy.png")
    write_point_table(stage.out / "points.csv", report, trained.survey)
    write_report(report, stage.out / "report.json")
    return summarise(report)


def evaluate(
    renderer: ModelRenderer,
    propagation: ErrorPropagation | NoErrorPropagation,
    options: EvaluateOptions,
    *,
    crs: PointCrs | None,
    reference: ComparedReference | None,
    save_render: SaveRender,
    progress: Progress,
) -> EvaluationReport:
    """Return the report on a trained survey.

    Args:
        renderer: of the trained model.
        propagation: covariances from the measurements, or the reason why there are none.
        options: of the stage.
        crs: CRS in which the report lists the check points too; None: none.
        reference: comparison with a reference cloud; None: none.
        save_render: saves the first test views side by side with their photographs.
        progress: shows depth maps and test views.

    Raises:
        InputError: a photograph or the LPIPS weights cannot be read, or a point lies outside the CRS's domain.
    """
    trained = renderer.trained
    checkpoints = measure_check_points(renderer, propagation, progress)
    test = compare_test_views(renderer, options.lpips_weights, save_render, progress, saved=options.renders)
    scene = accuracy_summary(propagation)
    return EvaluationReport(
        headline=headline(checkpoints.camera, scene, trained.model.cautions),
        photometric=Photometric(test=test),
        checkpoints=checkpoints,
        cross_validation=cross_validate(trained, propagation) if options.cross_validate else None,
        accuracy=scene,
        fit=fit_residuals(trained),
        similarity=_similarity_sigma(trained.model.geo_from_model),
        coordinates=None if crs is None else coordinates_in(crs, checkpoints, trained.survey),
        reference=None if reference is None else reference.comparison,
        variance_factors=trained.model.variance_factors,
        cautions=union(
            trained.model.cautions,
            cautions_of_prediction(
                trained, propagation, checkpoints.camera, of_initial=options.similarity == "initial"
            ),
            dependent_check_points(trained.survey),
            () if reference is None else cautions_of_reference(reference),
        ),
    )


def _similarity_sigma(record: SimilarityRecord) -> SimilaritySigma:
    """Return σ of ln s and of the translation, from a covariance in the order ln s, three angles, translation."""
    log_scale, *_, east, north, up = np.sqrt(np.diag(record.covariance)).tolist()
    return SimilaritySigma(sigma_ln_scale=log_scale, sigma_translation_m=(east, north, up))
