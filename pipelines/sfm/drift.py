"""Adjustment with the measured positions, which removes the drift of a large reconstruction.

The errors of neighbouring photographs add up over a large flight: a model bends at hardly any cost, and the steps
of a plain adjustment along such a bend are tiny. An adjustment with the positions as priors straightens it at once.
This is a start only. The last adjustment follows, by the photographs alone: otherwise the fixes would count twice,
here and where the model is placed on Earth.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray, Vector3
from pipelines.geometry.similarity import umeyama
from pipelines.robust.kernels import cauchy_weight
from pipelines.robust.statistics import median_chi2
from pipelines.sfm.position_priors import PriorAdjustment, position_prior

log = logging.getLogger(__name__)

_FEWEST_FIXES = 10
_LEAST_SPREAD = 0.05  # of the longest extent: on a line, positions leave the rotation about it open
_ALIGNMENT_ROUNDS = 20
_ALIGNMENT_GATE = 6.0  # times σ: the limit of an inlier of COLMAP's own alignment
_LEAST_SIGMA = 1e-6  # of the extent, for positions without noise
_MOST_ITERATIONS = 50


def remove_drift(
    colmap: Any, model: Any, fixes: Mapping[str, Vector3], threads: int, progress: Progress = SILENT
) -> float | None:
    """Adjust a `pycolmap.Reconstruction` in place with measured positions as priors.

    All priors have one σ: that of the model's positions against the fixes, after a robust alignment. The fixes' own
    σ are not used, since this is a start only, and a change of σ does not make the model stale.

    Args:
        colmap: the pycolmap module.
        model: the reconstruction; its frame becomes `geo`.
        fixes: measured camera centres in geo by name of the image, metres.
        threads: of the solver.
        progress: shows the adjustment.

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
    sigma_m = max(_sigma_m(center, position), _LEAST_SIGMA * float(extent[0]))
    covariance = sigma_m**2 * np.eye(3)
    priors = [
        position_prior(colmap, image, place, covariance) for image, place in zip(images, position, strict=True)
    ]
    adjustment = PriorAdjustment(_MOST_ITERATIONS, _ALIGNMENT_GATE * sigma_m, threads)
    with progress.task("adjustment with positions", 1) as task:
        adjuster = adjustment.adjuster(colmap, model, priors)
        if not adjuster.solve().is_solution_usable():
            log.warning("the adjustment with the measured positions found no solution: the model may have drifted")
        task.advance(note=f"σ {sigma_m:.2f} m")
    return sigma_m


def _sigma_m(center: FloatArray, position: FloatArray) -> float:
    """Return σ along one axis of the positions (N, 3), after a robust alignment of the camera centres."""
    weights = np.ones(len(center))
    sigma_m = 0.0
    for _ in range(_ALIGNMENT_ROUNDS):
        squared = ((umeyama(center, position, weights).apply(center) - position) ** 2).sum(1)
        sigma_m = math.sqrt(float(np.median(squared)) / median_chi2(3))
        if sigma_m == 0.0:
            break
        weights = cauchy_weight(squared / sigma_m**2, 3)
    return sigma_m
