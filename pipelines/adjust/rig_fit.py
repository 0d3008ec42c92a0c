"""Adjustment of time offset, boresight and lever arm: the SfM cameras against the recorded navigation.

The SfM model gives the camera's track and its turns. The navigation gives the same on another clock, from another
place and in other axes. One adjustment solves for the similarity geo ← local, the time offset, the boresight and
the lever arm that make both agree (`rig_model` has the equations): Gauss–Newton, reweighted by Cauchy's kernel.

- The σ of positions and of attitudes are estimated from the residuals.
- Wide priors keep the σ of unobservable parameters finite but large. Examples are a hover, a straight line, and a
  circle at constant speed, where a time offset is equivalent to a rotation of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.adjust.normal_equations import NormalEquations, Observations, robust_weights
from pipelines.adjust.rig_model import (
    ARM,
    BORESIGHT,
    DIFFERENCE_S,
    OFFSET,
    SIMILARITY,
    RigData,
    RigState,
    derivatives_of,
    has_mount,
    residuals_of,
    usable_images,
)
from pipelines.adjust.rig_start import LEAST_IMAGES, NOT_OBSERVABLE, scan_offsets, smoothed
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import jacobian_at, perturbation
from pipelines.robust.statistics import mad_sigma, median_chi2, squared_mahalanobis

# A parameter counts as observed if its σ is below this: seconds, degrees, metres.
LIMIT_OFFSET_S, LIMIT_BORESIGHT_DEG, LIMIT_ARM_M = 0.05, 0.5, 0.1
_PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M = np.radians(10.0), 2.0
_ROUNDS, _STEPS = 4, 12
_SCAN_STEP_S = 0.1
_INNER = 0.9  # part of the search whose end is no answer: beyond, the best may be the edge of a better one
_FURTHER_S = 30.0  # more than the 18 s between GPS time and UTC
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-3, 1e-5


@dataclass(frozen=True)
class RigFit:
    """Result of the adjustment.

    Attributes:
        state: values of the unknowns.
        sigma: (14,) σ: of the similarity (7), offset in s, boresight in rad (3), lever arm in m (3). A small error
            of SfM's lens tilts all cameras alike, or shifts them along their view, without any residual. The σ of
            boresight and lever arm therefore include one pixel: its angle, and its width at the scene.
        images: number of images in the adjustment.
        rms_position_m, rms_attitude_deg: robust σ of the residuals per axis; attitude NaN without any.
    """

    state: RigState
    sigma: FloatArray
    images: int
    rms_position_m: float
    rms_attitude_deg: float


@dataclass(frozen=True)
class FitOptions:
    """Options of the adjustment.

    Attributes:
        offset: estimate the time offset.
        arm: estimate the lever arm.
        max_offset_s: the offset is searched so far on either side of its start.
    """

    offset: bool = True
    arm: bool = False
    max_offset_s: float = 2.0


def fit_rig(data: RigData, start_offset_s: float, start_boresight: FloatArray, options: FitOptions) -> RigFit:
    """Return the parameters of the rig that make SfM cameras and navigation agree.

    The boresight is free if attitudes and a mount are known, so that its error does not affect the other
    parameters.

    Args:
        data: cameras, navigation and control points.
        start_offset_s: time offset to start from.
        start_boresight: (3, 3) nominal ← true camera, to start from.
        options: free parameters.

    Raises:
        DegenerateGeometryError: fewer than six images within the track, or all on one line or in one place; or the
            time offset lies at the end of its search.
    """
    data = replace(data, attitudes=smoothed(data.attitudes))
    offsets = np.array([start_offset_s])
    if options.offset:
        steps = np.arange(-options.max_offset_s, options.max_offset_s + _SCAN_STEP_S / 2, _SCAN_STEP_S)
        offsets = start_offset_s + steps[np.argsort(np.abs(steps), kind="stable")]
    state = scan_offsets(data, offsets, start_boresight)
    start, free = state, _free(data, options)
    sigma_m, sigma_rad = 1.0, np.radians(2.0)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            equations, pivot = _equations(data, state, (sigma_m, sigma_rad), start, options)
            step = equations.solve(robust_weights(equations.residuals()), free)
            state = _moved(state, step, pivot)
            if np.abs(step[7:]).max() < 1e-7:
                break
        position, attitude = residuals_of(data, state, usable_images(data, state.offset_s))
        if len(position) < LEAST_IMAGES:
            raise DegenerateGeometryError(NOT_OBSERVABLE)
        sigma_m = max(mad_sigma(np.concatenate([position, -position]).ravel()), _LEAST_SIGMA_M)
        if len(attitude):
            sigma_rad = max(mad_sigma(np.concatenate([attitude, -attitude]).ravel()), _LEAST_SIGMA_RAD)
    if options.offset and abs(state.offset_s - start_offset_s) > _INNER * options.max_offset_s:
        raise DegenerateGeometryError(
            f"the time offset that fits best lies at the end of the search, {options.max_offset_s:g} s from the "
            f"present one, where others may fit better: search further with --max-offset {_FURTHER_S:g}"
        )
    equations, _ = _equations(data, state, (sigma_m, sigma_rad), start, options)
    covariance = equations.covariance(robust_weights(equations.residuals()), free)
    sigma = np.where(free, np.sqrt(np.diag(covariance)), np.inf)
    if options.offset:
        # Noise of the navigation looks like motion, and motion is information on the offset. The information that
        # plain noise would give is subtracted.
        known = sigma[OFFSET] ** -2 - 3 * (len(position) + len(attitude)) / (2 * DIFFERENCE_S**2)
        sigma[OFFSET] = np.maximum(known, options.max_offset_s**-2) ** -0.5
    sigma[BORESIGHT] = np.hypot(sigma[BORESIGHT], data.pixel_rad)
    sigma[ARM] = np.hypot(sigma[ARM], state.geo_from_local.scale * data.footprint_in_local)
    left = float(np.degrees(sigma_rad)) if len(attitude) else np.nan
    return RigFit(state, sigma, len(position), sigma_m, left)


def _free(data: RigData, options: FitOptions) -> BoolArray:
    free = np.ones(14, dtype=bool)
    free[OFFSET], free[ARM] = options.offset, options.arm
    free[BORESIGHT] = has_mount(data, np.ones(len(data.time_s), dtype=bool)).any() and data.has_attitudes
    return free


def _equations(
    data: RigData, state: RigState, sigmas: tuple[float, float], start: RigState, options: FitOptions
) -> tuple[NormalEquations, FloatArray]:
    """Return the normal equations in 14 parameters near a state, and their pivot (3,) in geo.

    Args:
        data: cameras, navigation and control points.
        state: values about which to linearise.
        sigmas: σ of positions in metres and of attitudes in radians.
        start: middle of the prior.
        options: free parameters.
    """
    used = usable_images(data, state.offset_s)
    mapped = state.geo_from_local.apply(data.center_in_local[used])
    pivot = mapped.mean(axis=0)
    position, attitude = residuals_of(data, state, used)
    by_position, by_attitude = derivatives_of(data, state, used, pivot)
    observations = {
        "positions": Observations(position / sigmas[0], by_position / sigmas[0]),
        "attitudes": Observations(attitude / sigmas[1], by_attitude / sigmas[1]),
    }
    if len(data.control_in_local):
        missed, whitener = _control(data, state)
        by_control = np.zeros((len(missed), 3, 14))
        by_control[:, :, SIMILARITY] = -jacobian_at(state.geo_from_local.apply(data.control_in_local), pivot)
        observations["control"] = Observations((whitener @ missed[..., None])[..., 0], whitener @ by_control)
    precision, offset = _prior(state, start, options)
    return NormalEquations(observations, precision, offset, advice=NOT_OBSERVABLE), pivot


def _control(data: RigData, state: RigState) -> tuple[FloatArray, FloatArray]:
    """Return the residuals of the control points (c, 3) in metres and their whiteners (c, 3, 3).

    The SfM model bends. If the control points scatter more than the covariances of marks and survey, these
    covariances are scaled up to the scatter.
    """
    model = state.geo_from_local
    missed = data.control_in_geo - model.apply(data.control_in_local)
    cov = data.control_cov_in_geo + model.scale**2 * model.rotation @ data.control_cov_in_local @ model.rotation.T
    excess = max(1.0, float(np.median(squared_mahalanobis(missed, cov))) / median_chi2(3))
    return missed, np.asarray(np.linalg.inv(np.linalg.cholesky(excess * cov)))


def _prior(state: RigState, start: RigState, options: FitOptions) -> tuple[FloatArray, FloatArray]:
    """Return the precision (14,) of the prior, and the state's distance (14,) from its middle."""
    sigma, missed = np.full(14, np.inf), np.zeros(14)
    sigma[OFFSET], sigma[BORESIGHT], sigma[ARM] = options.max_offset_s, _PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M
    missed[OFFSET] = state.offset_s - start.offset_s
    missed[BORESIGHT] = log_so3(start.boresight.T @ state.boresight)
    missed[ARM] = state.arm - start.arm
    return sigma**-2, missed


def _moved(state: RigState, step: FloatArray, pivot: FloatArray) -> RigState:
    return RigState(
        perturbation(step[SIMILARITY], pivot) @ state.geo_from_local,
        state.offset_s + float(step[OFFSET][0]),
        state.boresight @ exp_so3(step[BORESIGHT]),
        state.arm + step[ARM],
    )
