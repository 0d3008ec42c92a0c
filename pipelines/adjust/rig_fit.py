"""Adjustment of time offset, boresight and lever arm: the SfM cameras against the recorded navigation.

The SfM model gives the camera's track and its turns. The navigation gives the same on another clock, from another
place and in other axes. With the antenna p and the body A as recorded, the mount M, camera centres c and rotations
C in local, the similarity geo ← local (s, R, t), the time offset δ, the boresight B and the lever arm l:

    position:  p(t + δ) − A(t + δ) l = s R c + t
    attitude:  A(t + δ) M B = R C

1. The start is the time offset at which the two tracks have the same shape.
2. One adjustment solves for all unknowns: Gauss–Newton, reweighted by Cauchy's kernel. The σ of positions and of
   attitudes are estimated from the residuals.
3. Wide priors keep the σ of unobservable parameters finite but large. Examples are a hover, a straight line, and a
   circle at constant speed, where a time offset is equivalent to a rotation of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pipelines.adjust.alignment import Correspondences, covariance_of
from pipelines.adjust.state import SIGMA_ARM_M, SIGMA_BORESIGHT_RAD
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, perturbation, umeyama
from pipelines.geometry.statistics import (
    cauchy_weight,
    mad_sigma,
    median_chi2,
    root_information,
    squared_mahalanobis,
)
from pipelines.geometry.trajectory import Trajectory

# Columns of the parameters: similarity (ln s, rotation, translation), offset in s, boresight in rad, arm in m.
SIMILARITY, OFFSET, BORESIGHT, ARM = slice(0, 7), slice(7, 8), slice(8, 11), slice(11, 14)
LIMIT_OFFSET_S = 0.05  # σ of a time offset that counts as observed; of the others, see `adjust.state.is_observed`
# Steps on either side of a state that give the derivatives. That of the time offset measures velocities: between
# neighbouring fixes noise would dominate.
_DIFFERENCE_S = 0.5
_DIFFERENCES = np.where(np.arange(14) == OFFSET.start, _DIFFERENCE_S, 1e-5)
_SMOOTHING_S = 0.1
_ROUNDS, _STEPS = 4, 12
_SCAN_STEP_S = 0.1
_INNER = 0.9  # part of the search whose end is no answer: beyond, the best may be the edge of a better one
_FURTHER_S = 30.0  # more than the 18 s between GPS time and UTC
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-3, 1e-5
_LEAST_IMAGES = 6
_NOT_OBSERVABLE = (
    f"The rig is not observable: fewer than {_LEAST_IMAGES} images lie within the recorded navigation, or all of "
    "them lie on one line or in one place."
)


@dataclass(frozen=True)
class RigData:
    """Cameras of n images by navigation and by SfM, and c control points."""

    positions: Trajectory  # of the antenna in geo, on the navigation's clock
    # Rotations of the body in geo, on the same clock; at most one sample if none were recorded
    attitudes: Trajectory
    time_s: FloatArray  # (n,) camera clock
    center_in_local: FloatArray  # (n, 3) projection centres of SfM
    cam_from_local: FloatArray  # (n, 3, 3) rotations of SfM
    cam_from_body: FloatArray  # (n, 3, 3) mount, NaN where unknown
    antenna_in_body: FloatArray  # (n, 3) lever arm to start from, metres
    control: Correspondences  # control points, intersected from their marks and as surveyed
    pixel_rad: float  # angle of a pixel
    footprint_in_local: float  # width of a pixel at the distance of the scene

    @property
    def has_attitudes(self) -> bool:
        return len(self.attitudes) > 1


@dataclass(frozen=True)
class RigState:
    """Values of the unknowns."""

    geo_from_local: Similarity
    offset_s: float  # navigation clock minus camera clock
    boresight: FloatArray  # (3, 3) nominal ← true camera
    arm: FloatArray  # (3,) metres, added to `RigData.antenna_in_body`

    def moved(self, step: FloatArray, pivot: FloatArray) -> RigState:
        """Return the state after a step (14,), with the pivot (3,) in geo of the similarity's parameters."""
        return RigState(
            perturbation(step[SIMILARITY], pivot) @ self.geo_from_local,
            self.offset_s + float(step[OFFSET][0]),
            self.boresight @ exp_so3(step[BORESIGHT]),
            self.arm + step[ARM],
        )


@dataclass(frozen=True)
class FitOptions:
    """Options of the adjustment; the offset is searched so far on either side of its start."""

    offset: bool = True
    arm: bool = False
    max_offset_s: float = 2.0


@dataclass(frozen=True)
class RigFit:
    """Result of the adjustment."""

    state: RigState
    # (14,) σ: of the similarity (7), offset in s, boresight in rad (3), lever arm in m (3). A small error of SfM's
    # lens tilts all cameras alike, or shifts them along their view, without any residual. The σ of boresight and
    # lever arm therefore include one pixel: its angle, and its width at the scene.
    sigma: FloatArray
    images: int
    # rms_position_m and rms_attitude_deg: robust σ of the residuals per axis; attitude NaN without any
    rms_position_m: float
    rms_attitude_deg: float


def fit_rig(data: RigData, start_offset_s: float, start_boresight: FloatArray, options: FitOptions) -> RigFit:
    """Return the parameters of the rig that make SfM cameras and navigation agree.

    The boresight (3, 3), nominal ← true camera, is free if attitudes and a mount are known, so that its error does
    not affect the other parameters.

    Raises:
        DegenerateGeometryError: fewer than six images within the track, or all on one line or in one place; or the
            time offset lies at the end of its search.
    """
    data = replace(data, attitudes=_smoothed(data.attitudes))
    free = np.ones(14, dtype=bool)
    free[OFFSET], free[ARM] = options.offset, options.arm
    free[BORESIGHT] = data.has_attitudes and np.isfinite(data.cam_from_body).all(axis=(1, 2)).any()
    start = state = _start(data, start_offset_s, start_boresight, options)
    sigma_m, sigma_rad = 1.0, np.radians(2.0)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            residual, jacobian, pivot = _linearised(data, state, (sigma_m, sigma_rad), start, options)
            step = -_covariance(jacobian, free) @ jacobian.T @ residual
            state = state.moved(step, pivot)
            if np.abs(step[7:]).max() < 1e-7:
                break
        position, attitude, _ = _residuals(data, state, _usable_images(data, state.offset_s))
        # σ about zero: a mean that the residuals share counts as scatter.
        sigma_m = max(mad_sigma(np.concatenate([position, -position]).ravel()), _LEAST_SIGMA_M)
        if len(attitude):
            sigma_rad = max(mad_sigma(np.concatenate([attitude, -attitude]).ravel()), _LEAST_SIGMA_RAD)
    if options.offset and abs(state.offset_s - start_offset_s) > _INNER * options.max_offset_s:
        raise DegenerateGeometryError(
            "time-offset-at-limit",
            f"The best time offset lies at the limit of the search, {options.max_offset_s:g} s from the present "
            f"one; a larger offset may fit better.",
            remedy=f"Search further with --max-offset {_FURTHER_S:g}.",
        )
    _, jacobian, _ = _linearised(data, state, (sigma_m, sigma_rad), start, options)
    sigma = np.where(free, np.sqrt(np.diag(_covariance(jacobian, free))), np.inf)
    if options.offset:
        # Noise of the navigation looks like motion, and motion is information on the offset. The information that
        # plain noise would give is subtracted.
        known = sigma[OFFSET] ** -2 - 3 * (len(position) + len(attitude)) / (2 * _DIFFERENCE_S**2)
        sigma[OFFSET] = np.maximum(known, options.max_offset_s**-2) ** -0.5
    sigma[BORESIGHT] = np.hypot(sigma[BORESIGHT], data.pixel_rad)
    sigma[ARM] = np.hypot(sigma[ARM], state.geo_from_local.scale * data.footprint_in_local)
    left_deg = float(np.degrees(sigma_rad)) if len(attitude) else np.nan
    return RigFit(state, sigma, len(position), sigma_m, left_deg)


def _usable_images(data: RigData, offset_s: float) -> BoolArray:
    """Return the mask (n,) of the images that the navigation covers, with a margin for differentiation by time.

    Raises:
        DegenerateGeometryError: they are too few.
    """
    usable = np.ones(len(data.time_s), dtype=bool)
    for recorded in [data.positions, data.attitudes] if data.has_attitudes else [data.positions]:
        for shift in (-_DIFFERENCE_S, 0.0, _DIFFERENCE_S):
            usable &= recorded.covers(data.time_s + offset_s + shift)
    if usable.sum() < _LEAST_IMAGES:
        raise DegenerateGeometryError("rig-not-observable", _NOT_OBSERVABLE)
    return usable


def _residuals(data: RigData, state: RigState, used: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the residuals of a mask (n,) of k images, of which j have a mount, and of c control points.

    Positions (k, 3) in metres, attitudes (j, 3) in radians, axes of the camera, and control points (c, 3).
    """
    center, bodies = _cameras_by_navigation(data, state.offset_s, state.arm, used)
    position = center - state.geo_from_local.apply(data.center_in_local[used])
    control = data.control.in_geo - state.geo_from_local.apply(data.control.in_local)
    if not len(bodies):
        return position, np.empty((0, 3)), control
    mounted = np.isfinite(data.cam_from_body[used]).all(axis=(1, 2))
    from_sfm = data.cam_from_local[used][mounted] @ state.geo_from_local.rotation.T
    body_from_cam = np.swapaxes(data.cam_from_body[used][mounted], 1, 2) @ state.boresight
    return position, log_so3(from_sfm @ bodies[mounted] @ body_from_cam), control


def _cameras_by_navigation(
    data: RigData, offset_s: float, arm: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the k used cameras by the navigation: centres (k, 3) in geo, and rotations geo ← body (k, 3, 3).

    Without attitudes these are the antenna's positions, and no rotations (0, 3, 3).
    """
    time_s = data.time_s[used] + offset_s
    antenna = data.positions.at(time_s).position
    if not data.has_attitudes:
        return antenna, np.empty((0, 3, 3))
    bodies = data.attitudes.at(time_s).rotation
    return antenna - np.einsum("nij,nj->ni", bodies, data.antenna_in_body[used] + arm), bodies


def _start(data: RigData, offset_s: float, boresight: FloatArray, options: FitOptions) -> RigState:
    """Return the state at the time offset for which the shapes of the tracks agree best; the nearest wins a tie."""
    offsets = np.array([offset_s])
    if options.offset:
        steps = np.arange(-options.max_offset_s, options.max_offset_s + _SCAN_STEP_S / 2, _SCAN_STEP_S)
        offsets = offset_s + steps[np.argsort(np.abs(steps), kind="stable")]
    best: tuple[float, RigState] | None = None
    for offset in offsets.tolist():
        try:
            inside = _usable_images(data, offset)
            center, _ = _cameras_by_navigation(data, offset, np.zeros(3), inside)
            similarity = umeyama(data.center_in_local[inside], center)
        except DegenerateGeometryError:
            continue
        missed = np.linalg.norm(center - similarity.apply(data.center_in_local[inside]), axis=1)
        # Few images agree easily: images that an offset moves out of the navigation raise its cost.
        cost = float(np.median(missed)) * (1.0 + 10.0 * (1.0 - inside.mean()))
        if best is None or cost < best[0]:
            best = cost, RigState(similarity, offset, boresight, np.zeros(3))
    if best is None:
        raise DegenerateGeometryError("rig-not-observable", _NOT_OBSERVABLE)
    state = best[1]
    spread = np.linalg.svd(data.center_in_local - data.center_in_local.mean(axis=0), compute_uv=False)
    extent_m = state.geo_from_local.scale * spread / np.sqrt(len(data.center_in_local))
    if extent_m[0] < 1.0 or extent_m[1] < 0.01 * extent_m[0]:
        raise DegenerateGeometryError(
            "rig-not-observable",
            "The rig is not observable: the cameras stay within 1 m of one place, or on one line. Fly turns, and "
            "change the speed.",
        )
    return state


def _smoothed(attitudes: Trajectory) -> Trajectory:
    """Return attitudes averaged over 0.1 s on either side: white noise shrinks, while turns are kept."""
    clock = attitudes.time_s
    if len(clock) < 3:
        return attitudes
    usual_s = float(np.median(np.diff(clock)))
    half = int(_SMOOTHING_S / max(usual_s, 1e-6))
    if half < 1 or len(clock) < 4 * half:
        return attitudes
    # The rotation nearest to the mean of the matrices.
    mean = Rotation.from_matrix(uniform_filter1d(attitudes.rotation, 2 * half + 1, axis=0)).as_matrix()
    inner = np.arange(half, len(clock) - half)
    without_gap = inner[clock[2 * half :] - clock[: -2 * half] < 3 * half * usual_s]
    rotation = attitudes.rotation.copy()
    rotation[without_gap] = mean[without_gap]
    return replace(attitudes, rotation=rotation)


def _linearised(
    data: RigData, state: RigState, sigmas: tuple[float, float], start: RigState, options: FitOptions
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the whitened, weighted residuals (m,) and derivatives (m, 14) at a state, and the pivot (3,) in geo.

    `sigmas` are those of positions in metres and of attitudes in radians; `start` is the middle of the prior.
    """
    used = _usable_images(data, state.offset_s)
    pivot = state.geo_from_local.apply(data.center_in_local[used]).mean(axis=0)
    sigma, moved = np.full(14, np.inf), np.zeros(14)
    sigma[OFFSET], sigma[BORESIGHT], sigma[ARM] = options.max_offset_s, SIGMA_BORESIGHT_RAD, SIGMA_ARM_M
    moved[OFFSET] = state.offset_s - start.offset_s
    moved[BORESIGHT] = log_so3(start.boresight.T @ state.boresight)
    moved[ARM] = state.arm - start.arm
    missed = _residuals(data, state, used)
    sides = [
        (_residuals(data, state.moved(step, pivot), used), _residuals(data, state.moved(-step, pivot), used))
        for step in np.diag(_DIFFERENCES)
    ]
    whiteners = (np.eye(3) / sigmas[0], np.eye(3) / sigmas[1], _control_whitener(data, state, missed[2]))
    residuals, jacobians = [moved / sigma], [np.diag(1.0 / sigma)]
    for kind, whitener in enumerate(whiteners):
        slope = np.stack([ahead[kind] - behind[kind] for ahead, behind in sides], axis=2) / (2 * _DIFFERENCES)
        residual = (whitener @ missed[kind][..., None])[..., 0]
        root = np.sqrt(cauchy_weight((residual**2).sum(axis=1), 3))[:, None]
        residuals.append((root * residual).ravel())
        jacobians.append((root[..., None] * (whitener @ slope)).reshape(-1, 14))
    return np.concatenate(residuals), np.concatenate(jacobians), pivot


def _covariance(jacobian: FloatArray, free: BoolArray) -> FloatArray:
    """Return the covariance (14, 14) of the parameters from derivatives (m, 14); zero for the frozen ones."""
    covariance, of_free = np.zeros((14, 14)), jacobian[:, free]
    covariance[np.ix_(free, free)] = covariance_of(of_free, 1.0 / np.linalg.norm(of_free, axis=0))
    return covariance


def _control_whitener(data: RigData, state: RigState, missed: FloatArray) -> FloatArray:
    """Return the matrices (c, 3, 3) that whiten the residuals (c, 3) of the control points.

    The SfM model bends. If the control points scatter more than the covariances of marks and survey, these
    covariances are scaled up to the scatter.
    """
    turn = state.geo_from_local.scale * state.geo_from_local.rotation
    cov = data.control.cov_in_geo + turn @ data.control.cov_in_local @ turn.T
    squared = squared_mahalanobis(missed, cov)
    excess = max(1.0, float(np.median(squared)) / median_chi2(3)) if len(squared) else 1.0
    return root_information(excess * cov)
