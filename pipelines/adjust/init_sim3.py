"""Stage `init-sim3`: the similarity `geo_from_local` from the SfM model to the Earth.

Reads `ingest/survey.json`, `sfm/sparse`, `geolocate/points.npz`; writes the solution, `sim3/adjustment.json` and
its covariances, `.npz`. The solution names the similarity that it begins with, and how that was found; for other
programs, `sim3/geo_from_local.json` has this alone.
GeoRefGS section 2.4.1, eqs 16–21 (doi 10.3390/drones10030195), is `--method paper`. The default starts from a
robust alignment of camera centres and control points, adjusts similarity, cameras and lens together, and tests the
stated σ. `pipelines.adjust.alignment` explains why the intersected points are no observations.

A survey without a place on Earth gets a local metric frame (`pipelines.adjust.local_frame`).
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipelines.adjust.alignment import (
    OUTLIER_GATE,
    AdjustedSimilarity,
    Alignment,
    Correspondences,
    align,
    covariance_of,
    layout_of,
)
from pipelines.adjust.earlier_date import cautions_of_common, outliers_in_common, start_at_common
from pipelines.adjust.fix_patterns import pattern_of
from pipelines.adjust.inconsistencies import (
    arm_caution,
    cautions_of,
    marks_that_do_not_meet,
    mistake_in_marks,
    unadjustable,
)
from pipelines.adjust.joint import Consistency, Start, adjust_jointly, component_of, in_own_frame
from pipelines.adjust.lens_cautions import focal_length_of, rolling_shutter_of
from pipelines.adjust.level import level_of, levelled
from pipelines.adjust.local_frame import local_similarity
from pipelines.adjust.measurements import (
    UnusedControlPoint,
    attitude_prior,
    control_correspondences,
    fix_correspondences,
    positions_in_use,
    problem_of,
    rejected_of,
    start_of,
)
from pipelines.adjust.options import InitSim3Options
from pipelines.adjust.posterior import Posterior, save_posterior
from pipelines.adjust.solution import adjusted, remarks_of
from pipelines.adjust.system import Linearised, minimise
from pipelines.adjust.terms import ControlPoints, Distances, Fixes
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, InconsistencyError, InputError
from pipelines.core.products import NOT_CHECKED, Remark, save_json, union
from pipelines.core.sentences import listed
from pipelines.core.stages import ADJUSTMENT, POINTS, SIM3, SIM3_POSTERIOR, SPARSE
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.similarity import Similarity, SimilarityRecord, jacobian_at, spread_ratio_similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import ResidualStats, residual_stats, squared_mahalanobis
from pipelines.survey.marks import of_wrong_marks, wrong_marks
from pipelines.survey.navigation import load_survey
from pipelines.survey.scene import SparseScene, initial_scene
from pipelines.survey.solution import GeolocatedPoints, MeasurementVerdict, SimilarityEstimate, Solution
from pipelines.survey.survey import MountParameter, Survey

_DISAGREE = 3.5  # σ by which a distance misses the solution; one in two thousand does by chance
_OF_MOUNT = {
    "boresight": "`georef ingest --boresight` can apply it.",
    "lever-arm": "`georef ingest --lever-arm` can apply it, in the axes of the body.",
}
_LEVEL = 0.01  # of the χ² test of σ where no joint adjustment is possible


def run(stage: StageRun, options: InitSim3Options) -> Summary:
    """Estimate the similarity of the workspace and write it."""
    survey = load_survey(stage.workspace)
    model = read_sparse(stage.workspace.path(SPARSE))
    points = GeolocatedPoints.load(stage.workspace.path(POINTS))
    posterior, warnings = estimate_similarity(survey, model, points, options)
    solution = posterior.solution
    save_json(solution, stage.out / Path(ADJUSTMENT).name)
    save_json(_initial_of(solution), stage.out / Path(SIM3).name)
    save_posterior(posterior, stage.out / Path(SIM3_POSTERIOR).name)
    figure, values = _figures(solution, is_local=survey.origin is None)
    return Summary(figure, values, (*warnings, *_of_mount(solution)), solution.cautions)


def estimate_similarity(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> tuple[Posterior, tuple[Remark, ...]]:
    """Return the solution with its covariances and its `initial` similarity, and warnings for the user.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open; names further measurements.
        InconsistencyError: sources are inconsistent, and the options do not accept that.
        ConvergenceError: the residual is larger than `options.max_residual`.
        InputError: `points` belongs to another model.
    """
    if not np.array_equal(points.point_id, model.point_id):
        raise InputError(
            "points-of-another-model",
            "The intersected points belong to another SfM model.",
            remedy="Run `georef geolocate` again.",
        )
    if not options.control_points:
        survey = survey.model_copy(update={"control_points": ()})
    if options.method == "paper":
        control, unused = control_correspondences(survey, model)
        initial = similarity_by_paper(model, points, fix_correspondences(survey, model).joined(control))
        posterior = solved(survey, model, initial, estimate=survey.unknown_mount)
        warnings = _of_unused(unused)
    elif survey.origin is None:
        posterior, warnings = similarity_by_distances(survey, model, points, options)
    else:
        posterior, warnings = robust_similarity(survey, model, points, options)
    _check_residual(posterior.solution, options.max_residual)
    return posterior, warnings


def _check_residual(solution: Solution, limit_m: float | None) -> None:
    initial = _initial_of(solution)
    kind: Literal["gnss", "gcp"] = "gnss" if initial.residuals["gnss"].count else "gcp"
    stats = initial.residuals[kind]
    if limit_m is None or stats.rmse_3d_m is None or stats.rmse_3d_m <= limit_m:
        return
    what = "camera centres" if kind == "gnss" else "control points"
    raise ConvergenceError(
        "residual-above-limit",
        (
            f"The RMS residual of {stats.count} {what} is {stats.rmse_3d_m:.3f} m (horizontal "
            f"{stats.rmse_h_m:.3f} m, vertical {stats.rmse_v_m:.3f} m), more than {limit_m:g} m."
        ),
        remedy="Look for wrong positions or a bent SfM model, or raise --max-residual.",
    )


def _initial_of(solution: Solution) -> SimilarityEstimate:
    assert solution.initial is not None  # of `solved`
    return solution.initial


def _figures(solution: Solution, *, is_local: bool) -> tuple[str, dict[str, Any]]:
    """Return the key figure and the values of the summary."""
    initial, earlier = _initial_of(solution), solution.earlier
    sigma = np.sqrt(np.maximum(np.diag(np.array(initial.geo_from_local.covariance)), 0.0))
    parts = [
        f"{kind} {stats.rmse_3d_m:.3f} m RMS of {stats.count}"
        for kind, stats in initial.residuals.items()
        if stats.rmse_3d_m is not None and kind != "points"
    ]
    position = float(np.linalg.norm(sigma[4:]))
    figure = f"σ of the georeference alone {position:.3f} m; residuals {', '.join(parts)}"
    figure += "".join(
        f"; {error.name} {error.text}" for error in solution.estimated_errors if error.name in _OF_MOUNT
    )
    if earlier is not None:
        figure += f"; tied to {Path(earlier.workspace).name} by {earlier.used} of {earlier.points} points in common"
    if is_local:
        figure = f"local metric frame, σ of its scale {100 * sigma[0]:.2g} %"
    values: dict[str, Any] = {
        "scale": initial.geo_from_local.scale,
        "sigma_scale": float(sigma[0] * initial.geo_from_local.scale),
        "sigma_rotation_deg": float(np.degrees(sigma[1:4].max())),
        "sigma_position_m": None if is_local else position,
        "layout": initial.layout,
        "attitude_used": initial.attitude_used,
        "condition_number": initial.condition_number,
        "inliers": initial.inliers,
        "earlier": None if earlier is None else earlier.model_dump(),
        "estimated_errors": [error.model_dump() for error in solution.estimated_errors],
        "gnss_outliers": list(solution.gnss_outliers),
        "variance_factors": [factor.model_dump() for factor in solution.variance_factors],
        "residuals": {kind: stats.model_dump() for kind, stats in initial.residuals.items()},
    }
    return figure, values


def robust_similarity(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> tuple[Posterior, tuple[Remark, ...]]:
    """Return the solution by the robust method; raises as `estimate_similarity`."""
    control, unused = control_correspondences(survey, model)
    mistake = mistake_in_marks(survey, model) if unused else None
    if mistake is not None:  # What meets all the same meets in a wrong place.
        control = control.part(np.zeros(len(control), dtype=bool))
    of_marks = marks_that_do_not_meet(unused, mistake)
    data = fix_correspondences(survey, model).joined(control)
    try:
        alignment = align(data, np.random.default_rng(options.seed), attitude=attitude_prior(survey, model))
    except DegenerateGeometryError as error:
        _refuse(unadjustable(survey, model, None), options)
        reasons = [positions_in_use(survey, model, data, unused), *(caution.sentence for caution in of_marks)]
        raise DegenerateGeometryError(error.code, " ".join((error.fault, *reasons)), remedy=error.remedy) from error
    aligned, inlier = _aligned_product(model, points, data, alignment), alignment.solution.state.inlier
    verdict = MeasurementVerdict(
        gnss_outliers=tuple(name for name, bad in zip(data.name, ~inlier & ~data.control, strict=True) if bad),
        control_outliers=tuple(p.name for p in survey.control_points if p.name not in control.name),
    )
    warnings = () if mistake else _of_unused(unused)  # else the caution says why
    warnings += of_wrong_marks(wrong_marks(survey.control_points, model))
    meeting = tuple(point for point in survey.control_points if point.name in control.name)
    meets = survey.model_copy(update={"control_points": meeting})
    pattern = pattern_of(meets, model)
    of_arm: tuple[Remark, ...] = ()
    mount = survey.unknown_mount
    if pattern is not None and pattern.has_arm and "lever-arm" not in mount:
        mount, of_arm = (*mount, "lever-arm"), (arm_caution(pattern),)
    try:
        starts = (
            *start_at_common(meets, model, aligned),
            *_levelled_start(survey, model, data, aligned),
            *_starts(data, aligned, options.seed),
        )
        scene, near, consistency = adjust_jointly(meets, model, starts, estimate=mount)
    except DegenerateGeometryError as error:
        inconsistencies = unadjustable(meets, model, alignment.geo_from_local, pattern)
        _refuse(inconsistencies, options)
        unchecked = Remark(
            code=NOT_CHECKED, sentence=f"Nothing checks the stated σ. {error.fault}", remedy=error.remedy
        )
        cautions = union(survey.cautions, inconsistencies, of_marks, of_arm, (unchecked,))
        initial = _without_joint(aligned, alignment.solution)
        verdict = verdict.model_copy(update={"cautions": cautions})
        return solved(survey, model, initial, verdict, estimate=mount), warnings
    motion, of_lens = near.problem.bundle.row_motion, focal_length_of(survey, model)
    inconsistencies, limits = cautions_of(meets, scene, near, consistency, pattern, bent=bool(of_lens))
    scale = scene.geo_from_local(near.state.geo_from_model).scale
    of_lens += rolling_shutter_of(survey, model, scale, motion)
    _refuse(inconsistencies, options)
    initial, verdict, more = _joint_product(points, (aligned, verdict), scene, near, consistency)
    of_earlier = cautions_of_common(survey, near, consistency)
    cautions = union(survey.cautions, inconsistencies, of_marks, of_arm, of_lens, limits, of_earlier)
    codes = {caution.code for caution in cautions}
    verdict = verdict.model_copy(update={"cautions": cautions})
    posterior = solved(survey, model, initial, verdict, estimate=mount, joint=(scene, near))
    return posterior, warnings + tuple(one for one in more if one.code not in codes)


def similarity_by_distances(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> tuple[Posterior, tuple[Remark, ...]]:
    """Return the solution in a local metric frame, whose scale known distances set.

    Raises:
        DegenerateGeometryError: no distance sets the scale, or the photographs have no upward direction in common.
    """
    start, level = local_similarity(survey, model, options.up)
    scene, near, consistency = adjust_jointly(survey, model, (Start(start),), estimate=survey.unknown_mount)
    before = start, MeasurementVerdict(cautions=union(survey.cautions, (level,)))
    initial, verdict, warnings = _joint_product(points, before, scene, near, consistency)
    return solved(survey, model, initial, verdict, estimate=survey.unknown_mount, joint=(scene, near)), warnings


def solved(
    survey: Survey,
    model: SparseModel,
    initial: SimilarityEstimate,
    verdict: MeasurementVerdict | None = None,
    *,
    estimate: tuple[MountParameter, ...] = (),
    joint: tuple[SparseScene, Linearised] | None = None,
) -> Posterior:
    """Return the solution of a joint adjustment without the measurements that it has rejected.

    Without a joint adjustment, the cameras of SfM stay as they are at the similarity, with the covariance that the
    measurements give there. Without a verdict, all measurements are used.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
    """
    verdict = MeasurementVerdict() if verdict is None else verdict
    survey, with_attitudes = verdict.weighted(survey), initial.layout == "line"
    if joint is None:
        scene = initial_scene(model, survey, initial)
    else:
        before, near = joint
        scene, start = in_own_frame(before, near.state, survey, initial)
    problem = problem_of(scene, verdict.in_use(survey), estimate=estimate, with_attitudes=with_attitudes)
    if joint is None:
        state = start_of(scene, problem)
    else:
        state = minimise(problem, problem.start_at(start, near.problem.errors)).state
    posterior = adjusted(scene, problem, state, verdict, rejected_of(scene, survey, verdict))
    solution = posterior.solution
    if joint is not None:
        initial = initial.model_copy(update={"geo_from_local": solution.similarity_from_local()})
    return replace(posterior, solution=solution.model_copy(update={"initial": initial}))


def _of_mount(solution: Solution) -> Iterator[Remark]:
    """Yield what is to be said of boresight and lever arm, unless a caution has said it."""
    said = {caution.code for caution in solution.cautions}
    for error in solution.estimated_errors:
        if error.name in _OF_MOUNT and error.name not in said:
            yield from remarks_of(error, _OF_MOUNT[error.name])


def _refuse(inconsistencies: tuple[Remark, ...], options: InitSim3Options) -> None:
    if inconsistencies and not options.accept_inconsistency:
        raise InconsistencyError(
            inconsistencies[0].code,
            " ".join(caution.sentence for caution in inconsistencies),
            remedy=" ".join(
                (
                    *filter(None, (caution.remedy for caution in inconsistencies)),
                    "Correct the input, or go on with larger σ: --accept-inconsistency.",
                )
            ),
        )


def _aligned_product(
    model: SparseModel, points: GeolocatedPoints, data: Correspondences, alignment: Alignment
) -> SimilarityEstimate:
    solution, similarity = alignment.solution, alignment.geo_from_local
    inlier = solution.state.inlier
    agreeing = agreeing_points(model, points, similarity)
    return SimilarityEstimate(
        geo_from_local=_record_of(solution),
        method="robust",
        correspondences=counts_of(data.control, points.inlier),
        inliers=counts_of(data.control[inlier], agreeing),
        residuals={
            **residuals_of(data.part(inlier), solution.residual[inlier]),
            "points": residuals_of_points(model, points, similarity),
        },
        condition_number=solution.condition_number,
        layout=alignment.layout,
        attitude_used=alignment.layout == "line",
    )


def _levelled_start(
    survey: Survey, model: SparseModel, data: Correspondences, aligned: SimilarityEstimate
) -> Iterator[Start]:
    """Yield the start that the photographs level, where the fixes may drift and so tilt the survey."""
    if aligned.layout == "line" or not survey.drifts:
        return
    level, fixes = level_of(survey, model, attitude_prior(survey, model)), data.part(~data.control)
    if level is None or len(fixes) < 3:
        return
    with suppress(DegenerateGeometryError):
        similarity = levelled(level, fixes.in_local, fixes.in_geo)
        yield Start(aligned.model_copy(update={"geo_from_local": similarity.to_record("local", "geo")}))


def _starts(data: Correspondences, aligned: SimilarityEstimate, seed: int) -> Iterator[Start]:
    """Yield the alignment, then, if they are needed, those of the fixes and of the control points alone."""
    yield Start(aligned)
    if data.control.any():
        yield Start(aligned, at_control=True)
    for members in (~data.control, data.control):
        if not 3 <= members.sum() < len(data):
            continue
        try:
            solution = align(data.part(members), np.random.default_rng(seed)).solution
        except DegenerateGeometryError:
            continue
        alone = aligned.model_copy(update={"geo_from_local": _record_of(solution), "layout": "volume"})
        yield Start(alone, at_control=bool(data.control[members].all()))


def _record_of(solution: AdjustedSimilarity) -> SimilarityRecord:
    similarity = solution.state.geo_from_local
    return similarity.to_record("local", "geo", covariance=solution.covariance, pivot=solution.pivot)


def _without_joint(aligned: SimilarityEstimate, solution: AdjustedSimilarity) -> SimilarityEstimate:
    """Return the alignment with σ widened by what its few residuals show."""
    count = len(solution.squared)
    free = 3.0 - 7.0 / count
    component = component_of(solution.squared, np.full(count, free), 3)
    factor = component.cautious_factor if component.probability() < _LEVEL else 1.0
    record = aligned.geo_from_local
    covariance = tuple(tuple(max(factor, 1.0) * value for value in row) for row in record.covariance)
    return aligned.model_copy(update={"geo_from_local": record.model_copy(update={"covariance": covariance})})


def _of_unused(unused: tuple[UnusedControlPoint, ...]) -> tuple[Remark, ...]:
    return tuple(Remark(code="control-point-unused", sentence=point.sentence) for point in unused)


def _joint_product(
    points: GeolocatedPoints,
    before: tuple[SimilarityEstimate, MeasurementVerdict],
    scene: SparseScene,
    near: Linearised,
    consistency: Consistency,
) -> tuple[SimilarityEstimate, MeasurementVerdict, tuple[Remark, ...]]:
    """Return similarity and verdict of the joint adjustment from those `before` it, and warnings of outliers."""
    aligned, verdict = before
    model, similarity = scene.sparse, scene.geo_from_local(near.state.geo_from_model)
    inliers = aligned.inliers | {"points": int(agreeing_points(model, points, similarity).sum())}
    residuals = aligned.residuals | {"points": residuals_of_points(model, points, similarity)}
    rejected: dict[str, tuple[str, ...]] = {"gnss": verdict.gnss_outliers, "gcp": ()}
    warnings = []
    groups = (("gnss", Fixes.kind, "fix-outliers"), ("gcp", ControlPoints.kind, "control-outliers"))
    for kind, group, code in groups:
        names, missed, used = consistency.missed(near, group)
        if not names:
            continue
        residuals[kind], inliers[kind] = residual_stats(missed[used]), int(used.sum())
        bad = [(name, miss) for name, miss, good in zip(names, missed, used, strict=True) if not good]
        if bad:
            sizes = [f"{name} ({np.linalg.norm(miss):.2f} m)" for name, miss in bad]
            sentence = f"{len(bad)} of {len(names)} {group} are outliers, and are not used: {listed(sizes)}."
            warnings.append(Remark(code=code, sentence=sentence))
        rejected[kind] = tuple(name for name, _ in bad)
    names, missed, used = consistency.missed(near, Distances.kind)
    sizes = [f"{name} ({float(miss[0]):+.3f} m)" for name, miss in zip(names, missed, strict=True)]
    wrong = [size for size, good in zip(sizes, used, strict=True) if not good]
    if wrong:
        sentence = (
            f"{len(wrong)} of {len(names)} distances disagree with the others, and are not used: {listed(wrong)}."
        )
        warnings.append(Remark(code="distance-outliers", sentence=sentence))
    elif names and np.abs(near.problem.residuals(near.state)[Distances.kind]).max() > _DISAGREE:
        sentence = f"Distances miss each other or the positions by more than their σ: {listed(sizes)}."
        warnings.append(Remark(code="distances-disagree", sentence=sentence))
    pivot = np.array(aligned.geo_from_local.pivot)
    record = similarity.to_record("local", "geo", pivot=pivot)
    initial = aligned.model_copy(update={"geo_from_local": record, "inliers": inliers, "residuals": residuals})
    verdict = verdict.model_copy(
        update={
            "gnss_outliers": rejected["gnss"],
            "control_outliers": verdict.control_outliers + rejected["gcp"],
            "distance_outliers": tuple(name for name, good in zip(names, used, strict=True) if not good),
            "variance_factors": tuple(consistency.factors.values()),
            "tied": near.problem.earlier is not None,
            "common_outliers": outliers_in_common(near, consistency),
        }
    )
    return initial, verdict, tuple(warnings)


def similarity_by_paper(model: SparseModel, points: GeolocatedPoints, data: Correspondences) -> SimilarityEstimate:
    """Return the paper's similarity (eqs 16–21) of the intersected points, with equal weights.

    The paper gives no covariance. Here the covariance follows from the scatter of the points, counted as only one
    point for each image, because the points share the errors of the images.

    Raises:
        DegenerateGeometryError: fewer than three points.
    """
    good = points.inlier
    if good.sum() < 3:
        raise DegenerateGeometryError(
            "too-few-intersected-points",
            f"--method paper needs at least three intersected points; there are {good.sum()}.",
            remedy="Use --method robust.",
        )
    local, geo = model.point_in_local[good], points.position_in_geo[good]
    similarity = spread_ratio_similarity(local, geo)
    mapped = similarity.apply(local)
    pivot = mapped.mean(axis=0)
    variance = float(((geo - mapped) ** 2).mean()) * max(len(local) / len(model.image_name), 1.0)
    unit = np.ones(7)
    unit[:4] = ((mapped - pivot) ** 2).sum(axis=1).mean() ** -0.5
    covariance = covariance_of(jacobian_at(mapped, pivot).reshape(-1, 7), unit)
    return SimilarityEstimate(
        geo_from_local=similarity.to_record("local", "geo", covariance=variance * covariance, pivot=pivot),
        method="paper",
        correspondences=counts_of(data.control[:0], good),
        inliers=counts_of(data.control[:0], good),
        residuals={
            **residuals_of(data, data.in_geo - similarity.apply(data.in_local)),
            "points": residuals_of_points(model, points, similarity),
        },
        condition_number=float(np.linalg.cond(covariance / np.outer(unit, unit))),
        layout=layout_of(local),
        attitude_used=points.rotation_source == "recorded",
    )


def counts_of(control: BoolArray, points: BoolArray) -> dict[str, int]:
    """Return the numbers of camera centres and control points, from the mask of the latter, and of points."""
    return {"gnss": int((~control).sum()), "gcp": int(control.sum()), "points": int(points.sum())}


def agreeing_points(model: SparseModel, points: GeolocatedPoints, similarity: Similarity) -> BoolArray:
    """Return the mask (N,) of the intersected points that agree with a similarity within their covariance."""
    good = points.inlier.copy()
    missed = points.position_in_geo[good] - similarity.apply(model.point_in_local[good])
    good[good] = squared_mahalanobis(missed, points.cov_in_geo[good]) <= OUTLIER_GATE
    return np.asarray(good)


def residuals_of_points(model: SparseModel, points: GeolocatedPoints, similarity: Similarity) -> ResidualStats:
    """Return the statistics of the inliers among located points, minus the SfM points in `geo`, in metres."""
    good = points.inlier
    return residual_stats(points.position_in_geo[good] - similarity.apply(model.point_in_local[good]))


def residuals_of(data: Correspondences, missed: FloatArray) -> dict[str, ResidualStats]:
    """Return the figures of residuals (n, 3) of camera centres and control points."""
    return {"gnss": residual_stats(missed[~data.control]), "gcp": residual_stats(missed[data.control])}
