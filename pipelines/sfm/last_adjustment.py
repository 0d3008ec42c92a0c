"""The adjustment that ends a reconstruction: the principal point free, image observations weighted robustly.

COLMAP adjusts by plain least squares. What its filter of 4 px leaves of wrong matches gives the residuals longer
tails than noise has, and pulls lens and poses further off than the noise would. All that is computed from the model
later on (`geometry/bundle.py`) takes its observations to have been weighted by Cauchy's kernel, as they are here.
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
_FURTHEST_PRINCIPAL_POINT = 0.05  # of the longer side: beyond, it has taken up something else
_ROBUST_ROUNDS = 3
_STEPS_A_TIME, _MOST_STEPS = 5, 100  # of a round: the solver lets no signal through while it works
_SETTLED = 0.01  # relative change of the residuals' scale
_LEAST_SCALE_PX = 1e-3  # of observations without noise, which have no tails either
# A step that gains less, of the whole cost and times the number of observations, is the last: a parameter that is
# one σ off costs 1/2 so measured. COLMAP's own tolerance of zero goes on to the limit of 100 steps.
_LEAST_GAIN = 0.2
_LEAST_GAIN_OF_FEW = 1e-6
_COARSE = 10.0  # times that, while the scale is still to change


@dataclass(frozen=True)
class LastAdjustment:
    """How to adjust.

    Attributes:
        principal_point: free it, from ten images on, which the mapper holds at the image's centre.
        threads: of the solver; -1: all cores.
    """

    principal_point: bool = True
    threads: int = -1


def adjust_finally(colmap: Any, model: Any, options: LastAdjustment, progress: Progress = SILENT) -> None:
    """Adjust a `pycolmap.Reconstruction` in place, robustly at the end.

    A principal point that is off by a few pixels, as those of most lenses are, moves points by decimetres once the
    cameras are laid on GNSS. Fewer than ten images do not determine it. Where it would leave the middle of the
    image it is refused, with a warning.

    Then follow up to three adjustments with Cauchy's kernel, its scale that of the residuals that the one before
    left, until this settles. No observation is left out: those far off have next to no weight.

    Args:
        colmap: the pycolmap module.

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
    adjustment.ceres.solver_options.max_num_iterations = _STEPS_A_TIME
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
    for _ in range(_MOST_STEPS // _STEPS_A_TIME):
        summary = colmap.create_default_bundle_adjuster(adjustment, bundle, model).solve()
        if not summary.is_solution_usable():
            raise ConvergenceError(f"the last bundle adjustment found no solution: {summary.brief_report()}")
        if summary.termination_type != colmap.BundleAdjustmentTerminationType.NO_CONVERGENCE:
            return


def _free_principal_point(colmap: Any, model: Any, adjustment: Any) -> bool:
    """Adjust with the principal point free; whether it was accepted. If not, all is adjusted without it."""
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
    """Lengths (M,) of the residuals of all observations in pixels; NaN behind the camera."""
    flat = flatten(model)
    rotation = flat.rotation_cam_from_local[flat.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, flat.point_in_local[flat.obs_point])
    in_cam += flat.translation_cam_from_local[flat.obs_image]
    projected = project_each(flat.cameras, flat.image_camera_id[flat.obs_image], in_cam)
    return np.asarray(np.linalg.norm(projected - flat.obs_xy_px, axis=1))
