"""COLMAP's bundle adjustment with measured camera positions as priors, under Cauchy's kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from pipelines.robust.kernels import CAUCHY_SCALE2


@dataclass(frozen=True)
class PriorAdjustment:
    """Settings of an adjustment with position priors.

    Attributes:
        iterations: most of them.
        gate_m: limit of an inlier when COLMAP aligns the model with the priors, before it adjusts.
        threads: of the solver; -1: all.
        seed: of COLMAP's alignment.
    """

    iterations: int
    gate_m: float
    threads: int = -1
    seed: int = 0

    def adjuster(self, colmap: Any, model: Any, priors: Sequence[Any]) -> Any:
        """Return the adjuster of all cameras and points of a `pycolmap.Reconstruction`.

        Args:
            colmap: the pycolmap module.
            model: the reconstruction; solving moves it into the frame of the priors.
            priors: from `position_prior`.
        """
        bundle = colmap.BundleAdjustmentConfig()
        for image_id in model.reg_image_ids():
            bundle.add_image(image_id)
        return colmap.create_pose_prior_bundle_adjuster(
            self._image_options(colmap), self._prior_options(colmap), bundle, priors, model
        )

    def _image_options(self, colmap: Any) -> Any:
        options = colmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.ceres.solver_options.max_num_iterations = self.iterations
        options.ceres.solver_options.num_threads = self.threads
        return options

    def _prior_options(self, colmap: Any) -> Any:
        options = colmap.PosePriorBundleAdjustmentOptions()
        options.ceres.prior_position_loss_function_type = colmap.LossFunctionType.CAUCHY
        options.ceres.prior_position_loss_scale = math.sqrt(CAUCHY_SCALE2[3])
        options.alignment_ransac.max_error = self.gate_m
        options.alignment_ransac.random_seed = self.seed
        return options


def position_prior(colmap: Any, image: Any, position: ArrayLike, covariance: ArrayLike) -> Any:
    """Return the prior of a `pycolmap.Image`: its centre (3,) in metres with a covariance (3, 3)."""
    return colmap.PosePrior(
        corr_data_id=image.data_id,
        position=position,
        position_covariance=covariance,
        coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
    )
