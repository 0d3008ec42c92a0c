"""Adjustment of cameras that another program has solved, where the tie points know them better.

Held cameras count as exact: later stages predict σ from the observations alone. Where the file has rounded, old or
inaccurate cameras, points and σ are wrong by what that program left. Whether it did is tested: by how much an
adjustment of the cameras lowers the robust χ² of the tie points, beside the number of parameters. Cameras at the
minimum lower it by nothing, cameras without errors by one a parameter, those solved by other tie points of the same
accuracy by two. From three on, the cameras' own errors are the larger ones.
"""

import logging
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal

import numpy as np

from pipelines.core.errors import ConvergenceError
from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Reconstruction
from pipelines.geometry.statistics import cauchy_loss, rayleigh_sigma
from pipelines.sfm.adjustment import LEAST_SCALE_PX, adjust_finally, place_points, residual_px

log = logging.getLogger(__name__)

Rule = Literal["adjust", "judge", "hold"]  # always; where the tie points say so; never, but it is said
_WORSE = 3.0  # χ² a parameter: above it, the imported cameras have larger errors than adjusted ones
_MOST_ROUNDS = 5  # of triangulation and adjustment
_SETTLED = 0.01  # change of the number of observations in a round, relative
_BEHIND_SIGMA = 1e3  # length of the residual of a point behind its camera


def settle_imported(
    colmap: ModuleType,
    model: Reconstruction,
    rule: Rule,
    *,
    again: Callable[[Reconstruction], Reconstruction] | None = None,
    principal_point: bool = True,
    threads: int = -1,
    progress: Progress,
) -> Any:
    """Return an imported `pycolmap.Reconstruction`, or one adjusted by its tie points as the rule says.

    1. Poses and points are adjusted, the lenses held.
    2. If that lowers χ² by more than `_WORSE` a parameter, the adjusted poses are taken; with `again`, points are
       triangulated and poses adjusted by turns, since matches that contradict imported poses had been left out.
    3. The lenses are freed, and taken if that again lowers χ² by more than `_WORSE` a parameter.

    Raises:
        ConvergenceError: the rule is to adjust, and COLMAP found no solution.
    """
    if not _redundant(model):
        return model
    try:
        poses = 6 * model.num_reg_images() - 7
        before = type(model)(model)
        place_points(colmap, before, threads)
        better = type(model)(model)
        adjust_finally(colmap, better, lens_held=True, threads=threads, progress=progress)
        gain, before_px, after_px = _gain(before, better, poses)
        if rule == "judge" and gain <= _WORSE:
            return model
        if rule == "hold":
            if gain > _WORSE:
                _warn("imported-cameras-fit-worse", _HELD, before_px, after_px, gain)
            return model
        if again is not None:
            better = _in_rounds(colmap, model, again, threads, progress)
        freed = type(model)(better)
        adjust_finally(colmap, freed, principal_point=principal_point, threads=threads, progress=progress)
    except ConvergenceError as error:
        if rule == "adjust":
            raise
        log.warning(
            "Whether the imported cameras are as accurate as the tie points is unknown: %s", error,
            extra={"code": "imported-cameras-not-judged"},
        )  # fmt: skip
        return model
    lenses = sum(len(camera.params) for camera in freed.cameras.values())
    lens_gain, held_px, freed_px = _gain(better, freed, lenses)
    lens = lens_gain > _WORSE
    sentence, after_px = (_LENS_TOO, freed_px) if lens else (_POSES, held_px)
    _warn("imported-cameras-adjusted", sentence, before_px, after_px, gain)
    return freed if lens else better


def _in_rounds(
    colmap: ModuleType,
    model: Reconstruction,
    again: Callable[[Reconstruction], Reconstruction],
    threads: int,
    progress: Progress,
) -> Any:
    """Return the model triangulated and adjusted by turns, until the number of its observations settles."""
    observations = 0
    for _ in range(_MOST_ROUNDS):
        model, before = again(model), observations
        adjust_finally(colmap, model, lens_held=True, threads=threads, progress=progress)
        observations = model.compute_num_observations()
        if abs(observations - before) <= _SETTLED * observations:
            break
    return model


_FIT = (
    "The imported cameras fit the tie points with σ %.2f px, adjusted ones with %.2f px: χ² falls by %.3g for each "
    "parameter, where cameras as accurate as the tie points have 2 or less. "
)
_POSES = "Their poses were adjusted by the tie points; --adjust-imported no keeps them as they are."
_LENS_TOO = "Their poses and lenses were adjusted by the tie points; --adjust-imported no keeps them as they are."
_HELD = (
    "They are held as they are, and their errors are in the result, beyond its predicted σ: "
    "--adjust-imported yes adjusts them."
)


def _warn(code: str, sentence: str, before_px: float, after_px: float, gain: float) -> None:
    log.warning(_FIT + sentence, before_px, after_px, gain, extra={"code": code})


def _redundant(model: Reconstruction) -> bool:
    """Return whether the observations determine poses, lenses and points."""
    lenses = sum(len(camera.params) for camera in model.cameras.values())
    unknowns = 6 * model.num_reg_images() + 3 * model.num_points3D() + lenses
    return bool(model.num_points3D() > 0 and 2 * model.compute_num_observations() > unknowns)


def _gain(before: Reconstruction, after: Reconstruction, parameters: int) -> tuple[float, float, float]:
    """Return by how much χ² is lower after than before, for each parameter, and σ (px) before and after."""
    first, second = residual_px(before), residual_px(after)
    sigma = max(rayleigh_sigma(second), LEAST_SCALE_PX)
    fall = _chi2(first / sigma) - _chi2(second / sigma)
    return fall / max(parameters, 1), rayleigh_sigma(first), sigma


def _chi2(lengths: FloatArray) -> float:
    """Return the robust χ² of residuals' lengths (M,) in σ, as COLMAP's last adjustment weights them."""
    return float(cauchy_loss(np.nan_to_num(lengths, nan=_BEHIND_SIGMA) ** 2, 2).sum())
