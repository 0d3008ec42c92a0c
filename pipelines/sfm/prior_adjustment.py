"""Bundle adjustment with the fixes as priors of the camera positions: the usual way to a georeferenced model.

Reads `ingest/survey.json` and `sfm/sparse`; writes `adjust/sparse`, the same model adjusted in the frame `geo`, and
`adjust/adjustment.json` and `.npz`: the adjusted cameras as they are, with the covariances that the fixes give,
and the identity as their initial similarity. This is the baseline
"SfM-BBA" of GeoRefGS (doi 10.3390/drones10030195), and the last step of COLMAP's `pose_prior_mapper`: image
observations have σ = 1 px, and fixes their covariances under Cauchy's kernel. Control points do not enter.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.adjust.alignment import Alignment, align
from pipelines.adjust.init_sim3 import solved
from pipelines.adjust.measurements import attitude_prior, fix_correspondences
from pipelines.adjust.posterior import save_posterior
from pipelines.core.child import run_in_child
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError
from pipelines.core.json_values import JsonValue
from pipelines.core.products import save_json
from pipelines.core.progress import Progress
from pipelines.core.stages import ADJUSTMENT, SIM3_POSTERIOR, SPARSE
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import load_reconstruction, quiet_colmap, read_sparse, write_reconstruction
from pipelines.geometry.cameras import Reconstruction, pycolmap_module
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import residual_stats
from pipelines.sfm.adjustment import position_adjuster
from pipelines.sfm.options import AdjustOptions
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import MeasurementVerdict, SimilarityEstimate
from pipelines.survey.survey import Fix, Survey

_MOST_ITERATIONS = 100
_FORCE_SFM = "COLMAP cannot adjust the model. Reconstruct it again with `georef sfm --force`."
# COLMAP aligns the model with the fixes before it adjusts. Its limit of an inlier is this factor times the largest
# residual of the inliers of `align`: with too tight a limit COLMAP has no start.
_ALIGNMENT_SLACK = 3.0


def run(stage: StageRun, options: AdjustOptions) -> Summary:
    """Write the SfM model adjusted with the fixes as position priors, in a child process; return its figures."""
    arguments = {
        "survey": load_survey(stage.workspace).model_dump(mode="json"),
        "model": str(stage.workspace.path(SPARSE)),
        "out": str(stage.out),
        "seed": options.seed,
    }
    task = "pipelines.sfm.prior_adjustment:write_adjusted"
    document = run_in_child(task, arguments, _FORCE_SFM, stage.progress, writes=stage.out)
    return Summary(document["key_figure"], document["values"])


def write_adjusted(arguments: Mapping[str, JsonValue], progress: Progress) -> dict[str, Any]:
    """Adjust a model and write it; return the summary as a document.

    Among the arguments are the calibrated `survey`, paths of `model` and `out`, and `seed`.
    """
    survey, path = Survey.model_validate(arguments["survey"]), Path(arguments["model"])
    out, seed = Path(arguments["out"]), int(arguments["seed"])
    sparse = out / "sparse"
    alignment = _aligned(read_sparse(path), survey, seed)
    model = load_reconstruction(path)
    with quiet_colmap(), progress.task("adjustment", 1) as task:
        adjust_to_fixes(model, survey, alignment, seed)
        task.advance()
    write_reconstruction(model, sparse)
    names = tuple(image.name for image, _ in _located(model, survey))
    adjusted_model = read_sparse(sparse)
    similarity, verdict = _identity(_aligned(adjusted_model, survey, seed), names, _residuals(model, survey))
    posterior = solved(survey.model_copy(update={"control_points": ()}), adjusted_model, similarity, verdict)
    save_json(posterior.solution, out / Path(ADJUSTMENT).name)
    save_posterior(posterior, out / Path(SIM3_POSTERIOR).name)
    fixes = similarity.residuals["gnss"]
    values = {"residuals": fixes.model_dump(), "reprojection_error_px": model.compute_mean_reprojection_error()}
    return {"key_figure": f"{fixes.rmse_3d_m:.3f} m RMS from {fixes.count} fixes", "values": values}


def adjust_to_fixes(model: Reconstruction, survey: Survey, alignment: Alignment, seed: int = 0) -> None:
    """Adjust cameras, lenses and points of a `pycolmap.Reconstruction` in place; its frame becomes `geo`.

    The residuals of its alignment with the fixes limit those of COLMAP's inliers.

    Raises:
        DegenerateGeometryError: the fixes lie on one line, and leave the rotation about that line open.
        ConvergenceError: COLMAP found no solution.
    """
    if alignment.layout == "line":
        raise DegenerateGeometryError(
            "positions-on-a-line",
            "The fixes lie on one line: a bundle adjustment with positions alone can turn the model about it.",
        )
    colmap = pycolmap_module()
    fixes = [
        (image, np.array(fix.position_in_geo), np.array(fix.cov_apart)) for image, fix in _located(model, survey)
    ]
    solution = alignment.solution
    furthest = np.linalg.norm(solution.residual[solution.state.inlier], axis=1).max()
    limit_m = float(_ALIGNMENT_SLACK * max(furthest, 1e-3))
    adjuster = position_adjuster(colmap, model, fixes, iterations=_MOST_ITERATIONS, gate_m=limit_m, seed=seed)
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise ConvergenceError(
            "bundle-not-converged", f"The bundle adjustment found no solution: {summary.brief_report()}"
        )
    # If COLMAP cannot align the model with the fixes, it adjusts without them, and only its log mentions that.
    if np.median(np.linalg.norm(_residuals(model, survey), axis=1)) > limit_m:
        raise ConvergenceError(
            "cameras-off-fixes",
            f"The bundle adjustment left most cameras more than {limit_m:.2f} m away from their fixes.",
        )
    model.update_point_3d_errors()


def _aligned(model: SparseModel, survey: Survey, seed: int) -> Alignment:
    data = fix_correspondences(survey, model)
    return align(data, np.random.default_rng(seed), attitude=attitude_prior(survey, model))


def _identity(
    alignment: Alignment, names: tuple[str, ...], residual: FloatArray
) -> tuple[SimilarityEstimate, MeasurementVerdict]:
    """Return the identity as initial similarity, and the verdict on the fixes.

    At its minimum the adjustment cannot improve the similarity.

    The alignment of the adjusted model with the fixes has the covariance; F images with a fix have `names` and
    `residual` (F, 3).
    """
    solution = alignment.solution
    inlier = solution.state.inlier
    initial = SimilarityEstimate(
        geo_from_local=Similarity().to_record("local", "geo", covariance=solution.covariance, pivot=solution.pivot),
        method="adjusted",
        correspondences={"gnss": len(inlier), "gcp": 0, "points": 0},
        inliers={"gnss": int(inlier.sum()), "gcp": 0, "points": 0},
        residuals={"gnss": residual_stats(residual)},
        condition_number=solution.condition_number,
        layout=alignment.layout,
        attitude_used=False,
    )
    outliers = tuple(name for name, good in zip(names, inlier, strict=True) if not good)
    return initial, MeasurementVerdict(gnss_outliers=outliers)


def _located(model: Reconstruction, survey: Survey) -> list[tuple[Any, Fix]]:
    fixes = {image.name: image.fix for image in survey.images if image.fix is not None}
    images = (model.images[image_id] for image_id in sorted(model.reg_image_ids()))
    return [(image, fixes[image.name]) for image in images if image.name in fixes]


def _residuals(model: Reconstruction, survey: Survey) -> FloatArray:
    """Return camera centres minus fixes (F, 3) of a model in `geo`."""
    rows = [image.projection_center() - np.array(fix.position_in_geo) for image, fix in _located(model, survey)]
    return np.array(rows).reshape(-1, 3)
