"""Stage `geolocate`: forward intersection of every SfM point from the observed positions and attitudes.

Reads `ingest/survey.json` and `sfm/sparse`; writes `geolocate/points.npz` (`GeolocatedPoints`) and `points.ply`.
GeoRefGS section 2.3, eqs 4–15 (doi 10.3390/drones10030195). Control and check points are not used.

Fixes that disagree with the layout of the cameras in the SfM model give no rays. The layout of all cameras reveals
a bad fix. The few rays of one point do not tell a bad fix from good ones.
"""

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.adjust.alignment import Alignment, Correspondences, RotationPrior, align, turn_against
from pipelines.adjust.level import kept_level, level_of
from pipelines.adjust.measurements import RecordedRotations, attitude_prior, fix_correspondences, recorded_rotations
from pipelines.adjust.options import GeolocateOptions
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import Remark, save_npz
from pipelines.core.sentences import listed
from pipelines.core.stages import SPARSE
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.cloud_ply import write_point_ply
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import undistort
from pipelines.geometry.intersection import CommonRotation, Intersections, Rays, UncertainCameras, intersect_rays
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

_LARGEST_RELATIVE_SIGMA = 0.3  # of the distance: beyond, the linear covariance is invalid
_MOST = 0.5  # of the points: fewer are a warning
_ALIGNMENT_SEED = 0


@dataclass(frozen=True)
class Geolocation:
    """Result of `geolocate`; sigma_m (N,) is along the worst axis in metres, NaN without a position."""

    points: GeolocatedPoints
    sigma_m: FloatArray
    key_figure: str
    warnings: tuple[Remark, ...]


def run(stage: StageRun, options: GeolocateOptions) -> Summary:
    """Intersect the points of the workspace's model and write them."""
    survey = load_survey(stage.workspace)
    model = read_sparse(stage.workspace.path(SPARSE))
    intersected = geolocate(survey, model, options)
    points, cloud = intersected.points, stage.out / "points.ply"
    save_npz(stage.out / "points.npz", vars(points))
    write_point_ply(cloud, points.position_in_geo, model.point_rgb, intersected.sigma_m, points.inlier)
    return Summary(intersected.key_figure, _values(points), intersected.warnings)


def geolocate(survey: Survey, model: SparseModel, options: GeolocateOptions) -> Geolocation:
    """Return the points of a model in `geo`, by forward intersection.

    Without fixes, or without any rotations, the points have no positions, so that control points alone can
    georeference the survey.

    Raises:
        InputError: the options demand `recorded` attitudes, and fewer than two images have a fix and an attitude.
    """
    fixes, index = fix_correspondences(survey, model), model.image_index()
    if survey.origin is None:
        figure = "nothing to do: the survey has a local frame, without a place on Earth"
        return replace(_without_positions(model, figure), warnings=())
    if len(fixes) == 0:
        return _without_positions(model, "The survey has no fixes: control points alone georeference the model.")
    prior, recorded = attitude_prior(survey, model), recorded_rotations(survey, model)
    alignment, problem, remedy = None, "", ""
    try:
        alignment = align(fixes, np.random.default_rng(_ALIGNMENT_SEED), attitude=prior)
        if alignment.layout != "line" and survey.drifts:
            alignment = kept_level(alignment, level_of(survey, model, prior), fixes)
    except DegenerateGeometryError as error:
        problem, remedy = error.fault, error.remedy
        log.info("fixes cannot be compared with the SfM model: %s", error)
    fixed = np.array([index[name] for name in fixes.name])
    both = int(np.isin(fixed, recorded.image).sum())
    if options.attitude == "recorded" and both < 2:
        raise InputError(
            "too-few-attitudes",
            f"{both} images have a fix and an attitude; at least two are needed.",
            field="--attitude",
            remedy="Use --attitude auto or sfm.",
        )
    complete = both == len(fixes) or (alignment is None and both >= 2)
    use_recorded = options.attitude == "recorded" or (options.attitude == "auto" and complete)
    if alignment is None and not use_recorded:
        # Control points may georeference the model nevertheless, or `init-sim3` finds the error of the fixes.
        return _without_positions(model, f"The SfM points were not intersected. {problem}", remedy)
    warnings = _warnings(model, fixes, recorded, alignment, prior if use_recorded else None)
    used = recorded if use_recorded else None
    views, usable = _views(model, fixes, fixed, alignment, used, sigma_px=options.sigma_px)
    rays = _rays(model, usable)
    intersections = intersect_rays(rays, views, len(model.point_id))
    sigma, inlier = _judge(intersections, rays, views, options)
    if inlier.sum() < _MOST * len(inlier):
        warnings.append(_few_points(inlier, intersections.consistent))
    middle = f", median σ {np.median(sigma[inlier]):.3g} m" if inlier.any() else ""
    source = "recorded" if use_recorded else "sfm"
    figure = f"{inlier.sum()} of {len(inlier)} points{middle} ({source} rotations)"
    return Geolocation(_points(model, intersections, inlier, source), sigma, figure, tuple(warnings))


def _few_points(inlier: BoolArray, consistent: BoolArray) -> Remark:
    """Return the warning that few of the points are located: their rays disagree, or leave them open."""
    if consistent.sum() < _MOST * len(inlier):
        return Remark(
            code="few-points-agree",
            sentence=f"The rays of only {consistent.sum()} of {len(inlier)} points meet within their σ.",
            remedy="Check the attitudes, and the σ of fixes and attitudes (--sigma-h, --sigma-v, --sigma-attitude "
            "of `georef ingest`).",
        )
    return Remark(
        code="few-points-located",
        sentence=f"The rays of {consistent.sum()} of {len(inlier)} points meet within their σ, but only "
        f"{inlier.sum()} points are known to {100 * _LARGEST_RELATIVE_SIGMA:.0f} % of their distance: the σ of the "
        "positions or of the attitudes leave the others open.",
    )


def _without_positions(model: SparseModel, why: str, remedy: str = "") -> Geolocation:
    count = len(model.point_id)
    points = _points(model, Intersections.none(count), np.zeros(count, dtype=bool), "sfm")
    warning = Remark(code="points-not-located", sentence=why, remedy=remedy)
    return Geolocation(points, np.full(count, np.nan), why, (warning,))


def _points(model: SparseModel, intersections: Intersections, inlier: BoolArray, source: str) -> GeolocatedPoints:
    return GeolocatedPoints(
        point_id=model.point_id,
        position_in_geo=intersections.position_in_geo,
        cov_in_geo=intersections.cov_in_geo,
        ray_count=intersections.ray_count,
        max_angle_deg=intersections.max_angle_deg,
        condition=intersections.condition,
        inlier=inlier,
        rotation_source=source,
    )


def _warnings(
    model: SparseModel,
    fixes: Correspondences,
    recorded: RecordedRotations,
    alignment: Alignment | None,
    prior: RotationPrior | None,
) -> list[Remark]:
    """Return warnings of unused measurements, and of a `prior` turned against an alignment made without it."""
    warnings, turned, total = [], recorded.inconsistent, len(model.image_name)
    if turned:
        sentence = (
            f"{len(turned)} attitudes disagree with the SfM model and with the others, and are not used: "
            f"{listed(sorted(turned))}."
        )
        warnings.append(Remark(code="attitudes-inconsistent", sentence=sentence))
    if len(fixes) < total:
        sentence = f"{total - len(fixes)} of {total} registered images have no fix, and give no rays."
        warnings.append(Remark(code="photographs-without-fix", sentence=sentence))
    if alignment is None:
        return warnings
    rejected = [name for name, good in zip(fixes.name, alignment.solution.state.inlier, strict=True) if not good]
    if rejected:
        sentence = (
            f"{len(rejected)} of {len(fixes)} fixes disagree with the SfM model, and give no rays: "
            f"{listed(sorted(rejected))}."
        )
        warnings.append(Remark(code="fixes-inconsistent", sentence=sentence))
    if prior is not None and alignment.layout != "line":
        turn = turn_against(prior, alignment.geo_from_local)
        sigma = np.hypot(np.sqrt(prior.cov_rad2[0, 0]), alignment.solution.rotation_sigma_rad)
        if turn > 4 * sigma:
            sentence = (
                f"The recorded attitudes are turned by {np.degrees(turn):.1f}° against the fixes, with a σ of "
                f"{np.degrees(sigma):.1f}°. Check boresight and compass, and times and axes of the positions."
            )
            warnings.append(Remark(code="attitudes-turned", sentence=sentence))
    return warnings


def _views(
    model: SparseModel,
    fixes: Correspondences,
    fixed: IntArray,
    alignment: Alignment | None,
    recorded: RecordedRotations | None,
    *,
    sigma_px: float,
) -> tuple[UncertainCameras, BoolArray]:
    """Return all images as views, and the mask (n,) of those that give rays; the others are placeholders.

    Rotations are the recorded ones, or without these those of the alignment. `fixed` are the images of the fixes.
    """
    count = len(model.image_name)
    center, cov = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    center[fixed], cov[fixed] = fixes.in_geo, fixes.cov_in_geo
    usable = np.zeros(count, dtype=bool)
    usable[fixed] = True if alignment is None else alignment.solution.state.inlier
    sigma_ray = sigma_px / model.focal_px
    rotation, sigma, common = np.tile(np.eye(3), (count, 1, 1)), np.ones(count), None
    if recorded is not None:
        rotation[recorded.image], sigma[recorded.image] = recorded.geo_from_cam, recorded.sigma_rad
        usable &= np.isin(np.arange(count), recorded.image)
    elif alignment is not None:
        rotation = alignment.geo_from_local.rotation @ np.swapaxes(model.rotation_cam_from_local, 1, 2)
        # Bundle adjustment has averaged the pixel errors of a whole image: rotations in the model have this σ.
        sigma = sigma_ray / np.sqrt(np.maximum(np.bincount(model.obs_image, minlength=count), 1))
        gain = np.zeros((count, 3, 3))
        gain[fixed] = alignment.solution.response[:, 1:4]
        common = CommonRotation(alignment.solution.covariance[1:4, 1:4], gain)
    return UncertainCameras(center, rotation, cov, sigma, sigma_ray, common), usable


def _rays(model: SparseModel, usable: BoolArray) -> Rays:
    """Return the rays of the usable images.

    A point that an image shows twice counts once, because both rays have the same errors of position and attitude.
    """
    xy = np.empty_like(model.obs_xy_px)
    camera_id = model.image_camera_id[model.obs_image]
    for camera in np.unique(camera_id):
        mine = camera_id == camera
        xy[mine] = undistort(model.cameras[int(camera)], model.obs_xy_px[mine])
    again = np.zeros(len(xy), dtype=bool)
    again[1:] = (np.diff(model.obs_point) == 0) & (np.diff(model.obs_image) == 0)
    # NaN: the lens model maps no ray to this pixel.
    keep = usable[model.obs_image] & np.isfinite(xy).all(axis=1) & ~again
    return Rays(model.obs_point[keep], model.obs_image[keep], xy[keep])


def _judge(
    intersections: Intersections, rays: Rays, views: UncertainCameras, options: GeolocateOptions
) -> tuple[FloatArray, BoolArray]:
    """Return the σ (N,) along the worst axis in metres, and the mask (N,) of the inliers."""
    located: BoolArray = ~np.isnan(intersections.position_in_geo[:, 0])
    sigma = np.full(len(located), np.nan)
    sigma[located] = np.sqrt(np.linalg.eigvalsh(intersections.cov_in_geo[located])[:, 2])
    away = np.linalg.norm(intersections.position_in_geo[rays.point] - views.center_in_geo[rays.view], axis=1)
    count = np.bincount(rays.point, minlength=len(located))
    distance = np.bincount(rays.point, away, minlength=len(located)) / np.maximum(count, 1)
    limit = _LARGEST_RELATIVE_SIGMA * distance
    if options.max_sigma is not None:
        limit = np.minimum(limit, options.max_sigma)
    wide = intersections.max_angle_deg >= options.min_angle
    return sigma, intersections.consistent & wide & (np.nan_to_num(sigma, nan=np.inf) <= limit)


def _values(points: GeolocatedPoints) -> dict[str, Any]:
    good = points.inlier
    values: dict[str, Any] = {"points": len(good), "inliers": int(good.sum())}
    values["rotation_source"] = points.rotation_source
    if good.any():
        axes = np.sqrt(np.diagonal(points.cov_in_geo[good], axis1=1, axis2=2))
        values |= {
            "median_sigma_h_m": float(np.median(np.hypot(axes[:, 0], axes[:, 1]))),
            "median_sigma_v_m": float(np.median(axes[:, 2])),
            "mean_rays": float(points.ray_count[good].mean()),
        }
    return values
