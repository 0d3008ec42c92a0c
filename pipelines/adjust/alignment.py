"""Similarity `geo_from_local` without an initial value: starts, robust adjustment, and choice of the solution.

Every residual is whitened by its covariance. Sources of information:

1. Camera centres against GNSS fixes, and control points against their survey. Their errors are independent.
2. Attitudes, only if centres and control points leave the rotation open (a single straight flight line). Their
   errors (boresight, compass) are mostly common to a flight and do not average out. The mean of all attitudes
   therefore has the σ of one.

The intersected points are *not* a third source. Each is a function of the same few fixes and attitudes: a hundred
thousand points have no more information than the cameras. Counted as independent, they would claim σ of
millimetres, and an error of the compass would outweigh RTK. They serve as a check.

Fixes against control points:

1. Fixes of a flight often share an offset (base station, datum, antenna height). A solution with a common bias of
   the fixes therefore competes by likelihood with one without. The bias costs as much as one outlier.
2. If the fixes disagree with control points that agree with each other by more than σ allow, the control points
   determine the position. The fixes still determine scale and rotation.
3. A *single* control point that disagrees stays an outlier, because a bias costs no less. Only the joint
   adjustment, with its prior of common errors, can decide between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, Rows, joined_rows, rows_of
from pipelines.geometry import statistics
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation, umeyama

OUTLIER_GATE = statistics.outlier_gate(3)
_LEAST_FOR_EXCESS = 5  # points of a kind; the scatter of fewer is too uncertain
_STEPS = 12
_OPEN = 1e-12  # eigenvalue over the largest one, below which nothing determines a direction
_WORST_ROTATION_RAD = np.radians(5.0)  # beyond, the linear covariance is not valid
_NARROW = 0.1  # second extent of a line over the first
_FLAT = 0.02  # third extent of the layout over the first
_GATE_FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # of the stated σ

_REMEDY = (
    "Add at least three control points that are not on one line (`georef ingest --gcp FILE`), or attitudes (yaw, "
    "pitch, roll of the camera) in the trajectory."
)


@dataclass(frozen=True)
class Correspondences(Rows):
    """n points known in both frames."""

    name: tuple[str, ...]
    control: BoolArray  # (n,) control point (True) or camera centre (False)
    in_local: FloatArray  # (n, 3), in units of local
    cov_in_local: FloatArray  # (n, 3, 3), in squared units of local
    in_geo: FloatArray  # (n, 3) metres, as measured
    cov_in_geo: FloatArray  # (n, 3, 3) m²

    def part(self, chosen: BoolArray) -> Correspondences:
        """Return the correspondences that a mask (n,) selects."""
        return replace(rows_of(self, chosen), name=tuple(compress(self.name, chosen)))

    def joined(self, other: Correspondences) -> Correspondences:
        return replace(joined_rows([self, other]), name=self.name + other.name)


@dataclass(frozen=True)
class RotationPrior:
    """Measured rotation (3, 3) geo ← local, with its covariance (3, 3) in rad², axes of geo."""

    rotation: FloatArray
    cov_rad2: FloatArray


def turn_against(prior: RotationPrior, similarity: Similarity) -> float:
    """Return the angle in rad between a measured rotation and that of a similarity geo ← local."""
    return float(np.linalg.norm(log_so3(prior.rotation @ similarity.rotation.T)))


@dataclass(frozen=True)
class SimilarityState:
    """Unknowns of the adjustment, with the inliers (n,) and the excess scatter.

    The bias (3,) is fix minus truth, in metres; None if it is not estimated. The excess is the σ per axis beyond
    the stated one, of fixes and of control points.
    """

    geo_from_local: Similarity
    inlier: BoolArray
    fix_bias_in_geo: FloatArray | None = None
    excess_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class AdjustedSimilarity:
    """Solution of the adjustment, with its covariance, residuals and cost."""

    state: SimilarityState
    covariance: FloatArray  # (7, 7) about `pivot`, (3,) in geo; see `SimilarityRecord`
    pivot: FloatArray
    # (n, 7, 3) change of the parameters per metre of error of each measured position
    response: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)  # (n, 3) metres, measured (less bias) minus mapped
    squared: FloatArray = field(repr=False)
    cost: float  # −2 ln likelihood, with outliers at the cost of the gate; compares solutions of the same data
    condition_number: float  # of the normal matrix, with angles and ln s scaled by the size of the layout

    @property
    def rotation_sigma_rad(self) -> float:
        """σ of the rotation about its least determined axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[1:4, 1:4])[-1]))


def adjust(data: Correspondences, start: SimilarityState, prior: RotationPrior | None) -> AdjustedSimilarity:
    """Return the robust solution, from a start near it.

    Each round has three steps:

    1. Gate the outliers at 0.1 %.
    2. Solve for the parameters.
    3. Estimate the excess scatter of each kind: SfM's own errors, and σ that were stated too small (after Paule
       and Mandel, doi 10.6028/jres.087.022).

    The bias of the fixes is estimated if the start has one.
    """
    state = _rescaled(data, start, robust=True)
    for _ in range(_STEPS):
        state = _gated(data, state)
        solution = _solve(data, state, prior)
        before, state = state, _rescaled(data, solution.state, robust=False)
        same = np.array_equal(_gated(data, state).inlier, before.inlier)
        if same and np.allclose(state.excess_m, before.excess_m, rtol=0.01, atol=1e-5):
            break
    return _solve(data, state, prior)


def residuals(data: Correspondences, state: SimilarityState) -> FloatArray:
    """Return the residuals (n, 3) in metres: measured minus mapped position, the fixes less their bias."""
    residual = data.in_geo - state.geo_from_local.apply(data.in_local)
    if state.fix_bias_in_geo is not None:
        residual = residual - np.where(data.control[:, None], 0.0, state.fix_bias_in_geo)
    return np.asarray(residual)


def residual_covariances(data: Correspondences, state: SimilarityState) -> FloatArray:
    """Return the covariances (n, 3, 3) of the residuals in m²: measurement, mapped point of local, and excess."""
    turn = state.geo_from_local.scale * state.geo_from_local.rotation
    excess = np.where(data.control, state.excess_m[1], state.excess_m[0])
    cov = data.cov_in_geo + turn @ data.cov_in_local @ turn.T
    return np.asarray(cov + excess[:, None, None] ** 2 * np.eye(3))


def _gated(data: Correspondences, state: SimilarityState) -> SimilarityState:
    squared = statistics.squared_mahalanobis(residuals(data, state), residual_covariances(data, state))
    inlier = squared <= OUTLIER_GATE
    if inlier.sum() < 3:  # a similarity needs three
        inlier = squared <= np.sort(squared)[min(2, len(squared) - 1)]
    return replace(state, inlier=inlier)


def _solve(data: Correspondences, state: SimilarityState, prior: RotationPrior | None) -> AdjustedSimilarity:
    """Return the Gauss–Newton solution of the inliers, with excess and inliers frozen."""
    for _ in range(_STEPS):
        linear = _linearised(data, state, prior)
        every = covariance_of(linear.jacobian, linear.unit)
        step = every @ linear.jacobian.T @ linear.residual
        bounded = np.concatenate([np.clip(step[:1], -1.0, 1.0), step[1:7]])
        bias = None if state.fix_bias_in_geo is None else state.fix_bias_in_geo + step[7:10]
        moved = perturbation(bounded, linear.pivot) @ state.geo_from_local
        state = replace(state, geo_from_local=moved, fix_bias_in_geo=bias)
        if np.abs(step / linear.unit).max() < 1e-9:
            break
    residual, cov = residuals(data, state), residual_covariances(data, state)
    squared = statistics.squared_mahalanobis(residual, cov)
    stretch = np.linalg.slogdet(cov)[1] - np.linalg.slogdet(data.cov_in_geo)[1]
    of_positions = linear.jacobian[: 3 * len(data)].reshape(len(data), 3, -1)
    return AdjustedSimilarity(
        state=state,
        covariance=every[:7, :7],
        pivot=linear.pivot,
        response=every[:7] @ np.swapaxes(of_positions, 1, 2) @ linear.whitener,
        residual=residual,
        squared=squared,
        cost=float(np.where(state.inlier, squared + stretch, OUTLIER_GATE).sum()),
        condition_number=float(np.linalg.cond(every / np.outer(linear.unit, linear.unit))),
    )


def covariance_of(jacobian: FloatArray, unit: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of P parameters from the derivatives (m, P) of whitened observations.

    A direction that the observations leave open gets a wide, but finite variance. A step of `unit` (P,) changes the
    observations about as much for each parameter.
    """
    scaled = jacobian * unit
    value, vector = np.linalg.eigh(scaled.T @ scaled)
    inverse = (vector / np.maximum(value, _OPEN * value[-1])) @ vector.T
    return np.asarray(inverse * np.outer(unit, unit))


@dataclass(frozen=True)
class _Linearised:
    """Whitened observations near a state: the n positions, and the measured rotation if there is one."""

    residual: FloatArray  # (m,), measured minus computed
    jacobian: FloatArray  # (m, P) of what is computed; P = 7, or 10 with a bias
    whitener: FloatArray  # (n, 3, 3), W with WᵀW = Σ⁻¹; zero for outliers
    pivot: FloatArray  # (3,)
    unit: FloatArray  # (P,), step of each parameter that moves the positions by about a metre


def _linearised(data: Correspondences, state: SimilarityState, prior: RotationPrior | None) -> _Linearised:
    mapped = state.geo_from_local.apply(data.in_local)
    whitener = statistics.root_information(residual_covariances(data, state))
    whitener = whitener * state.inlier[:, None, None]
    weight = (whitener**2).sum(axis=(1, 2))
    pivot = weight @ mapped / weight.sum()
    size_m = np.sqrt(weight @ ((mapped - pivot) ** 2).sum(axis=1) / weight.sum())
    by_bias = np.where(data.control[:, None, None], 0.0, np.eye(3))
    jacobian = np.concatenate([jacobian_at(mapped, pivot), by_bias], axis=2)
    if state.fix_bias_in_geo is None:
        jacobian = jacobian[:, :, :7]
    residual = (whitener @ residuals(data, state)[..., None]).ravel()
    jacobian = (whitener @ jacobian).reshape(len(residual), -1)
    if prior is not None:
        root = statistics.root_information(prior.cov_rad2)
        turn = log_so3(prior.rotation @ state.geo_from_local.rotation.T)
        residual = np.concatenate([residual, root @ turn])
        jacobian = np.concatenate([jacobian, root @ np.eye(3, jacobian.shape[1], 1)])
    unit = np.ones(jacobian.shape[1])
    unit[:4] = 1.0 / max(size_m, 1e-9)
    return _Linearised(residual, jacobian, whitener, pivot, unit)


def _rescaled(data: Correspondences, state: SimilarityState, *, robust: bool) -> SimilarityState:
    """Return the state with the excess scatter of each kind estimated anew: of all, robustly, or of the inliers."""
    members = state.inlier | robust
    fixes, control = (_excess(data, state, members & (data.control == kind), robust) for kind in (False, True))
    return replace(state, excess_m=(fixes, control))


def _excess(data: Correspondences, state: SimilarityState, members: BoolArray, robust: bool) -> float:
    """Return the σ per axis that makes the scatter of the members agree with their covariances; at least 0."""
    if members.sum() < _LEAST_FOR_EXCESS:
        return 0.0
    stated = replace(state, excess_m=(0.0, 0.0))
    residual, cov = residuals(data, state)[members], residual_covariances(data, stated)[members]
    variances, axes = np.linalg.eigh(cov)
    along = (np.swapaxes(axes, 1, 2) @ residual[..., None])[..., 0] ** 2
    # The seven parameters absorb a part of the scatter: their redundancy is left.
    free = 1 - 7 / (3 * max(int(state.inlier.sum()), _LEAST_FOR_EXCESS))

    def surplus(sigma: float) -> float:
        squared = (along / (variances + sigma**2)).sum(axis=1)
        return float(np.median(squared) / statistics.median_chi2(3) if robust else squared.mean() / 3) - free

    # With the largest residual as σ, each whitened square is at most 1, and the surplus negative.
    largest = float(np.linalg.norm(residual, axis=1).max())
    return 0.0 if surplus(0.0) <= 0 else float(brentq(surplus, 0.0, largest))


@dataclass(frozen=True)
class Alignment:
    """Similarity, with the layout of the correspondences used; "line" if the attitudes resolved the rotation."""

    solution: AdjustedSimilarity
    layout: Literal["volume", "plane", "line"]

    @property
    def geo_from_local(self) -> Similarity:
        return self.solution.state.geo_from_local


def align(data: Correspondences, rng: np.random.Generator, *, attitude: RotationPrior | None = None) -> Alignment:
    """Return the similarity that maps local onto geo.

    The rotation geo ← local of recorded attitudes serves layouts that need it.

    Raises:
        DegenerateGeometryError: the correspondences leave the similarity open; advises measurements to add.
    """
    if len(data) < 2 or (len(data) < 3 and attitude is None):
        raise DegenerateGeometryError(
            "too-few-positions",
            f"{len(data)} fixes of registered images and control points can be used; at least three fixes or "
            f"control points are needed.",
            remedy=_REMEDY,
        )
    # Starts of the fixes and of the control points, else of both together.
    parts = [data.part(members) for members in (~data.control, data.control) if members.sum() >= 3]
    starts = [start for part in parts for start in _ransac_start(part, rng)] or _ransac_start(data, rng)
    candidates = _candidates(data, starts, None)
    firm = [candidate for candidate in candidates if candidate.rotation_sigma_rad <= _WORST_ROTATION_RAD]
    prior = None
    if not firm:
        if attitude is None:
            raise _open_rotation(data, candidates)
        prior, firm = attitude, _candidates(data, [_start_with_rotation(data, attitude.rotation, rng)], attitude)
    # A bias of the fixes costs as much as an outlier. Where both explain a single control point, rounding must not
    # decide: it is the outlier.
    best = min(firm, key=lambda one: one.cost + 1.001 * OUTLIER_GATE * (one.state.fix_bias_in_geo is not None))
    return Alignment(best, "line" if prior else layout_of(data.in_local[best.state.inlier]))


def _open_rotation(data: Correspondences, candidates: Sequence[AdjustedSimilarity]) -> DegenerateGeometryError:
    """Return the error of positions that leave the rotation open: a line, or a block that is small against their σ.

    The shape in `local` decides, which SfM knows far better than the positions know theirs.
    """
    worst = min((np.degrees(candidate.rotation_sigma_rad) for candidate in candidates), default=np.inf)
    size = f"has a σ of {worst:.0f}°" if worst < 90 else "is not determined"
    centred = data.in_local - data.in_local.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    if len(data) < 3 or extent[1] < _NARROW * extent[0] or not candidates:
        return DegenerateGeometryError(
            "positions-on-a-line",
            f"The positions lie on one line, and the rotation about it {size}.",
            remedy=_REMEDY,
        )
    scale = candidates[0].state.geo_from_local.scale
    length_m, width_m = (scale * float(np.ptp(centred @ axis)) for axis in axes[:2])
    variance = np.median(np.diagonal(data.cov_in_geo, axis1=1, axis2=2), axis=0)
    sigma_h_m, sigma_v_m = float(np.sqrt(variance[:2].mean())), float(np.sqrt(variance[2]))
    options = [] if data.control.all() else ["--sigma-h and --sigma-v of the positions"]
    options += ["--sigma-gcp-h and --sigma-gcp-v of the control points"] if data.control.any() else []
    measured = "control points" if data.control.all() else "positions"
    return DegenerateGeometryError(
        "block-too-small",
        f"The {len(data)} {measured} span {length_m:.0f} × {width_m:.0f} m, which is small against their σ of "
        f"{sigma_h_m:.2g} m horizontally and {sigma_v_m:.2g} m vertically: the rotation of the block {size}, and "
        f"more than {np.degrees(_WORST_ROTATION_RAD):.0f}° are not used.",
        remedy=f"State better σ if they are known ({', '.join(options)}). {_REMEDY}",
    )


def layout_of(positions: FloatArray) -> Literal["volume", "plane"]:
    """Return whether positions (n, 3) fill a volume or lie in one plane."""
    extent = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return "plane" if len(extent) < 3 or extent[2] < _FLAT * extent[0] else "volume"


def mean_rotation(rotations: FloatArray, sigma_rad: FloatArray) -> RotationPrior:
    """Return the robust mean of rotations (k, 3, 3) geo ← local of recorded attitudes, with σ (k,) per axis.

    Attitude errors of a flight are mostly common to all its images. The covariance is therefore that of one
    rotation, or the scatter if it is larger.
    """
    # Start at the rotation with the least median angle to a sample of all rotations.
    others = rotations[:: max(1, len(rotations) // 200)]
    cosine = (np.einsum("aij,bij->ab", rotations, others) - 1) / 2
    mean = rotations[int(np.argmin(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1)))]
    weight = np.ones(len(rotations))
    for _ in range(20):
        error = log_so3(rotations @ mean.T)
        weight = statistics.cauchy_weight((error**2).sum(axis=1) / sigma_rad**2, 3) / sigma_rad**2
        step = weight @ error / weight.sum()
        mean = exp_so3(step) @ mean
        if np.linalg.norm(step) < 1e-12:
            break
    scatter = float(
        np.median(np.linalg.norm(log_so3(rotations @ mean.T), axis=1)) / np.sqrt(statistics.median_chi2(3))
    )
    return RotationPrior(mean, max(float(np.median(sigma_rad)), scatter) ** 2 * np.eye(3))


def _ransac_start(data: Correspondences, rng: np.random.Generator) -> list[Similarity]:
    """Return the similarity of RANSAC at the tightest gate that half of the points pass; none if degenerate."""
    starts = []
    for factor in _GATE_FACTORS:
        # The excess scatter of SfM is not known yet: the stated σ may be far too small.
        options = statistics.RansacOptions(3, OUTLIER_GATE * factor**2, max_draws=300)
        try:
            result = statistics.ransac(
                len(data),
                lambda chosen: umeyama(data.in_local[chosen], data.in_geo[chosen]),
                lambda model: _squared(data, model),
                options,
                rng,
            )
        except DegenerateGeometryError:
            return []
        starts = [result.model]
        if result.inlier.mean() > 0.5:
            with suppress(DegenerateGeometryError):
                starts = [umeyama(data.in_local[result.inlier], data.in_geo[result.inlier])]
            break
    return starts


def _start_with_rotation(data: Correspondences, rotation: FloatArray, rng: np.random.Generator) -> Similarity:
    turned = data.in_local @ rotation.T

    def fit(chosen: np.ndarray) -> Similarity:
        (a, b), (p, q) = turned[chosen], data.in_geo[chosen]
        scale = float((b - a) @ (q - p) / max((b - a) @ (b - a), np.finfo(float).tiny))
        if scale <= 0:
            raise DegenerateGeometryError("positions-reversed", "Two positions lie in reverse order.")
        return Similarity(scale, rotation, (p + q - scale * (a + b)) / 2)

    options = statistics.RansacOptions(2, OUTLIER_GATE * _GATE_FACTORS[-1] ** 2, max_draws=300)
    return statistics.ransac(len(data), fit, lambda model: _squared(data, model), options, rng).model


def _squared(data: Correspondences, model: Similarity) -> FloatArray:
    state = SimilarityState(model, np.ones(len(data), dtype=bool))
    return statistics.squared_mahalanobis(residuals(data, state), residual_covariances(data, state))


def _candidates(
    data: Correspondences, starts: list[Similarity], prior: RotationPrior | None
) -> list[AdjustedSimilarity]:
    everything = np.ones(len(data), dtype=bool)
    states = [SimilarityState(start, everything) for start in starts]
    if data.control.any() and not data.control.all():
        states += [_with_bias(data, state) for state in list(states)]
    return [adjust(data, state, prior) for state in states]


def _with_bias(data: Correspondences, state: SimilarityState) -> SimilarityState:
    """Return the state shifted onto the control points, with the remaining offset of the fixes as bias."""
    residual = residuals(data, state)
    shift = np.median(residual[data.control], axis=0)
    model = state.geo_from_local
    onto = Similarity(model.scale, model.rotation, model.translation + shift)
    return replace(state, geo_from_local=onto, fix_bias_in_geo=np.median(residual[~data.control], axis=0) - shift)
