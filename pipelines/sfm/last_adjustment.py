"""Last adjustment of a reconstruction: the principal point is free, and image observations are weighted robustly.

COLMAP adjusts by plain least squares. Wrong matches that pass its filter of 4 px give the residuals longer tails
than noise has, and cause larger errors of lens and poses than noise does. This adjustment weights the observations
by Cauchy's kernel. Later computations from the model (`geometry/bundle.py`) assume these weights.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.core.errors import ConvergenceError
from pipelines.core.progress import SILENT, Progress, ProgressTask
from pipelines.core.types import FloatArray
from pipelines.formats.colmap import flatten
from pipelines.geometry.cameras import project_each
from pipelines.robust.kernels import CAUCHY_95
from pipelines.robust.statistics import rayleigh_sigma

log = logging.getLogger(__name__)

_FEWEST_FOR_PRINCIPAL_POINT = 10
_FURTHEST_PRINCIPAL_POINT = 0.05  # of the longer side: beyond, the principal point has absorbed other errors
_ROBUST_ROUNDS = 3
_MOST_STEPS = 100  # of a round
_SETTLED = 0.01  # relative change of the residuals' scale
_LEAST_SCALE_PX = 1e-3  # for observations without noise, which have no tails either
# Least gain of a step, as a fraction of the cost and times the number of observations; a smaller gain ends the
# adjustment. In this unit an error of one σ in one parameter costs 1/2. COLMAP's own tolerance of zero runs to the
# limit of 100 steps.
_LEAST_GAIN = 0.2
_LEAST_GAIN_OF_FEW = 1e-6
_COARSE = 10.0  # factor on the least gain while the scale of the kernel still changes


@dataclass(frozen=True)
class LastAdjustment:
    """Options of the last adjustment.

    Attributes:
        principal_point: free the principal point, if there are ten images or more. The mapper holds it at the
            image's centre.
        threads: of the solver; -1: all cores.
    """

    principal_point: bool = True
    threads: int = -1


def adjust_finally(colmap: Any, model: Any, options: LastAdjustment, progress: Progress = SILENT) -> None:
    """Adjust a `pycolmap.Reconstruction` in place.

    1. The principal point is adjusted with all other parameters. For most lenses it lies a few pixels from the
       image's centre; without it, points move by decimetres when the cameras are aligned with GNSS. Fewer than ten
       images do not determine it. A result far from the image's centre is refused with a warning.
    2. Up to three adjustments with Cauchy's kernel follow. The scale of the kernel comes from the residuals of the
       adjustment before, until that scale converges. No observation is removed: an outlier has nearly no weight.

    Args:
        colmap: the pycolmap module.
        model: the reconstruction; one without points is left as is.
        options: of the adjustment.
        progress: shows the rounds.

    Raises:
        ConvergenceError: COLMAP found no solution.
    """
    if model.num_points3D() == 0:
        return
    free = options.principal_point and model.num_reg_images() >= _FEWEST_FOR_PRINCIPAL_POINT
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    least_gain = min(_LEAST_GAIN / model.compute_num_observations(), _LEAST_GAIN_OF_FEW)
    adjustment.ceres.solver_options.function_tolerance = _COARSE * least_gain
    adjustment.ceres.solver_options.num_threads = options.threads
    adjustment.ceres.solver_options.max_num_iterations = _MOST_STEPS
    with progress.task("last adjustment", _ROBUST_ROUNDS + int(free)) as task:
        if free:
            adjustment.refine_principal_point = _free_principal_point(colmap, model, adjustment)
            task.advance()
        _adjust_robustly(colmap, model, adjustment, least_gain, task)
    model.update_point_3d_errors()


def _adjust(colmap: Any, model: Any, adjustment: Any) -> None:
    bundle = colmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        bundle.add_image(image_id)
    bundle.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = colmap.create_default_bundle_adjuster(adjustment, bundle, model).solve()
    if not summary.is_solution_usable():
        raise ConvergenceError(f"the last bundle adjustment found no solution: {summary.brief_report()}")


def _free_principal_point(colmap: Any, model: Any, adjustment: Any) -> bool:
    """Adjust with the principal point free, and return whether the result was accepted.

    A refused principal point is held where it was, and all other parameters are adjusted anew.
    """
    adjustment.refine_principal_point = True
    before = {key: camera.params.copy() for key, camera in model.cameras.items()}
    _adjust(colmap, model, adjustment)
    astray = [key for key, camera in model.cameras.items() if _has_left_the_middle(camera)]
    if not astray:
        return True
    log.warning("the principal point of camera %d is not determined and stays where it was", astray[0])
    for key, params in before.items():
        model.cameras[key].params = params
    adjustment.refine_principal_point = False
    _adjust(colmap, model, adjustment)
    return False


def _has_left_the_middle(camera: Any) -> bool:
    point = np.asarray(camera.params)[camera.principal_point_idxs()]
    moved = np.linalg.norm(point - [camera.width / 2, camera.height / 2])
    return bool(moved > _FURTHEST_PRINCIPAL_POINT * max(camera.width, camera.height))


def _adjust_robustly(colmap: Any, model: Any, adjustment: Any, least_gain: float, task: ProgressTask) -> None:
    adjustment.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    used_px = np.inf
    for left in reversed(range(_ROBUST_ROUNDS)):
        scale_px = max(rayleigh_sigma(_residual_px(model)), _LEAST_SCALE_PX)
        is_last = left == 0 or abs(scale_px / used_px - 1) < _SETTLED
        if is_last:
            adjustment.ceres.solver_options.function_tolerance = least_gain
        adjustment.ceres.loss_function_scale = CAUCHY_95 * scale_px
        _adjust(colmap, model, adjustment)
        task.advance(1 + left if is_last else 1, note=f"σ {scale_px:.2f} px")
        if is_last:
            return
        used_px = scale_px


def _residual_px(model: Any) -> FloatArray:
    """Return the lengths (M,) of the residuals of all observations in pixels; NaN behind the camera."""
    flat = flatten(model)
    rotation = flat.rotation_cam_from_local[flat.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, flat.point_in_local[flat.obs_point])
    in_cam += flat.translation_cam_from_local[flat.obs_image]
    projected = project_each(flat.cameras, flat.image_camera_id[flat.obs_image], in_cam)
    return np.asarray(np.linalg.norm(projected - flat.obs_xy_px, axis=1))
