"""Adjustments of a reconstruction by COLMAP, after its mapper.

COLMAP adjusts by plain least squares. Wrong matches that pass its filter of 4 px give the residuals longer tails
than noise has, and cause larger errors of lens and poses than noise does. The last adjustment frees the principal
point and weights the observations by Cauchy's kernel. Later computations from the model (`geometry/bundle.py`)
assume these weights.

The errors of neighbouring photographs add up over a large flight: a model bends at hardly any cost, and the steps
of a plain adjustment along such a bend are tiny. An adjustment with the measured positions as priors straightens it
at once. This is a start only. The last adjustment follows, by the photographs alone: otherwise the fixes would
count twice, here and where the model is placed on Earth.

A step costs the square of the tracks' length, summed over the tracks, and all photographs are tied by a tenth of
them. Many observations are therefore adjusted with few tracks first, and begin near their own solution.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import ConvergenceError
from pipelines.core.progress import SILENT, Progress, ProgressTask
from pipelines.core.types import FloatArray, Vector3
from pipelines.formats.colmap import flatten
from pipelines.geometry.cameras import BundleConfig, BundleOptions, ColmapImage, Reconstruction, project_each
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.geometry.statistics import CAUCHY_95, CAUCHY_SCALE2, cauchy_weight, median_chi2, rayleigh_sigma

log = logging.getLogger(__name__)

_FEWEST_FOR_PRINCIPAL_POINT = 10
_FURTHEST_PRINCIPAL_POINT = 0.05  # of the longer side: beyond, the principal point has absorbed other errors
_ROBUST_ROUNDS = 3
_MOST_STEPS = 100  # of a round
_SETTLED_STEPS = 10  # of the last one with all tracks, after the cameras have settled with few
_SETTLED = 0.01  # relative change of the residuals' scale
LEAST_SCALE_PX = 1e-3  # for observations without noise, which have no tails either
# Least gain of a step, as a fraction of the cost and times the number of observations; a smaller gain ends the
# adjustment. In this unit an error of one σ in one parameter costs 1/2. COLMAP's own tolerance of zero runs to the
# limit of 100 steps.
_LEAST_GAIN = 0.2
_LEAST_GAIN_OF_FEW = 1e-6
_COARSE = 10.0  # factor on the least gain while the scale of the kernel still changes
# Observations from which an adjustment begins with few tracks; tracks that then tie each photograph, and that do in
# the end, of a model that a mapper has left with few.
_MANY_OBSERVATIONS = 400_000
_TRACKS_A_PHOTOGRAPH = 400
_TRACKS_KEPT = 2000


def adjust_finally(
    colmap: ModuleType,
    model: Reconstruction,
    *,
    fixes: Mapping[str, Vector3] | None = None,
    complete: Callable[[Reconstruction], None] | None = None,
    principal_point: bool = True,
    lens_held: bool = False,
    threads: int = -1,
    progress: Progress = SILENT,
) -> None:
    """Adjust a `pycolmap.Reconstruction` in place; one without points is left as it is.

    1. With `fixes`, its drift is removed.
    2. The principal point, if it is free, is adjusted with all other parameters. For most lenses it lies a few
       pixels from the image's centre, where the mapper holds it; without it, points move by decimetres when the
       cameras are aligned with GNSS. Fewer than ten images do not determine it. A result far from the image's
       centre is refused with a warning.
    3. Up to three adjustments with Cauchy's kernel follow. The scale of the kernel comes from the residuals of the
       adjustment before, until that scale converges. No observation is removed: an outlier has nearly no weight.

    Of many observations, a model with few tracks takes all steps first. The last one then starts from its cameras,
    with all tracks; of a model that has few tracks only, after `complete` has added the others.

    Raises:
        ConvergenceError: COLMAP found no solution.
    """
    if model.num_points3D() == 0:
        return
    free = principal_point and not lens_held and model.num_reg_images() >= _FEWEST_FOR_PRINCIPAL_POINT
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.refine_focal_length = adjustment.refine_extra_params = not lens_held
    adjustment.ceres.solver_options.num_threads = threads
    adjustment.ceres.solver_options.max_num_iterations = _MOST_STEPS
    many = complete is None and model.compute_num_observations() > _MANY_OBSERVATIONS
    first, twice = model, many or complete is not None
    if many:
        first = type(model)(model)
        keep_few_tracks(first, _TRACKS_A_PHOTOGRAPH)
    if fixes is not None:
        remove_drift(colmap, first, fixes, threads, progress)
    title = "adjustment with few tracks" if twice else "last adjustment"
    with progress.task(title, int(free) + _ROBUST_ROUNDS) as task:
        if free:
            adjustment.ceres.solver_options.function_tolerance = _COARSE * _least_gain(first)
            adjustment.refine_principal_point = _free_principal_point(colmap, first, adjustment)
            task.advance()
        _adjust_robustly(colmap, first, adjustment, task)
    if complete is not None:
        complete(model)
        keep_few_tracks(model, _TRACKS_KEPT)
    elif many:
        _follow(colmap, model, first)
    if twice:
        with progress.task("last adjustment", 1 + _ROBUST_ROUNDS) as task:
            _adjust_points(colmap, model, adjustment)
            task.advance()
            # What more steps would change is weaker than the positions that the model is placed by.
            adjustment.ceres.solver_options.max_num_iterations = _SETTLED_STEPS
            _adjust_robustly(colmap, model, adjustment, task, settled=True)
    model.update_point_3d_errors()


def keep_few_tracks(model: Reconstruction, tracks: int) -> None:
    """Leave a `pycolmap.Reconstruction` with points drawn until each image sees `tracks` of them, or all it has.

    Points are drawn at random, always the same: the longest tracks would lie in one part of the images.
    """
    flat = flatten(model)
    seen = np.zeros(len(flat.image_id), dtype=np.int64)
    bounds = np.searchsorted(flat.obs_point, np.arange(len(flat.point_id) + 1))
    for point in np.random.default_rng(0).permutation(len(flat.point_id)).tolist():
        images = flat.obs_image[bounds[point] : bounds[point + 1]]
        if (seen[images] < tracks).any():
            seen[images] += 1
        else:
            model.delete_point3D(int(flat.point_id[point]))


def _follow(colmap: ModuleType, model: Reconstruction, leader: Reconstruction) -> None:
    """Give a model the cameras of another one of the same images, and its points their place beside these."""
    before, after = (
        np.array([each.images[key].projection_center() for key in sorted(leader.reg_image_ids())])
        for each in (model, leader)
    )
    moved = umeyama(before, after)
    model.transform(colmap.Sim3d(moved.matrix()[:3]))
    for key, camera in leader.cameras.items():
        model.cameras[key].params = camera.params
    for key, rig in leader.rigs.items():
        for sensor, pose in rig.non_ref_sensors.items():
            model.rigs[key].set_sensor_from_rig(sensor, pose)
    for key, frame in leader.frames.items():
        if frame.has_pose():
            model.frames[key].rig_from_world = frame.rig_from_world


def place_points(colmap: ModuleType, model: Reconstruction, threads: int = -1) -> None:
    """Move the points of a `pycolmap.Reconstruction` to where its cameras see them, by robust least squares."""
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.solver_options.num_threads = threads
    adjustment.ceres.solver_options.max_num_iterations = _MOST_STEPS
    adjustment.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = CAUCHY_95 * max(rayleigh_sigma(residual_px(model)), LEAST_SCALE_PX)
    _adjust_points(colmap, model, adjustment)


def _adjust_points(colmap: ModuleType, model: Reconstruction, adjustment: BundleOptions) -> None:
    """Move points to where the cameras see them."""
    points_alone = deepcopy(adjustment)
    points_alone.refine_rig_from_world = points_alone.refine_principal_point = False
    points_alone.refine_focal_length = points_alone.refine_extra_params = False
    points_alone.ceres.solver_options.function_tolerance = _COARSE * _least_gain(model)
    _adjust(colmap, model, points_alone)


def _least_gain(model: Reconstruction) -> float:
    return min(_LEAST_GAIN / int(model.compute_num_observations()), _LEAST_GAIN_OF_FEW)


def _adjust(colmap: ModuleType, model: Reconstruction, adjustment: BundleOptions) -> None:
    bundle = colmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        bundle.add_image(image_id)
    hold_lenses_in_place(bundle, model)
    bundle.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = colmap.create_default_bundle_adjuster(adjustment, bundle, model).solve()
    if not summary.is_solution_usable():
        raise ConvergenceError(
            "bundle-not-converged",
            f"The last bundle adjustment found no solution: {summary.brief_report()}",
        )


def hold_lenses_in_place(bundle: BundleConfig, model: Reconstruction) -> None:
    """Hold the lenses of rigs that are exactly at the place of the reference lens, in an adjustment (`rigs.py`)."""
    for rig in model.rigs.values():
        for sensor, pose in rig.non_ref_sensors.items():
            if pose is not None and not np.any(pose.translation):
                bundle.set_constant_sensor_from_rig_pose(sensor)


def _free_principal_point(colmap: ModuleType, model: Reconstruction, adjustment: BundleOptions) -> bool:
    """Adjust with the principal point free, and return whether the result was accepted.

    A refused principal point is frozen where it was, and all other parameters are adjusted anew.
    """
    adjustment.refine_principal_point = True
    before = {key: camera.params.copy() for key, camera in model.cameras.items()}
    _adjust(colmap, model, adjustment)
    astray = []
    for key, camera in model.cameras.items():
        point = np.asarray(camera.params)[camera.principal_point_idxs()]
        moved = np.linalg.norm(point - [camera.width / 2, camera.height / 2])
        if moved > _FURTHEST_PRINCIPAL_POINT * max(camera.width, camera.height):
            astray.append(key)
    if not astray:
        return True
    log.warning(
        "The principal point of camera %d is not determined, and is frozen.",
        astray[0], extra={"code": "principal-point-not-determined"},
    )  # fmt: skip
    for key, params in before.items():
        model.cameras[key].params = params
    adjustment.refine_principal_point = False
    _adjust(colmap, model, adjustment)
    return False


def _adjust_robustly(
    colmap: ModuleType,
    model: Reconstruction,
    adjustment: BundleOptions,
    task: ProgressTask,
    *,
    settled: bool = False,
) -> None:
    """Adjust until the scale of the kernel is that of the adjustment before; once, if the cameras are settled."""
    adjustment.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    used_px = np.inf
    for rounds_left in reversed(range(_ROBUST_ROUNDS)):
        scale_px = max(rayleigh_sigma(residual_px(model)), LEAST_SCALE_PX)
        is_last = settled or rounds_left == 0 or abs(scale_px / used_px - 1) < _SETTLED
        adjustment.ceres.solver_options.function_tolerance = (1.0 if is_last else _COARSE) * _least_gain(model)
        adjustment.ceres.loss_function_scale = CAUCHY_95 * scale_px
        _adjust(colmap, model, adjustment)
        task.advance(1 + rounds_left if is_last else 1, note=f"σ {scale_px:.2f} px")
        if is_last:
            return
        used_px = scale_px


def residual_px(model: Reconstruction) -> FloatArray:
    """Return the lengths (M,) of the residuals of all observations in pixels; NaN behind the camera."""
    flat = flatten(model)
    rotation = flat.rotation_cam_from_local[flat.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, flat.point_in_local[flat.obs_point])
    in_cam += flat.translation_cam_from_local[flat.obs_image]
    projected = project_each(flat.cameras, flat.image_camera_id[flat.obs_image], in_cam)
    return np.asarray(np.linalg.norm(projected - flat.obs_xy_px, axis=1))


_FEWEST_FIXES = 10
_LEAST_SPREAD = 0.05  # of the longest extent: on a line, positions leave the rotation about it open
_ALIGNMENT_ROUNDS = 20
_ALIGNMENT_GATE = 6.0  # times σ: the limit of an inlier of COLMAP's own alignment
_LEAST_SIGMA = 1e-6  # of the extent, for positions without noise
_MOST_ITERATIONS = 50


def position_adjuster(
    colmap: ModuleType,
    model: Reconstruction,
    positions: Sequence[tuple[ColmapImage, ArrayLike, ArrayLike]],
    *,
    iterations: int,
    gate_m: float,
    threads: int = -1,
    seed: int = 0,
) -> Any:
    """Return COLMAP's adjuster of all cameras and points, with camera positions as priors under Cauchy's kernel.

    Args:
        model: a `pycolmap.Reconstruction`; solving moves it into the frame of the positions.
        positions: a `pycolmap.Image`, its measured centre (3,) in metres, and the covariance (3, 3), of each.
        gate_m: limit of an inlier when COLMAP aligns the model with the positions, before it adjusts.
    """
    bundle = colmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        bundle.add_image(image_id)
    of_images = colmap.BundleAdjustmentOptions()
    of_images.print_summary = False
    of_images.ceres.solver_options.max_num_iterations = iterations
    of_images.ceres.solver_options.num_threads = threads
    of_priors = colmap.PosePriorBundleAdjustmentOptions()
    of_priors.ceres.prior_position_loss_function_type = colmap.LossFunctionType.CAUCHY
    of_priors.ceres.prior_position_loss_scale = math.sqrt(CAUCHY_SCALE2[3])
    of_priors.alignment_ransac.max_error = gate_m
    of_priors.alignment_ransac.random_seed = seed
    priors = [
        colmap.PosePrior(
            corr_data_id=image.data_id,
            position=position,
            position_covariance=covariance,
            coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image, position, covariance in positions
    ]
    return colmap.create_pose_prior_bundle_adjuster(of_images, of_priors, bundle, priors, model)


def remove_drift(
    colmap: ModuleType,
    model: Reconstruction,
    fixes: Mapping[str, Vector3],
    threads: int,
    progress: Progress = SILENT,
) -> float | None:
    """Adjust a `pycolmap.Reconstruction` in place with measured positions as priors.

    All priors have one σ: that of the model's positions against the fixes, after a robust alignment. The fixes' own
    σ are not used, since this is a start only, and a change of σ does not make the model stale.

    The frame of the model becomes `geo`; `fixes` are measured camera centres there by name of the image, metres.

    Returns:
        σ of the positions along one axis in metres; None: too few positions, or on one line, and nothing was done.
    """
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    images = [image for image in images if image.name in fixes]
    position = np.array([fixes[image.name] for image in images]).reshape(-1, 3)
    if len(images) < _FEWEST_FIXES:
        return None
    extent = np.linalg.svd(position - position.mean(0), compute_uv=False)
    if extent[1] < _LEAST_SPREAD * extent[0]:
        return None
    center = np.array([image.projection_center() for image in images])
    sigma_m = max(alignment_with(center, position)[1], _LEAST_SIGMA * float(extent[0]))
    covariance = sigma_m**2 * np.eye(3)
    positions = [(image, place, covariance) for image, place in zip(images, position, strict=True)]
    gate_m = _ALIGNMENT_GATE * sigma_m
    with progress.task("adjustment with positions", 1) as task:
        adjuster = position_adjuster(
            colmap, model, positions, iterations=_MOST_ITERATIONS, gate_m=gate_m, threads=threads
        )
        if not adjuster.solve().is_solution_usable():
            log.warning("The adjustment with the fixes found no solution; the model may have drifted.")
        task.advance(note=f"σ {sigma_m:.2f} m")
    return sigma_m


def alignment_with(center: FloatArray, position: FloatArray) -> tuple[Similarity, float]:
    """Return the robust alignment of camera centres (N, 3) with positions (N, 3), and σ of these along one axis."""
    weights = np.ones(len(center))
    sigma_m = 0.0
    for _ in range(_ALIGNMENT_ROUNDS):
        aligned = umeyama(center, position, weights)
        squared = ((aligned.apply(center) - position) ** 2).sum(1)
        sigma_m = math.sqrt(float(np.median(squared)) / median_chi2(3))
        if sigma_m == 0.0:
            break
        weights = cauchy_weight(squared / sigma_m**2, 3)
    return aligned, sigma_m
