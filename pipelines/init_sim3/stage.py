"""Stage `init-sim3`: the similarity `geo_from_local` from the SfM model to the Earth.

Reads `ingest/survey.json`, `sfm/sparse`, `geolocate/points.npz`; writes `sim3/geo_from_local.json`.
GeoRefGS section 2.4.1, eqs 16–21 (doi 10.3390/drones10030195), is `--method paper`. The default is a robust
adjustment over camera centres and control points. Its starts come from these and from the geolocated points.
`pipelines.georef.alignment` explains why the geolocated points are no observations.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, InputError
from pipelines.core.products import save_json
from pipelines.core.stages import POINTS, SPARSE
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity, jacobian_at, spread_ratio_similarity, umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.georef.adjustment import OUTLIER_GATE, AdjustedSimilarity, Correspondences, RotationPrior
from pipelines.georef.alignment import Alignment, align, layout_of
from pipelines.init_sim3.options import InitSim3Options
from pipelines.robust.ransac import RansacOptions, ransac
from pipelines.robust.statistics import ResidualStats, residual_stats, squared_mahalanobis
from pipelines.scene.calibrated import load_survey
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.initial_similarity import AttitudeRecord, InitialSimilarity
from pipelines.scene.observations import (
    attitude_prior,
    control_correspondences,
    fix_correspondences,
    positions_in_use,
)
from pipelines.scene.survey import Survey

_GUESS_POINTS = 1000
_LOUD_EXCESS = 2.0  # times the stated σ


def run(stage: StageRun, options: InitSim3Options) -> Summary:
    """Estimate the similarity of the workspace and write it.

    Raises:
        GeorefError: unreadable products, or an error of `estimate_similarity`.
    """
    survey = load_survey(stage.workspace)
    model = read_sparse(stage.workspace.path(SPARSE))
    points = GeolocatedPoints.load(stage.workspace.path(POINTS))
    initial, warnings = estimate_similarity(survey, model, points, options)
    save_json(initial, stage.out / "geo_from_local.json")
    return _summary(initial, warnings)


def estimate_similarity(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> tuple[InitialSimilarity, tuple[str, ...]]:
    """Return the initial similarity, and warnings for the user.

    Args:
        survey: has the fixes, attitudes and control points.
        model: the SfM model.
        points: the model's points on Earth.
        options: of the stage.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open; names further measurements.
        ConvergenceError: the residual is larger than `options.max_residual`.
        InputError: `points` belongs to another model.
    """
    if not np.array_equal(points.point_id, model.point_id):
        raise InputError("the geolocated points are of another model: run `georef geolocate` again")
    fixes = fix_correspondences(survey, model)
    if not options.control_points:
        survey = survey.model_copy(update={"control_points": ()})
    control, unused = control_correspondences(survey, model)
    warnings = tuple(point.sentence for point in unused)
    data = fixes.joined(control)
    if options.method == "paper":
        initial = _by_paper(model, points, data)
    else:
        guess = _guess(model, points, np.random.default_rng(options.seed))
        try:
            alignment = align(
                data,
                np.random.default_rng(options.seed),
                attitude=attitude_prior(survey, model),
                guesses=(guess,) if guess else (),
            )
        except DegenerateGeometryError as error:
            reasons = positions_in_use(survey, model, data, unused)
            raise DegenerateGeometryError(f"{error}. {reasons}") from error
        initial = _robust_product(model, points, data, alignment)
        warnings += _warnings(data, alignment.solution)
    _check_residual(initial, options.max_residual)
    return initial, warnings


def _guess(model: SparseModel, points: GeolocatedPoints, rng: np.random.Generator) -> Similarity | None:
    """Return the similarity of the best geolocated points, by RANSAC, then weighted by covariance; or None."""
    trace = np.trace(points.cov_in_geo, axis1=1, axis2=2)
    best = np.flatnonzero(points.inlier)
    best = best[np.argsort(trace[best], kind="stable")][:_GUESS_POINTS]
    local, geo, cov = model.point_in_local[best], points.position_in_geo[best], points.cov_in_geo[best]
    try:
        result = ransac(
            len(best),
            lambda chosen: umeyama(local[chosen], geo[chosen]),
            lambda similarity: squared_mahalanobis(geo - similarity.apply(local), cov),
            RansacOptions(3, OUTLIER_GATE, max_draws=200),
            rng,
        )
        good = result.inlier
        return umeyama(local[good], geo[good], 1 / trace[best][good])
    except DegenerateGeometryError:
        return None


def _robust_product(
    model: SparseModel, points: GeolocatedPoints, data: Correspondences, alignment: Alignment
) -> InitialSimilarity:
    solution = alignment.solution
    inlier = solution.state.inlier
    return InitialSimilarity(
        geo_from_local=alignment.geo_from_local.to_record(
            "local", "geo", covariance=solution.covariance, pivot=solution.pivot
        ),
        method="robust",
        correspondences=_counts(data.control, points.inlier),
        inliers=_counts(data.control[inlier], _agreeing(model, points, alignment.geo_from_local)),
        gnss_outliers=tuple(name for name, bad in zip(data.name, ~inlier & ~data.control, strict=True) if bad),
        residuals=_residuals(model, points, alignment.geo_from_local, data.part(inlier), solution.residual[inlier]),
        condition_number=solution.condition_number,
        layout=alignment.layout,
        attitude_used=alignment.attitude_used,
        attitude=_attitude(alignment.attitude),
    )


def _attitude(prior: RotationPrior | None) -> AttitudeRecord | None:
    if prior is None:
        return None
    x, y, z, w = quat_xyzw_from_matrix(prior.rotation).tolist()
    first, second, third = (tuple(row) for row in prior.cov_rad2.tolist())
    return AttitudeRecord(quat_xyzw=(x, y, z, w), cov_rad2=(first, second, third))


def _by_paper(model: SparseModel, points: GeolocatedPoints, data: Correspondences) -> InitialSimilarity:
    """Return the paper's similarity (eqs 16–21) of the geolocated points, with equal weights.

    The paper gives no covariance. Here the covariance follows from the scatter of the points, counted as only one
    point for each image, because the points share the errors of the images.

    Raises:
        DegenerateGeometryError: fewer than three points.
    """
    good = points.inlier
    if good.sum() < 3:
        raise DegenerateGeometryError(
            f"--method paper needs 3 geolocated points, there are {good.sum()}: use --method robust"
        )
    local, geo = model.point_in_local[good], points.position_in_geo[good]
    similarity = spread_ratio_similarity(local, geo)
    mapped = similarity.apply(local)
    pivot = mapped.mean(axis=0)
    jacobian = jacobian_at(mapped, pivot)
    normal = np.einsum("nia,nib->ab", jacobian, jacobian)
    variance = float(((geo - mapped) ** 2).mean()) * max(len(local) / len(model.image_name), 1.0)
    size = np.ones(7)
    size[:4] = np.sqrt(((mapped - pivot) ** 2).sum(axis=1).mean())
    return InitialSimilarity(
        geo_from_local=similarity.to_record(
            "local", "geo", covariance=variance * np.linalg.solve(normal, np.eye(7)), pivot=pivot
        ),
        method="paper",
        correspondences=_counts(data.control[:0], good),
        inliers=_counts(data.control[:0], good),
        residuals=_residuals(model, points, similarity, data, data.in_geo - similarity.apply(data.in_local)),
        condition_number=float(np.linalg.cond(normal / np.outer(size, size))),
        layout=layout_of(local),
        attitude_used=points.rotation_source == "recorded",
    )


def _counts(control: np.ndarray, points: np.ndarray) -> dict[str, int]:
    return {"gnss": int((~control).sum()), "gcp": int(control.sum()), "points": int(points.sum())}


def _agreeing(model: SparseModel, points: GeolocatedPoints, similarity: Similarity) -> np.ndarray:
    """Return the mask (N,) of the geolocated points that agree with the similarity within their covariance."""
    good = points.inlier.copy()
    missed = points.position_in_geo[good] - similarity.apply(model.point_in_local[good])
    good[good] = squared_mahalanobis(missed, points.cov_in_geo[good]) <= OUTLIER_GATE
    return good


def _residuals(
    model: SparseModel, points: GeolocatedPoints, similarity: Similarity, data: Correspondences, missed: FloatArray
) -> dict[str, ResidualStats]:
    good = points.inlier
    return {
        "gnss": residual_stats(missed[~data.control]),
        "gcp": residual_stats(missed[data.control]),
        "points": residual_stats(points.position_in_geo[good] - similarity.apply(model.point_in_local[good])),
    }


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


def _warnings(data: Correspondences, solution: AdjustedSimilarity) -> tuple[str, ...]:
    state, warnings = solution.state, []
    if state.fix_bias_in_geo is not None:
        sigma = np.sqrt(np.diag(solution.bias_cov))
        offset = ", ".join(f"{value:+.3f} ± {s:.3f}" for value, s in zip(state.fix_bias_in_geo, sigma, strict=True))
        warnings.append(
            f"all fixes are off the control points by ({offset}) m east, north, up, which σ do not allow: the "
            "control points decide the position. Check the base station, the vertical datum and the antenna offset"
        )
    for kind, what in ((False, "fixes"), (True, "control points")):
        members = data.control == kind
        bad = members & ~state.inlier
        if bad.any():
            far = np.linalg.norm(solution.residual, axis=1)
            named = [f"{data.name[index]} ({far[index]:.2f} m)" for index in np.flatnonzero(bad)]
            more = " …" if len(named) > 8 else ""
            warnings.append(f"{bad.sum()} of {members.sum()} {what} are outliers: {', '.join(named[:8])}{more}")
        if members.any():
            stated = float(np.sqrt(np.median(np.trace(data.cov_in_geo[members], axis1=1, axis2=2)) / 3))
            excess = state.excess_m[int(kind)]
            if excess > _LOUD_EXCESS * stated:
                warnings.append(
                    f"{what} scatter by {np.hypot(excess, stated):.3f} m an axis, their σ is {stated:.3f} m: "
                    "σ is optimistic or the SfM model is bent; the covariance is widened"
                )
    if state.inlier.sum() < 0.5 * len(data):
        warnings.append(f"only {state.inlier.sum()} of {len(data)} positions agree with each other")
    return tuple(warnings)


def _summary(initial: InitialSimilarity, warnings: tuple[str, ...]) -> Summary:
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
        "residuals": {kind: stats.model_dump() for kind, stats in initial.residuals.items()},
    }
    return Summary(
        f"σ of position {position:.3f} m; residuals {', '.join(parts)}", values, warnings, initial.cautions
    )
