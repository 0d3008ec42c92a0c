"""Stage `init-sim3`: the similarity `geo_from_local` from the SfM model to the Earth.

Reads `ingest/survey.json`, `sfm/sparse`, `geolocate/points.npz`; writes `sim3/geo_from_local.json`.
GeoRefGS section 2.4.1, eqs 16–21 (doi 10.3390/drones10030195), is `--method paper`. The default is a robust
adjustment over camera centres and control points. Its starts come from these and from the geolocated points.
`pipelines.georef.alignment` explains why the geolocated points are no observations.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Literal

import numpy as np

from pipelines.core.cautions import Caution
from pipelines.core.errors import ContradictionError, ConvergenceError, DegenerateGeometryError, InputError
from pipelines.core.products import save_json
from pipelines.core.stages import POINTS, SPARSE
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity, jacobian_at, spread_ratio_similarity, umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.georef.adjustment import OUTLIER_GATE, Correspondences, RotationPrior
from pipelines.georef.alignment import Alignment, align, layout_of
from pipelines.georef.posterior import solution_covariances
from pipelines.georef.terms import ControlTerm, FixTerm
from pipelines.init_sim3.contradictions import judge
from pipelines.init_sim3.joint import JointAdjustment, adjust_jointly
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
        initial, more = _adjusted(survey, model, points, initial, _starts(data, initial, options.seed), options)
        warnings += more
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


def _starts(data: Correspondences, initial: InitialSimilarity, seed: int) -> tuple[InitialSimilarity, ...]:
    """Return the initial similarity, and those of the fixes and of the control points alone, where they differ."""
    starts = [initial]
    for members in (~data.control, data.control):
        if 3 <= members.sum() < len(data):
            with suppress(DegenerateGeometryError):
                solution = align(data.part(members), np.random.default_rng(seed)).solution
                record = solution.state.geo_from_local.to_record(
                    "local", "geo", covariance=solution.covariance, pivot=solution.pivot
                )
                starts.append(initial.model_copy(update={"geo_from_local": record, "layout": "volume"}))
    return tuple(starts)


def _adjusted(
    survey: Survey,
    model: SparseModel,
    points: GeolocatedPoints,
    initial: InitialSimilarity,
    starts: tuple[InitialSimilarity, ...],
    options: InitSim3Options,
) -> tuple[InitialSimilarity, tuple[str, ...]]:
    """Return the result of the joint adjustment with its cautions, and warnings of outliers.

    Raises:
        ContradictionError: sources contradict each other, and the options do not accept that.
    """
    try:
        joint = adjust_jointly(survey, model, starts)
    except DegenerateGeometryError as error:
        sentence = f"nothing checks the stated σ: {error}"
        return initial.model_copy(
            update={"cautions": (*survey.cautions, Caution(code="not-checked", sentence=sentence))}
        ), ()
    verdict = judge(survey, model, joint)
    if verdict.contradictions and not options.accept_contradiction:
        raise ContradictionError(
            "; ".join(caution.sentence for caution in verdict.contradictions)
            + ". Correct what is wrong, or accept it with --accept-contradiction, which widens every σ"
        )
    cautions = (*survey.cautions, *verdict.contradictions, *verdict.cautions)
    return _joint_product(model, points, initial, joint, cautions)


def _joint_product(
    model: SparseModel,
    points: GeolocatedPoints,
    initial: InitialSimilarity,
    joint: JointAdjustment,
    cautions: tuple[Caution, ...],
) -> tuple[InitialSimilarity, tuple[str, ...]]:
    similarity, residuals, warnings = joint.geo_from_local, dict(initial.residuals), []
    inliers = initial.inliers | {"points": int(_agreeing(model, points, similarity).sum())}
    outliers: tuple[str, ...] = ()
    for kind, term, what in (("gnss", FixTerm, "fixes"), ("gcp", ControlTerm, "control points")):
        names, missed, used = joint.residuals(term)
        if not len(names):
            continue
        residuals[kind], inliers[kind] = residual_stats(missed[used]), int(used.sum())
        bad = [(name, miss) for name, miss, good in zip(names, missed, used, strict=True) if not good]
        if bad:
            listed = ", ".join(f"{name} ({np.linalg.norm(miss):.2f} m)" for name, miss in bad[:8])
            warnings.append(
                f"{len(bad)} of {len(names)} {what} are outliers: {listed}{' …' if len(bad) > 8 else ''}"
            )
        if kind == "gnss":
            outliers = tuple(name for name, _ in bad)
    good = points.inlier
    residuals["points"] = residual_stats(
        points.position_in_geo[good] - similarity.apply(model.point_in_local[good])
    )
    covariance = solution_covariances(joint.problem)[0]
    record = similarity.to_record(
        "local", "geo", covariance=covariance, pivot=joint.problem.similarity.pivot_in_geo
    )
    return initial.model_copy(
        update={
            "geo_from_local": record,
            "inliers": inliers,
            "gnss_outliers": outliers,
            "residuals": residuals,
            "variance_factors": joint.factors,
            "cautions": cautions,
        }
    ), tuple(warnings)


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
