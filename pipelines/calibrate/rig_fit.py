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
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.geometry.trajectory import covered, places_at, turns_at
from pipelines.robust.kernels import cauchy_weight
from pipelines.robust.statistics import mad_sigma
from pipelines.scene.navigation import NavigationTrack

# A parameter counts as observed if its σ is below this: seconds, degrees, metres.
LIMIT_OFFSET_S, LIMIT_BORESIGHT_DEG, LIMIT_ARM_M = 0.05, 0.5, 0.1
_PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M = np.radians(10.0), 2.0
_SIMILARITY, _OFFSET, _BORESIGHT, _ARM = slice(0, 7), slice(7, 8), slice(8, 11), slice(11, 14)
_ROUNDS, _STEPS = 4, 12
_SCAN_STEP_S = 0.1
# Velocities are taken over this long: between neighbouring fixes noise would drown them.
_DIFFERENCE_S = 0.5
_SMOOTHING_S = 0.1
_LEAST_IMAGES = 6
_MEDIAN_CHI2_3 = 2.366
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
            normal, gradient = _normal(data, state, (sigma_m, sigma_rad), start, options)
            step = np.zeros(14)
            step[free] = np.linalg.solve(normal[np.ix_(free, free)], gradient[free])
            state = _moved(state, step)
            if np.abs(step[7:]).max() < 1e-7:
                break
        position, attitude = _residuals(data, state, _usable(data, state.offset_s))
        if len(position) < _LEAST_IMAGES:
            raise DegenerateGeometryError(_UNSEEN)
        sigma_m = max(mad_sigma(np.concatenate([position, -position]).ravel()), _LEAST_SIGMA_M)
        if len(attitude):
            sigma_rad = max(mad_sigma(np.concatenate([attitude, -attitude]).ravel()), _LEAST_SIGMA_RAD)
    normal, _ = _normal(data, state, (sigma_m, sigma_rad), start, options)
    sigma = np.full(14, np.inf)
    sigma[free] = np.sqrt(np.diag(np.linalg.solve(normal[np.ix_(free, free)], np.eye(len(free)))))
    if options.offset:
        # Noise of the fixes passes for motion, and motion for information: what noise would give is taken off.
        known = sigma[_OFFSET] ** -2 - 3 * (len(position) + len(attitude)) / (2 * _DIFFERENCE_S**2)
        sigma[_OFFSET] = np.maximum(known, options.max_offset_s**-2) ** -0.5
    sigma[_BORESIGHT] = np.hypot(sigma[_BORESIGHT], data.pixel_rad)
    sigma[_ARM] = np.hypot(sigma[_ARM], state.geo_from_local.scale * data.footprint_in_local)
    left = float(np.degrees(sigma_rad)) if len(attitude) else np.nan
    return RigFit(state, sigma, len(position), sigma_m, left)


def _free(data: RigData, options: FitOptions) -> NDArray[np.intp]:
    free = np.ones(14, dtype=bool)
    free[_OFFSET], free[_ARM] = options.offset, options.arm
    free[_BORESIGHT] = bool(np.isfinite(data.cam_from_body).all(axis=(1, 2)).any()) and len(
        data.track.attitude_time_s
    )
    return np.flatnonzero(free)


def _scan(data: RigData, offsets: FloatArray, boresight: FloatArray) -> RigState:
    """The offset at which the shapes of the tracks agree best, and the similarity there."""
    best: tuple[float, RigState] | None = None
    for offset in offsets:
        inside = _usable(data, float(offset))
        if inside.sum() < _LEAST_IMAGES:
            continue
        place, _ = _navigation(data, float(offset), np.zeros(3), inside)
        try:
            found = umeyama(data.center_in_local[inside], place)
        except DegenerateGeometryError:
            continue
        missed = np.linalg.norm(place - found.apply(data.center_in_local[inside]), axis=1)
        # Few images agree easily: each that the offset loses counts like a large miss.
        cost = float(np.median(missed)) * (1.0 + 10.0 * (1.0 - inside.mean()))
        if best is None or cost < best[0]:
            best = cost, RigState(found, float(offset), boresight, np.zeros(3))
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
    mount = data.cam_from_body[used]
    known = np.isfinite(mount).all(axis=(1, 2))
    by_navigation = bodies[known] @ np.swapaxes(mount[known], 1, 2) @ state.boresight
    by_sfm = state.geo_from_local.rotation @ np.swapaxes(data.cam_from_local[used][known], 1, 2)
    return position, log_so3(np.swapaxes(by_sfm, 1, 2) @ by_navigation)


def _normal(
    data: RigData, state: RigState, sigmas: tuple[float, float], start: RigState, options: FitOptions
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (14, 14) and right-hand side (14,) of one step."""
    used = _usable(data, state.offset_s)
    position, attitude = _residuals(data, state, used)
    jacobian_p, jacobian_a = np.zeros((*position.shape, 14)), np.zeros((*attitude.shape, 14))
    size = np.full(14, 1e-4)
    size[4:7], size[_OFFSET], size[_ARM] = 1e-2, _DIFFERENCE_S, 1e-2
    for i in range(14):
        step = np.where(np.arange(14) == i, size, 0.0)
        ahead, behind = (_residuals(data, _moved(state, each), used) for each in (step, -step))
        jacobian_p[..., i] = (ahead[0] - behind[0]) / (2 * size[i])
        jacobian_a[..., i] = (ahead[1] - behind[1]) / (2 * size[i])
    normal, gradient = _prior(state, start, options)
    for residual, jacobian, sigma in ((position, jacobian_p, sigmas[0]), (attitude, jacobian_a, sigmas[1])):
        weight = cauchy_weight((residual**2).sum(axis=1) / sigma**2) / sigma**2
        normal += np.einsum("n,nia,nib->ab", weight, jacobian, jacobian)
        gradient -= np.einsum("n,nia,ni->a", weight, jacobian, residual)
    if len(data.control_in_local):
        jacobian = -_similarity_jacobian(state, data.control_in_local)
        missed, inverse = _control(data, state)
        weight = cauchy_weight(np.einsum("ni,nij,nj->n", missed, inverse, missed))
        normal[:7, :7] += np.einsum("n,nia,nij,njb->ab", weight, jacobian, inverse, jacobian)
        gradient[:7] -= np.einsum("n,nia,nij,nj->a", weight, jacobian, inverse, missed)
    return normal, gradient


def _control(data: RigData, state: RigState) -> tuple[FloatArray, FloatArray]:
    """Misses of the control points (c, 3) and their weights (c, 3, 3).

    The SfM model bends: where the control points scatter more than marks and survey allow, all count for less.
    """
    model = state.geo_from_local
    missed = data.control_in_geo - model.apply(data.control_in_local)
    cov = data.control_cov_in_geo + model.scale**2 * model.rotation @ data.control_cov_in_local @ model.rotation.T
    inverse = np.linalg.solve(cov, np.tile(np.eye(3), (len(missed), 1, 1)))
    usual = float(np.median(np.einsum("ni,nij,nj->n", missed, inverse, missed)))
    return missed, np.asarray(inverse / max(1.0, usual / _MEDIAN_CHI2_3), dtype=np.float64)


def _similarity_jacobian(state: RigState, points: FloatArray) -> FloatArray:
    """∂(s R p + t) (n, 3, 7) by the similarity's part of a step."""
    size = 1e-4
    columns = []
    for i in range(7):
        step = np.zeros(14)
        step[i] = size
        ahead, behind = _moved(state, step).geo_from_local, _moved(state, -step).geo_from_local
        columns.append((ahead.apply(points) - behind.apply(points)) / (2 * size))
    return np.stack(columns, axis=-1)


def _prior(state: RigState, start: RigState, options: FitOptions) -> tuple[FloatArray, FloatArray]:
    sigma = np.full(14, np.inf)
    sigma[_OFFSET], sigma[_BORESIGHT], sigma[_ARM] = options.max_offset_s, _PRIOR_BORESIGHT_RAD, _PRIOR_ARM_M
    missed = np.zeros(14)
    missed[_OFFSET] = state.offset_s - start.offset_s
    missed[_BORESIGHT] = log_so3(start.boresight.T @ state.boresight)
    missed[_ARM] = state.arm - start.arm
    weight = 1.0 / sigma**2
    # The similarity is free, up to what arithmetic needs.
    weight[_SIMILARITY] = 1e-12
    return np.diag(weight), -weight * missed


def _moved(state: RigState, step: FloatArray) -> RigState:
    model = state.geo_from_local
    turn = exp_so3(step[1:4])
    similarity = Similarity(
        model.scale * float(np.exp(step[0])), turn @ model.rotation, turn @ model.translation + step[4:7]
    )
    return RigState(
        similarity,
        state.offset_s + float(step[7]),
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
