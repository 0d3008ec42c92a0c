"""Stage `init-sim3`: the similarity `geo_from_local` from the SfM model to the Earth.

Reads `ingest/survey.json`, `sfm/sparse`, `geolocate/points.npz`; writes `sim3/geo_from_local.json`
and the adjustment, `sim3/adjustment.json` and `.npz`.
GeoRefGS section 2.4.1, eqs 16–21 (doi 10.3390/drones10030195), is `--method paper`. The default starts from a
robust alignment of camera centres and control points, adjusts similarity, cameras and lens together, and tests the
stated σ. `pipelines.adjust.alignment` explains why the geolocated points are no observations.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipelines.adjust.observations import control_correspondences, fix_correspondences
from pipelines.adjust.options import InitSim3Options
from pipelines.adjust.paper import similarity_by_paper
from pipelines.adjust.posterior import save_posterior
from pipelines.adjust.robust import Estimated, robust_similarity, solved
from pipelines.core.errors import ConvergenceError, InputError
from pipelines.core.products import save_json
from pipelines.core.stages import ADJUSTMENT, POINTS, SIM3, SIM3_POSTERIOR, SPARSE
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.adjustment import GeolocatedPoints, InitialSimilarity
from pipelines.survey.calibrated import load_survey
from pipelines.survey.survey import Survey


def run(stage: StageRun, options: InitSim3Options) -> Summary:
    """Estimate the similarity of the workspace and write it.

    Raises:
        GeorefError: unreadable products, or an error of `estimate_similarity`.
    """
    survey = load_survey(stage.workspace)
    model = read_sparse(stage.workspace.path(SPARSE))
    points = GeolocatedPoints.load(stage.workspace.path(POINTS))
    estimated = estimate_similarity(survey, model, points, options)
    save_json(estimated.initial, stage.out / Path(SIM3).name)
    save_json(estimated.posterior.solution, stage.out / Path(ADJUSTMENT).name)
    save_posterior(estimated.posterior, stage.out / Path(SIM3_POSTERIOR).name)
    return _summary(estimated)


def estimate_similarity(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> Estimated:
    """Return the initial similarity with the adjustment, and warnings for the user.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open; names further measurements.
        ContradictionError: sources contradict each other, and the options do not accept that.
        ConvergenceError: the residual is larger than `options.max_residual`.
        InputError: `points` belongs to another model.
    """
    if not np.array_equal(points.point_id, model.point_id):
        raise InputError("the geolocated points are of another model: run `georef geolocate` again")
    if not options.control_points:
        survey = survey.model_copy(update={"control_points": ()})
    if options.method == "paper":
        control, unused = control_correspondences(survey, model)
        initial = similarity_by_paper(model, points, fix_correspondences(survey, model).joined(control))
        posterior = solved(survey, model, initial, options.estimate)
        estimated = Estimated(initial, posterior, tuple(point.sentence for point in unused))
    else:
        estimated = robust_similarity(survey, model, points, options)
    _check_residual(estimated.initial, options.max_residual)
    return estimated


def _check_residual(initial: InitialSimilarity, limit_m: float | None) -> None:
    kind: Literal["gnss", "gcp"] = "gnss" if initial.residuals["gnss"].count else "gcp"
    stats = initial.residuals[kind]
    if limit_m is None or stats.rmse_3d_m is None or stats.rmse_3d_m <= limit_m:
        return
    what = "camera centres" if kind == "gnss" else "control points"
    raise ConvergenceError(
        f"RMS residual of {stats.count} {what} is {stats.rmse_3d_m:.3f} m (horizontal {stats.rmse_h_m:.3f}, "
        f"vertical {stats.rmse_v_m:.3f}), more than --max-residual {limit_m:g} m: look for wrong positions or a "
        "bent SfM model, or allow more"
    )


def _summary(estimated: Estimated) -> Summary:
    initial = estimated.initial
    sigma = np.sqrt(np.diag(np.array(initial.geo_from_local.covariance)))
    parts = [
        f"{kind} {stats.rmse_3d_m:.3f} m RMS of {stats.count}"
        for kind, stats in initial.residuals.items()
        if stats.rmse_3d_m is not None and kind != "points"
    ]
    position = float(np.linalg.norm(sigma[4:]))
    values: dict[str, Any] = {
        "scale": initial.geo_from_local.scale,
        "sigma_scale": float(sigma[0] * initial.geo_from_local.scale),
        "sigma_rotation_deg": float(np.degrees(sigma[1:4].max())),
        "sigma_position_m": position,
        "layout": initial.layout,
        "attitude_used": initial.attitude_used,
        "condition_number": initial.condition_number,
        "inliers": initial.inliers,
        "gnss_outliers": list(initial.gnss_outliers),
        "variance_factors": [factor.model_dump() for factor in initial.variance_factors],
        "residuals": {kind: stats.model_dump() for kind, stats in initial.residuals.items()},
    }
    return Summary(
        f"σ of the georeference alone {position:.3f} m; residuals {', '.join(parts)}",
        values,
        estimated.warnings,
        initial.cautions,
    )
