"""Time offset, boresight and lever arm from the SfM cameras against the recorded navigation.

The SfM model knows the shape of the camera's track and its turns, the navigation the same on another clock, from
another place and in other axes. One adjustment over the similarity geo ← local, the offset δ, the boresight B and
the lever arm l:

    position:  p(t + δ) − A(t + δ) l = s R c + t
    attitude:  A(t + δ) M B = R C

with the antenna p and the body A as recorded, the mount M, camera centres c and rotations C in local. Iteratively
reweighted Gauss-Newton with Cauchy's weights; the scatter of either kind is measured, not believed. Wide priors
keep what the flight does not show finite, so that it is recognised by its σ: a hover, a straight line, a circle at
constant speed (where an offset looks like a turn of the whole).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3, right_jacobian_inverse_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation, umeyama
from pipelines.geometry.trajectory import covered, places_at, turns_at
from pipelines.georef.normal_equations import NormalEquations, Observations, robust_weights
from pipelines.robust.statistics import mad_sigma, median_chi2, squared_mahalanobis
from pipelines.scene.navigation import NavigationTrack

# A parameter counts as observed if its σ is below this: seconds, degrees, metres.
LIMIT_OFFSET_S, LIMIT_BORESIGHT_DEG, LIMIT_ARM_M = 0.05, 0.5, 0.1
_PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M = np.radians(10.0), 2.0
_SIMILARITY, _ROTATION = slice(0, 7), slice(1, 4)
_OFFSET, _BORESIGHT, _ARM = slice(7, 8), slice(8, 11), slice(11, 14)
_ROUNDS, _STEPS = 4, 12
_SCAN_STEP_S = 0.1
# Velocities are taken over this long: between neighbouring fixes noise would drown them.
_DIFFERENCE_S = 0.5
_SMOOTHING_S = 0.1
_LEAST_IMAGES = 6
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-3, 1e-5


_UNSEEN = (
    f"nothing of the rig is observable: fewer than {_LEAST_IMAGES} images lie within the recorded navigation, or "
    "all lie on one line or in one place"
)


@dataclass(frozen=True)
class RigData:
    """What the adjustment sees of n images and c control points.

    Attributes:
        track: the navigation.
        time_s: (n,) camera clock.
        center_in_local: (n, 3) and cam_from_local: (n, 3, 3), of SfM.
        cam_from_body: (n, 3, 3) mount, NaN where unknown.
        antenna_in_body: (n, 3) lever arm to start from.
        control_in_local, control_in_geo: (c, 3).
        control_cov_in_local, control_cov_in_geo: (c, 3, 3), of their marks and of their survey.
        pixel_rad: angle of a pixel; footprint_in_local: its width at the distance of the scene.
    """

    track: NavigationTrack
    time_s: FloatArray
    center_in_local: FloatArray
    cam_from_local: FloatArray
    cam_from_body: FloatArray
    antenna_in_body: FloatArray
    control_in_local: FloatArray
    control_in_geo: FloatArray
    control_cov_in_local: FloatArray
    control_cov_in_geo: FloatArray
    pixel_rad: float
    footprint_in_local: float


@dataclass(frozen=True)
class RigState:
    """Values of the unknowns; `arm` is added to `RigData.antenna_in_body`, boresight is nominal ← true camera."""

    geo_from_local: Similarity
    offset_s: float
    boresight: FloatArray
    arm: FloatArray


@dataclass(frozen=True)
class RigFit:
    """The result.

    Attributes:
        state: the values.
        sigma: (14,) σ: of the similarity (7), offset in s, boresight in rad (3), lever arm in m (3). A lens that
            SfM has not quite found tilts all cameras alike, or moves them along their view, with the scene's
            consent: no scatter shows it, and σ of boresight and lever arm count a pixel of it.
        images: that took part.
        rms_position_m, rms_attitude_deg: robust scatter per axis of what is left; attitude NaN without any.
    """

    state: RigState
    sigma: FloatArray
    images: int
    rms_position_m: float
    rms_attitude_deg: float


@dataclass(frozen=True)
class FitOptions:
    """Which unknowns are free, and how far an offset is searched on either side of its start."""

    offset: bool = True
    arm: bool = False
    max_offset_s: float = 2.0


def fit_rig(data: RigData, start_offset_s: float, start_boresight: FloatArray, options: FitOptions) -> RigFit:
    """Adjust. The boresight is free wherever there are attitudes, so that its error does not reach the rest.

    Raises:
        DegenerateGeometryError: fewer than six images within the track, or all on one line or in one place.
    """
    data = replace(data, track=_smoothed(data.track))
    offsets = np.array([start_offset_s])
    if options.offset:
        steps = np.arange(-options.max_offset_s, options.max_offset_s + _SCAN_STEP_S / 2, _SCAN_STEP_S)
        offsets = start_offset_s + steps[np.argsort(np.abs(steps), kind="stable")]
    state = _scan(data, offsets, start_boresight)
    start, free = state, _free(data, options)
    sigma_m, sigma_rad = 1.0, np.radians(2.0)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            equations, pivot = _equations(data, state, (sigma_m, sigma_rad), start, options)
            step = equations.solve(robust_weights(equations.residuals()), free)
            state = _moved(state, step, pivot)
            if np.abs(step[7:]).max() < 1e-7:
                break
        position, attitude = _residuals(data, state, _usable(data, state.offset_s))
        if len(position) < _LEAST_IMAGES:
            raise DegenerateGeometryError(_UNSEEN)
        sigma_m = max(mad_sigma(np.concatenate([position, -position]).ravel()), _LEAST_SIGMA_M)
        if len(attitude):
            sigma_rad = max(mad_sigma(np.concatenate([attitude, -attitude]).ravel()), _LEAST_SIGMA_RAD)
    equations, _ = _equations(data, state, (sigma_m, sigma_rad), start, options)
    covariance = equations.covariance(robust_weights(equations.residuals()), free)
    sigma = np.where(free, np.sqrt(np.diag(covariance)), np.inf)
    if options.offset:
        # Noise of the fixes passes for motion, and motion for information: what noise would give is taken off.
        known = sigma[_OFFSET] ** -2 - 3 * (len(position) + len(attitude)) / (2 * _DIFFERENCE_S**2)
        sigma[_OFFSET] = np.maximum(known, options.max_offset_s**-2) ** -0.5
    sigma[_BORESIGHT] = np.hypot(sigma[_BORESIGHT], data.pixel_rad)
    sigma[_ARM] = np.hypot(sigma[_ARM], state.geo_from_local.scale * data.footprint_in_local)
    left = float(np.degrees(sigma_rad)) if len(attitude) else np.nan
    return RigFit(state, sigma, len(position), sigma_m, left)


def _free(data: RigData, options: FitOptions) -> BoolArray:
    free = np.ones(14, dtype=bool)
    free[_OFFSET], free[_ARM] = options.offset, options.arm
    free[_BORESIGHT] = _mounted(data, np.ones(len(data.time_s), dtype=bool)).any() and _has_attitudes(data.track)
    return free


def _scan(data: RigData, offsets: FloatArray, boresight: FloatArray) -> RigState:
    """The offset at which the shapes of the tracks agree best, and the similarity there."""
    best: tuple[float, RigState] | None = None
    for offset in offsets:
        inside = _usable(data, float(offset))
        if inside.sum() < _LEAST_IMAGES:
            continue
        place, _ = _navigation(data, float(offset), np.zeros(3), inside)
        try:
            model = umeyama(data.center_in_local[inside], place)
        except DegenerateGeometryError:
            continue
        missed = np.linalg.norm(place - model.apply(data.center_in_local[inside]), axis=1)
        # Few images agree easily: each that the offset loses counts like a large miss.
        cost = float(np.median(missed)) * (1.0 + 10.0 * (1.0 - inside.mean()))
        if best is None or cost < best[0]:
            best = cost, RigState(model, float(offset), boresight, np.zeros(3))
    if best is None:
        raise DegenerateGeometryError(_UNSEEN)
    state = best[1]
    spread = np.linalg.svd(data.center_in_local - data.center_in_local.mean(axis=0), compute_uv=False)
    extent_m = state.geo_from_local.scale * spread / np.sqrt(len(data.center_in_local))
    if extent_m[0] < 1.0 or extent_m[1] < 0.01 * extent_m[0]:
        raise DegenerateGeometryError(
            "nothing of the rig is observable: the cameras stay within a metre of one place, or on one line; "
            "fly turns and changes of speed"
        )
    return state


def _usable(data: RigData, offset_s: float) -> BoolArray:
    """Images (n,) for which there is navigation now and where the offset is moved to differentiate."""
    track, usable = data.track, np.ones(len(data.time_s), dtype=bool)
    clocks = [track.position_time_s, track.attitude_time_s] if _has_attitudes(track) else [track.position_time_s]
    for clock in clocks:
        for shift in (-_DIFFERENCE_S, 0.0, _DIFFERENCE_S):
            usable &= covered(clock, data.time_s + offset_s + shift, float(track.max_gap_s))
    return usable


def _has_attitudes(track: NavigationTrack) -> bool:
    return len(track.attitude_time_s) > 1


def _navigation(data: RigData, offset_s: float, arm: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Camera places (k, 3) and bodies geo ← body (k, 3, 3), or none, that the navigation says of images (n,)."""
    track, at = data.track, data.time_s[used] + offset_s
    place = places_at(track.position_time_s, track.antenna_in_geo, at)
    if not _has_attitudes(track):
        return place, np.empty((0, 3, 3))
    bodies = turns_at(track.attitude_time_s, track.geo_from_body, at)
    return place - np.einsum("nij,nj->ni", bodies, data.antenna_in_body[used] + arm), bodies


def _residuals(data: RigData, state: RigState, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Misses of positions (k, 3) in metres and of attitudes (j, 3) in radians, in the camera's axes."""
    place, bodies = _navigation(data, state.offset_s, state.arm, used)
    position = place - state.geo_from_local.apply(data.center_in_local[used])
    if not len(bodies):
        return position, np.empty((0, 3))
    known = _mounted(data, used)
    by_navigation = _by_navigation(data, state, bodies, used)
    by_sfm = state.geo_from_local.rotation @ np.swapaxes(data.cam_from_local[used][known], 1, 2)
    return position, log_so3(np.swapaxes(by_sfm, 1, 2) @ by_navigation)


def _mounted(data: RigData, used: BoolArray) -> BoolArray:
    """Which of the used images (k,) have a camera whose mount is known."""
    return np.asarray(np.isfinite(data.cam_from_body[used]).all(axis=(1, 2)))


def _by_navigation(data: RigData, state: RigState, bodies: FloatArray, used: BoolArray) -> FloatArray:
    """Camera rotations geo ← cam (j, 3, 3) that the navigation says of the used images with a mount."""
    known = _mounted(data, used)
    return np.asarray(bodies[known] @ np.swapaxes(data.cam_from_body[used][known], 1, 2) @ state.boresight)


def _equations(
    data: RigData, state: RigState, sigmas: tuple[float, float], start: RigState, options: FitOptions
) -> tuple[NormalEquations, FloatArray]:
    """The adjustment near a state, in 14 parameters about a pivot (3,) in geo."""
    used = _usable(data, state.offset_s)
    mapped = state.geo_from_local.apply(data.center_in_local[used])
    pivot = mapped.mean(axis=0)
    position, attitude = _residuals(data, state, used)
    by_position, by_attitude = _derivatives(data, state, used, pivot)
    observations = {
        "positions": Observations(position / sigmas[0], by_position / sigmas[0]),
        "attitudes": Observations(attitude / sigmas[1], by_attitude / sigmas[1]),
    }
    if len(data.control_in_local):
        missed, whitener = _control(data, state)
        by_control = np.zeros((len(missed), 3, 14))
        by_control[:, :, _SIMILARITY] = -jacobian_at(state.geo_from_local.apply(data.control_in_local), pivot)
        observations["control"] = Observations((whitener @ missed[..., None])[..., 0], whitener @ by_control)
    precision, offset = _prior(state, start, options)
    return NormalEquations(observations, precision, offset, advice=_UNSEEN), pivot


def _derivatives(
    data: RigData, state: RigState, used: BoolArray, pivot: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (k, 3, 14) of the positions' misses and (j, 3, 14) of the attitudes' by the parameters.

    All but those by the time offset are analytic. A velocity is measured over `_DIFFERENCE_S` on either side.
    """
    mapped = state.geo_from_local.apply(data.center_in_local[used])
    _, bodies = _navigation(data, state.offset_s, state.arm, used)
    ahead, behind = (
        _residuals(data, replace(state, offset_s=state.offset_s + shift), used)
        for shift in (_DIFFERENCE_S, -_DIFFERENCE_S)
    )
    by_position = np.zeros((len(mapped), 3, 14))
    by_position[:, :, _SIMILARITY] = -jacobian_at(mapped, pivot)
    by_position[:, :, _OFFSET] = ((ahead[0] - behind[0]) / (2 * _DIFFERENCE_S))[..., None]
    if not len(bodies):
        return by_position, np.zeros((0, 3, 14))
    by_position[:, :, _ARM] = -bodies
    _, attitude = _residuals(data, state, used)
    turned = right_jacobian_inverse_so3(attitude)
    by_attitude = np.zeros((len(attitude), 3, 14))
    by_attitude[:, :, _ROTATION] = -turned @ np.swapaxes(_by_navigation(data, state, bodies, used), 1, 2)
    by_attitude[:, :, _BORESIGHT] = turned
    by_attitude[:, :, _OFFSET] = ((ahead[1] - behind[1]) / (2 * _DIFFERENCE_S))[..., None]
    return by_position, by_attitude


def _control(data: RigData, state: RigState) -> tuple[FloatArray, FloatArray]:
    """Misses of the control points (c, 3) in metres and their whiteners (c, 3, 3).

    The SfM model bends: where the control points scatter more than marks and survey allow, all count for less.
    """
    model = state.geo_from_local
    missed = data.control_in_geo - model.apply(data.control_in_local)
    cov = data.control_cov_in_geo + model.scale**2 * model.rotation @ data.control_cov_in_local @ model.rotation.T
    excess = max(1.0, float(np.median(squared_mahalanobis(missed, cov))) / median_chi2(3))
    return missed, np.asarray(np.linalg.inv(np.linalg.cholesky(excess * cov)))


def _prior(state: RigState, start: RigState, options: FitOptions) -> tuple[FloatArray, FloatArray]:
    """Precision (14,) of what is known beforehand, and the state's distance (14,) from it."""
    sigma, missed = np.full(14, np.inf), np.zeros(14)
    sigma[_OFFSET], sigma[_BORESIGHT], sigma[_ARM] = options.max_offset_s, _PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M
    missed[_OFFSET] = state.offset_s - start.offset_s
    missed[_BORESIGHT] = log_so3(start.boresight.T @ state.boresight)
    missed[_ARM] = state.arm - start.arm
    return sigma**-2, missed


def _moved(state: RigState, step: FloatArray, pivot: FloatArray) -> RigState:
    return RigState(
        perturbation(step[_SIMILARITY], pivot) @ state.geo_from_local,
        state.offset_s + float(step[_OFFSET][0]),
        state.boresight @ exp_so3(step[_BORESIGHT]),
        state.arm + step[_ARM],
    )


def _smoothed(track: NavigationTrack) -> NavigationTrack:
    """Attitudes averaged over a tenth of a second on either side: white noise shrinks, a turn stays."""
    clock = track.attitude_time_s
    if len(clock) < 3:
        return track
    half = int(_SMOOTHING_S / max(float(np.median(np.diff(clock))), 1e-6))
    if half < 1 or len(clock) < 4 * half:
        return track
    quat = Rotation.from_matrix(track.geo_from_body).as_quat()
    flips = np.cumprod(np.where((quat[1:] * quat[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    quat[1:] *= flips[:, None]
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    mean = np.stack([np.convolve(quat[:, i], kernel, mode="valid") for i in range(4)], axis=1)
    inner = slice(half, len(clock) - half)
    even = clock[2 * half :] - clock[: -2 * half] < 3 * half * float(np.median(np.diff(clock)))
    quat[inner] = np.where(even[:, None], mean, quat[inner])
    return replace(track, geo_from_body=np.asarray(Rotation.from_quat(quat).as_matrix()))
