"""Patterns that a lag and a lever arm leave in the fixes, against the motion of the SfM cameras.

A position that a drone writes into a photograph may be that of a moment before or after the exposure, and that of
its antenna. With the fixes p at times t, the similarity geo ← local (s, R, t), the path c of the SfM cameras, the
lag τ and the arm a (forward and right of the camera's level heading H):

    p(t) = s R c(t − τ) + t + H(t) a

1. The path is a spline through the cameras of one leg: a long pause begins another.
2. The lag is searched where the shape of the path fits best. Gauss–Newton then solves for all, reweighted by
   Cauchy's kernel. σ are those of the residuals, widened by what neighbours in time have in common.
3. A pattern counts if its price is paid: −2 ln likelihood falls by more than new unknowns of noise lower it, and
   its estimate is several times its σ. Flights in one direction, hovers and circles at one speed leave a lag open;
   one circle about what all cameras look at leaves an arm open, because another scale explains it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from pipelines.adjust.alignment import covariance_of
from pipelines.adjust.hypotheses import fit, hangs_upside_down
from pipelines.adjust.measurements import fix_correspondences
from pipelines.adjust.state import SIGMA_ARM_M
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import cauchy_weight, outlier_gate, root_information
from pipelines.survey.survey import Survey

_LEAST_IMAGES = 8
_LEG_STEPS, _LEG_PAUSE_S = 2.5, 3.0  # usual intervals, and seconds, beyond which a leg ends
_LEAST_SEARCH_S, _MOST_LAG_S, _SCAN_STEP_S = 1.2, 3.0, 0.1
_PRIOR_LAG_S = 5.0  # wide: it keeps what is open finite
_USUAL_LAG_S, _USUAL_ARM_M = 1.0, 0.5
_STEPS, _WIDE, _NARROWING = 25, 16.0, 0.6
_LEAST_SIGMA_M = 1e-3
_MOST_CORRELATION = 0.8
_AGREES, _BETTER = 2.0, 0.7  # σ that a lag leaves, or part of the scatter without it
_INNER = 0.9  # part of the search whose end is no answer
_SIGNIFICANT = 4.0  # σ of an estimate that counts
_GATE = outlier_gate(3)
_LAG, _ARM = slice(7, 8), slice(8, 10)


@dataclass(frozen=True)
class FixPattern:
    """Lag and lever arm of the fixes of n photographs.

    Attributes:
        name: of the photographs (n,).
        lag_s, sigma_lag_s: positions are those of so many seconds before the exposure; σ is infinite where open.
        arm_m, sigma_arm_m: antenna from the camera (2,), forward and right of the camera's heading, metres.
        has_lag, has_arm: whether the residuals have the pattern.
        velocity_in_geo: (n, 3) metres a second, zero where unknown.
        geo_from_local: similarity without the patterns' errors.
        scatter_m: robust σ of the residuals along each horizontal axis, without and with the patterns.
        distance_m: (n,) of the corrected fixes from the SfM model.
    """

    name: tuple[str, ...]
    lag_s: float
    sigma_lag_s: float
    arm_m: FloatArray
    sigma_arm_m: FloatArray
    has_lag: bool
    has_arm: bool
    velocity_in_geo: FloatArray
    geo_from_local: Similarity
    scatter_m: tuple[float, float]
    distance_m: FloatArray


@dataclass(frozen=True)
class _Data:
    """Fixes of n photographs, and the SfM cameras in the order of time."""

    position: FloatArray  # (n, 3) in geo
    root: FloatArray  # (n, 3, 3) that whitens by the stated covariance
    center: FloatArray  # (n, 3) in local
    local_from_cam: FloatArray  # (n, 3, 3)
    time_s: FloatArray  # (n,)
    path: CameraPath
    pixel: float  # width of a pixel at the scene, in local: SfM's own error along its views


class CameraPath:
    """The path of the cameras in local, by legs without a long pause."""

    def __init__(self, time_s: FloatArray, center: FloatArray) -> None:
        """Take times (n,), increasing, and centres (n, 3); photographs of one instant share the first's path."""
        self.time_s = time_s
        apart_s = np.diff(time_s)
        moving = apart_s[apart_s > 1e-3]
        pause_s = max(_LEG_PAUSE_S, _LEG_STEPS * float(np.median(moving))) if len(moving) else np.inf
        # From one photograph's place to the next one's, a lag is told from rows that are off by one no more.
        usual_s = float(np.median(moving)) if len(moving) else 0.0
        self.most_lag_s = min(_MOST_LAG_S, max(_LEAST_SEARCH_S, usual_s))
        self.leg = np.concatenate([[0], np.cumsum(apart_s > pause_s)])
        self.noise = np.zeros(len(time_s))  # of the velocity along an axis
        self.curves: dict[int, tuple[float, float, CubicSpline]] = {}
        for leg in np.unique(self.leg):
            rows = np.flatnonzero(self.leg == leg)
            rows = rows[np.diff(time_s[rows], prepend=-np.inf) > 1e-3]
            if len(rows) >= 2:
                clock = time_s[rows]
                self.noise[rows] = _unresolved(clock, center[rows])
                curve = CubicSpline(clock, center[rows], bc_type="not-a-knot" if len(rows) > 3 else "natural")
                self.curves[int(leg)] = (float(clock[0]), float(clock[-1]), curve)

    @property
    def known(self) -> BoolArray:
        """Return which photographs (n,) are on a leg."""
        return np.array([int(leg) in self.curves for leg in self.leg])

    def moved(self, lag_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (n, 3) to where the camera was a lag before, and its velocity (n, 3) there."""
        shift, velocity = np.zeros((len(self.leg), 3)), np.zeros((len(self.leg), 3))
        for leg, (first_s, last_s, curve) in self.curves.items():
            rows = np.flatnonzero(self.leg == leg)
            when = self.time_s[rows] - lag_s
            inside = np.clip(when, first_s, last_s)
            velocity[rows] = curve(inside, 1)
            shift[rows] = curve(inside) + (when - inside)[:, None] * velocity[rows] - curve(self.time_s[rows])
        return shift, velocity


def _unresolved(time_s: FloatArray, center: FloatArray) -> FloatArray:
    """Return the σ (n,) of velocities along an axis, by how far a path misses the places that it leaves out."""
    noise = np.zeros(len(time_s))
    for row in range(2, len(time_s) - 2):
        near = [row - 2, row - 1, row + 1, row + 2]
        at = (time_s[near] - time_s[row]) / (time_s[row + 1] - time_s[row - 1])
        # Lagrange's polynomial of the four neighbours, at the place between them.
        part = np.array([np.prod([at[k] / (at[k] - at[j]) for k in range(4) if k != j]) for j in range(4)])
        missed = center[row] - part @ center[near]
        alone = float((missed**2).mean() / (1.0 + (part**2).sum()))
        noise[row] = np.sqrt(alone) / ((time_s[row + 1] - time_s[row - 1]) / 2.0)
    return noise


def pattern_of(survey: Survey, model: SparseModel) -> FixPattern | None:
    """Return lag and lever arm of a survey's fixes; None: too few have a time, or they lie on one line."""
    gathered = _gathered(survey, model)
    if gathered is None:
        return None
    name, data = gathered
    try:
        start = _start(data)
        fits = {
            kind: _fitted(data, start, *kind)
            for kind in ((False, False), (True, False), (False, True), (True, True))
        }
    except DegenerateGeometryError:
        return None
    upright = {
        kind: one for kind, one in fits.items() if not any(kind) or not hangs_upside_down(model, one.similarity)
    }
    chosen = _chosen(upright, data)
    plain, best = fits[False, False], fits[chosen]
    # What is no part of the pattern is told by the fit that adds it.
    of_lag, of_arm = fits[True, chosen[1]], fits[chosen[0], True]
    return FixPattern(
        name=name,
        lag_s=of_lag.lag_s,
        # A lag without which the residuals are evidently larger is known to half of itself, whatever noise tells.
        sigma_lag_s=min(of_lag.sigma_lag_s, abs(of_lag.lag_s) / 2.0) if chosen[0] else of_lag.sigma_lag_s,
        arm_m=of_arm.arm_m,
        sigma_arm_m=np.hypot(of_arm.sigma[_ARM], best.similarity.scale * data.pixel),
        has_lag=chosen[0],
        has_arm=chosen[1],
        velocity_in_geo=best.velocity,
        geo_from_local=best.similarity,
        scatter_m=(_horizontal(plain.residual), _horizontal(best.residual)),
        distance_m=np.linalg.norm(best.residual, axis=1),
    )


def _horizontal(residual: FloatArray) -> float:
    return _spread(residual[:, :2])


def _gathered(survey: Survey, model: SparseModel) -> tuple[tuple[str, ...], _Data] | None:
    fixes = fix_correspondences(survey, model)
    times = {image.name: image.timestamp_s for image in survey.images}
    time_s = np.array([times[name] for name in fixes.name], dtype=np.float64)
    rows = np.argsort(time_s, kind="stable")
    rows = rows[np.isfinite(time_s[rows])]
    if len(rows) < _LEAST_IMAGES or np.ptp(time_s[rows]) < 1.0:
        return None
    index = model.image_index()
    cameras = [index[fixes.name[row]] for row in rows]
    center = fixes.in_local[rows]
    data = _Data(
        position=fixes.in_geo[rows],
        root=root_information(fixes.cov_in_geo[rows]),
        center=center,
        local_from_cam=np.swapaxes(model.rotation_cam_from_local[cameras], 1, 2),
        time_s=time_s[rows],
        path=CameraPath(time_s[rows], center),
        pixel=_pixel_at_scene(model),
    )
    return (tuple(fixes.name[row] for row in rows), data) if data.path.known.sum() >= _LEAST_IMAGES else None


def _pixel_at_scene(model: SparseModel) -> float:
    distance = np.linalg.norm(
        model.point_in_local[model.obs_point] - model.cam_center_in_local[model.obs_image], axis=1
    )
    return float(np.median(distance / model.focal_px[model.obs_image])) if len(distance) else 0.0


def _start(data: _Data) -> tuple[Similarity, float, Similarity]:
    """Return the similarity without a lag, and the lag with its similarity at which the path fits best."""
    plain = fit(data.center, data.position)[0]
    best: tuple[float, float, Similarity] | None = None
    most_s = data.path.most_lag_s
    for lag_s in sorted(np.arange(-most_s, most_s + 1e-9, _SCAN_STEP_S).tolist(), key=abs):
        similarity, scatter = fit(data.center + data.path.moved(lag_s)[0], data.position)
        if best is None or scatter < 0.999 * best[0]:
            best = scatter, lag_s, similarity
    assert best is not None
    return plain, best[1], best[2]


@dataclass(frozen=True)
class _Fit:
    similarity: Similarity
    lag_s: float
    arm_m: FloatArray  # (2,)
    sigma: FloatArray  # (10,)
    residual: FloatArray  # (n, 3) in geo
    white: FloatArray  # (n, 3) whitened by the stated covariances
    velocity: FloatArray  # (n, 3)
    common: float  # factor of variances by which neighbours in time are alike
    sigma_lag_s: float  # without what the path's own noise tells


def _fitted(data: _Data, start: tuple[Similarity, float, Similarity], with_lag: bool, with_arm: bool) -> _Fit:
    """Return the adjustment of similarity, and of lag and arm where they are free."""
    similarity, lag_s, arm = (start[2], start[1], np.zeros(2)) if with_lag else (start[0], 0.0, np.zeros(2))
    free = np.ones(10, dtype=bool)
    free[_LAG], free[_ARM] = with_lag, with_arm
    prior = np.full(10, np.inf)
    prior[_LAG], prior[_ARM] = _PRIOR_LAG_S, SIGMA_ARM_M
    pivot = similarity.apply(data.center).mean(axis=0)
    for number in range(_STEPS):
        residual, jacobian, velocity = _linearised(data, similarity, lag_s, arm, pivot)
        white = np.einsum("nij,nj->ni", data.root, residual)
        # The kernel narrows, and heights get a σ of their own last: else a start without the pattern holds, whose
        # residuals are large in one axis or in some photographs.
        width = max(1.0, _WIDE * _NARROWING**number)
        parts = (white, white) if width > 1.0 else (white[:, :2], white[:, 2:])
        scale = np.array([_spread(parts[0]), _spread(parts[0]), _spread(parts[1])])
        scaled = white / scale
        weight = np.sqrt(cauchy_weight((scaled**2).sum(axis=1) / width**2, 3))[:, None]
        rows = (weight[..., None] * (data.root @ jacobian) / scale[:, None]).reshape(-1, 10)
        design = np.vstack([rows, np.diag(1.0 / prior)])[:, free]
        missed = np.concatenate([(weight * scaled).ravel(), -np.concatenate([np.zeros(7), [lag_s], arm]) / prior])
        step = np.zeros(10)
        step[free] = np.linalg.lstsq(design, missed, rcond=None)[0]
        similarity = perturbation(step[:7], pivot) @ similarity
        lag_s = float(np.clip(lag_s + step[7], -data.path.most_lag_s, data.path.most_lag_s))
        arm = arm + step[_ARM]
        if width == 1.0 and np.abs(step).max() < 1e-6:
            break
    residual, jacobian, velocity = _linearised(data, similarity, lag_s, arm, pivot)
    white = np.einsum("nij,nj->ni", data.root, residual)
    common = _common(scaled)
    sigma = np.full(10, np.inf)
    redundancy = max(1.0 - free.sum() / (3.0 * len(residual)), 0.1)
    covariance = covariance_of(design, 1.0 / np.linalg.norm(design, axis=0))
    sigma[free] = np.sqrt(np.diag(covariance) * common / redundancy)
    # Motion that the photographs are too far apart to show looks like information on the lag, as noise does.
    by_noise = np.minimum(data.path.noise**2, (velocity**2).sum(axis=1) / 3.0) * similarity.scale**2
    information = (np.square(weight * np.linalg.norm(data.root, axis=2) / scale) * by_noise[:, None]).sum()
    known = sigma[_LAG][0] ** -2 - redundancy * information / common
    sigma_lag_s = float(np.maximum(known, _PRIOR_LAG_S**-2) ** -0.5) if with_lag else np.inf
    return _Fit(similarity, lag_s, arm, sigma, residual, white, velocity, common, sigma_lag_s)


def _linearised(
    data: _Data, similarity: Similarity, lag_s: float, arm: FloatArray, pivot: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (n, 3), derivatives (n, 3, 10) of what explains them, and velocities (n, 3) in geo."""
    shift, velocity_in_local = data.path.moved(lag_s)
    mapped = similarity.apply(data.center + shift)
    velocity = similarity.scale * velocity_in_local @ similarity.rotation.T
    axes = level_axes(similarity.rotation @ data.local_from_cam)
    jacobian = np.concatenate([jacobian_at(mapped, pivot), -velocity[..., None], axes], axis=2)
    return data.position - mapped - axes @ arm, jacobian, velocity


def level_axes(geo_from_cam: FloatArray) -> FloatArray:
    """Return forward and right (n, 3, 2), level, of cameras with rotations geo ← camera (n, 3, 3).

    Forward is where the camera looks, or, looking down, where the top of its picture is.
    """
    forward = geo_from_cam[:, :, 2] - geo_from_cam[:, :, 1]
    forward[:, 2] = 0.0
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    right = np.column_stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))])
    return np.stack([forward, right], axis=2)


def _spread(white: FloatArray) -> float:
    """Return the robust σ about zero of whitened residuals."""
    return max(float(np.median(np.abs(white))) / 0.6745, _LEAST_SIGMA_M)


def _common(scaled: FloatArray) -> float:
    """Return the factor of variances of a mean by which residuals (n, 3) in the order of time are correlated."""
    bounded = np.clip(scaled[:, :2], -3.0, 3.0)
    correlation = float((bounded[1:] * bounded[:-1]).sum() / max((bounded**2).sum(), 1e-12))
    correlation = min(max(correlation, 0.0), _MOST_CORRELATION)
    return (1.0 + correlation) / (1.0 - correlation)


def _chosen(fits: dict[tuple[bool, bool], _Fit], data: _Data) -> tuple[bool, bool]:
    """Return whether lag and arm are patterns of the fixes: of all choices, that of the least cost."""
    scale = min(max(_spread(one.white), 1.0) for one in fits.values())
    common = min(one.common for one in fits.values())
    of_one = float(np.log(3.0 * len(data.time_s)))

    def cost(kind: tuple[bool, bool]) -> float:
        squared = (fits[kind].white ** 2).sum(axis=1) / (scale**2 * common)
        # A long arm and a lag are one pattern on lines with the nose ahead: drones have lags rather than masts.
        unlikely = (fits[kind].lag_s / _USUAL_LAG_S) ** 2 + float((fits[kind].arm_m ** 2).sum()) / _USUAL_ARM_M**2
        return float(np.minimum(squared, _GATE).sum()) + of_one * (kind[0] + 2 * kind[1]) + unlikely

    def counts(kind: tuple[bool, bool]) -> bool:
        one = fits[kind]
        lag = not kind[0] or _SIGNIFICANT * one.sigma[_LAG][0] < abs(one.lag_s) < _INNER * data.path.most_lag_s
        if kind[0]:  # A model that is bent, or fixes of other photographs, leave most of the scatter with any lag.
            without = fits.get((False, kind[1]), one)
            falls = _horizontal(one.residual) < _BETTER * _horizontal(without.residual)
            lag = lag and (falls or _spread(one.white) < _AGREES)
        sigma = np.hypot(one.sigma[_ARM], one.similarity.scale * data.pixel)
        arm = not kind[1] or bool((np.abs(one.arm_m) > _SIGNIFICANT * sigma).any())
        return lag and arm

    return min((kind for kind in fits if counts(kind)), key=cost)
