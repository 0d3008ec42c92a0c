"""Least-squares adjustment of the similarity `geo_from_local`, every residual whitened by its covariance.

The observations are camera centres against GNSS fixes, control points against their survey, and, if the layout
leaves the rotation open, the recorded attitudes. The unknowns may include a bias (3,) that all fixes share.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from itertools import compress

import numpy as np
from scipy.optimize import brentq

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.robust.statistics import median_chi2, outlier_gate, squared_mahalanobis

OUTLIER_GATE = outlier_gate(3)
_LEAST_FOR_EXCESS = 5  # points of a kind; the scatter of fewer is too uncertain
_STEPS = 12
_OPEN = 1e-12  # eigenvalue over the largest one, below which nothing determines a direction


@dataclass(frozen=True)
class Correspondences:
    """n points known in both frames.

    Attributes:
        control: (n,) control point (True) or camera centre (False).
        in_local: (n, 3), in units of local.
        cov_in_local: (n, 3, 3), in squared units of local.
        in_geo: (n, 3) metres, as measured.
        cov_in_geo: (n, 3, 3) m².
    """

    name: tuple[str, ...]
    control: BoolArray
    in_local: FloatArray
    cov_in_local: FloatArray
    in_geo: FloatArray
    cov_in_geo: FloatArray

    def __len__(self) -> int:
        return len(self.name)

    def part(self, chosen: BoolArray) -> Correspondences:
        """Return the correspondences that a mask (n,) selects."""
        arrays = (getattr(self, each.name)[chosen] for each in fields(self)[1:])
        return Correspondences(tuple(compress(self.name, chosen)), *arrays)

    def joined(self, other: Correspondences) -> Correspondences:
        """Return these correspondences, followed by those of `other`."""
        arrays = (
            np.concatenate([getattr(self, each.name), getattr(other, each.name)]) for each in fields(self)[1:]
        )
        return Correspondences(self.name + other.name, *arrays)


@dataclass(frozen=True)
class RotationPrior:
    """Measured rotation (3, 3) geo ← local, with its covariance (3, 3) in rad², axes of geo."""

    rotation: FloatArray
    cov_rad2: FloatArray


@dataclass(frozen=True)
class SimilarityState:
    """Unknowns of the adjustment, with the inliers and the excess scatter.

    Attributes:
        inlier: (n,) the correspondences in use.
        fix_bias_in_geo: (3,) metres, fix minus truth; None if it is not estimated.
        excess_m: σ per axis beyond the stated one, of fixes and of control points.
    """

    geo_from_local: Similarity
    inlier: BoolArray
    fix_bias_in_geo: FloatArray | None = None
    excess_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class AdjustedSimilarity:
    """Solution of the adjustment, with its covariance, residuals and cost.

    Attributes:
        covariance: (7, 7) about `pivot`, (3,) in geo; see `SimilarityRecord`.
        response: (n, 7, 3) change of the parameters per metre of error of each measured position.
        residual: (n, 3) metres, measured (less bias) minus mapped.
        squared: (n,) whitened squared residuals.
        cost: −2 ln likelihood, with outliers at the cost of the gate; compares solutions of the same data.
        condition_number: of the normal matrix, with angles and ln s scaled by the size of the layout.
    """

    state: SimilarityState
    covariance: FloatArray
    pivot: FloatArray
    response: FloatArray = field(repr=False)
    residual: FloatArray = field(repr=False)
    squared: FloatArray = field(repr=False)
    cost: float
    condition_number: float

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
    squared = squared_mahalanobis(residuals(data, state), residual_covariances(data, state))
    inlier = squared <= OUTLIER_GATE
    if inlier.sum() < 3:  # a similarity needs three
        inlier = squared <= np.sort(squared)[min(2, len(squared) - 1)]
    return replace(state, inlier=inlier)


def _solve(data: Correspondences, state: SimilarityState, prior: RotationPrior | None) -> AdjustedSimilarity:
    """Return the Gauss–Newton solution of the inliers, with excess and inliers held."""
    for _ in range(_STEPS):
        linear = _linearised(data, state, prior)
        every = covariance_of(linear.jacobian, linear.unit)
        step = every @ linear.jacobian.T @ linear.residual
        state = _moved(state, step, linear.pivot)
        if np.abs(step / linear.unit).max() < 1e-9:
            break
    residual, cov = residuals(data, state), residual_covariances(data, state)
    squared = squared_mahalanobis(residual, cov)
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
    """Return the covariance (P, P) of P parameters from whitened observations.

    A direction that the observations leave open gets a wide, but finite variance.

    Args:
        jacobian: (m, P) derivatives of the observations.
        unit: (P,) step of each parameter that changes the observations about as much as one of any other.
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
    whitener = np.linalg.inv(np.linalg.cholesky(residual_covariances(data, state)))
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
        root = np.linalg.inv(np.linalg.cholesky(prior.cov_rad2))
        turn = log_so3(prior.rotation @ state.geo_from_local.rotation.T)
        residual = np.concatenate([residual, root @ turn])
        jacobian = np.concatenate([jacobian, root @ np.eye(3, jacobian.shape[1], 1)])
    unit = np.ones(jacobian.shape[1])
    unit[:4] = 1.0 / max(size_m, 1e-9)
    return _Linearised(residual, jacobian, whitener, pivot, unit)


def _moved(state: SimilarityState, step: FloatArray, pivot: FloatArray) -> SimilarityState:
    bounded = np.concatenate([np.clip(step[:1], -1.0, 1.0), step[1:7]])
    bias = None if state.fix_bias_in_geo is None else state.fix_bias_in_geo + step[7:10]
    moved = perturbation(bounded, pivot) @ state.geo_from_local
    return replace(state, geo_from_local=moved, fix_bias_in_geo=bias)


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
        return float(np.median(squared) / median_chi2(3) if robust else squared.mean() / 3) - free

    # With the largest residual as σ, each whitened square is at most 1, and the surplus negative.
    largest = float(np.linalg.norm(residual, axis=1).max())
    return 0.0 if surplus(0.0) <= 0 else float(brentq(surplus, 0.0, largest))
