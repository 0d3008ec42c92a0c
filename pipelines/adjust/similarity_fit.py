"""Least-squares adjustment of the similarity `geo_from_local`, every residual whitened by its covariance.

The observations are camera centres against GNSS fixes, control points against their survey, and, if the layout
leaves the rotation open, the recorded attitudes. The unknowns may include a bias (3,) that all fixes share.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipelines.adjust.normal_equations import NormalEquations, Observations, Weights
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.robust.statistics import median_chi2, outlier_gate, squared_mahalanobis

OUTLIER_GATE = outlier_gate(3)
# A bias of all fixes is accepted if it lowers −2 ln likelihood by more than this, the cost of one outlier.
BIAS_COST = OUTLIER_GATE - 1.0
_LEAST_FOR_EXCESS = 5  # points of a kind; the scatter of fewer is too uncertain
_STEPS = 12
_POSITIONS, _ATTITUDE = "positions", "attitude"


@dataclass(frozen=True)
class Correspondences:
    """n points known in both frames.

    Attributes:
        name: (n) names of images and control points.
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
        return Correspondences(
            name=tuple(name for name, take in zip(self.name, chosen, strict=True) if take),
            control=self.control[chosen],
            in_local=self.in_local[chosen],
            cov_in_local=self.cov_in_local[chosen],
            in_geo=self.in_geo[chosen],
            cov_in_geo=self.cov_in_geo[chosen],
        )

    def joined(self, other: Correspondences) -> Correspondences:
        """Return these correspondences, followed by those of `other`."""
        return Correspondences(
            name=self.name + other.name,
            control=np.concatenate([self.control, other.control]),
            in_local=np.concatenate([self.in_local, other.in_local]),
            cov_in_local=np.concatenate([self.cov_in_local, other.cov_in_local]),
            in_geo=np.concatenate([self.in_geo, other.in_geo]),
            cov_in_geo=np.concatenate([self.cov_in_geo, other.cov_in_geo]),
        )


@dataclass(frozen=True)
class RotationPrior:
    """Measured rotation geo ← local.

    Attributes:
        rotation: (3, 3).
        cov_rad2: (3, 3) covariance in rad², axes of geo.
    """

    rotation: FloatArray
    cov_rad2: FloatArray


@dataclass(frozen=True)
class SimilarityState:
    """Unknowns of the adjustment, with the inliers and the excess scatter.

    Attributes:
        geo_from_local: the similarity.
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
        state: the solution.
        covariance: (7, 7) about `pivot`, see `SimilarityRecord`.
        pivot: (3,) in geo.
        bias_cov: (3, 3) m² of the bias; zero if it is not estimated.
        response: (n, 7, 3) change of the parameters per metre of error of each measured position.
        residual: (n, 3) metres, measured (less bias) minus mapped.
        squared: (n,) whitened squared residuals.
        cost: −2 ln likelihood, with outliers at the cost of the gate; compares solutions of the same data.
        condition_number: of the normal matrix, with angles and ln s scaled by the size of the layout.
    """

    state: SimilarityState
    covariance: FloatArray
    pivot: FloatArray
    bias_cov: FloatArray
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

    Args:
        data: n correspondences.
        start: start of the similarity, and of the bias if it is to be estimated.
        prior: measured rotation, if the layout needs it.
    """
    state = _rescaled(data, start, robust=True)
    for _ in range(_STEPS):
        state = _gated(data, state)
        solution = _solve(data, state, prior)
        before, state = state, _rescaled(data, solution.state, robust=False, leverage=solution)
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
        equations = _equations(data, state, prior)
        step = equations.normal.solve(equations.weights)
        state = _moved(state, step, equations.pivot)
        if np.abs(step * equations.unit_m).max() < 1e-9:
            break
    equations = _equations(data, state, prior)
    normal, weights = equations.normal, equations.weights
    covariance = normal.covariance(weights)
    residual, cov = residuals(data, state), residual_covariances(data, state)
    squared = squared_mahalanobis(residual, cov)
    stretch = np.linalg.slogdet(cov)[1] - np.linalg.slogdet(data.cov_in_geo)[1]
    pull = np.swapaxes(-normal.observations[_POSITIONS].jacobian, 1, 2) @ equations.whitener
    return AdjustedSimilarity(
        state=state,
        covariance=covariance[:7, :7],
        pivot=equations.pivot,
        bias_cov=covariance[7:, 7:] if state.fix_bias_in_geo is not None else np.zeros((3, 3)),
        response=(covariance @ pull)[:, :7] * state.inlier[:, None, None],
        residual=residual,
        squared=squared,
        cost=float(np.where(state.inlier, squared + stretch, OUTLIER_GATE).sum()),
        condition_number=normal.condition_number(weights),
    )


@dataclass(frozen=True)
class _Equations:
    normal: NormalEquations  # P = 7, or 10 with a bias
    weights: Weights
    whitener: FloatArray  # (n, 3, 3), W with WᵀW = Σ⁻¹
    pivot: FloatArray  # (3,)
    unit_m: FloatArray  # (P,), metres per unit of each parameter


def _equations(data: Correspondences, state: SimilarityState, prior: RotationPrior | None) -> _Equations:
    mapped = state.geo_from_local.apply(data.in_local)
    whitener = np.linalg.inv(np.linalg.cholesky(residual_covariances(data, state)))
    weight = (whitener**2).sum(axis=(1, 2)) * state.inlier
    pivot = weight @ mapped / weight.sum()
    jacobian = jacobian_at(mapped, pivot)
    if state.fix_bias_in_geo is not None:
        shared = np.where(data.control[:, None, None], 0.0, np.eye(3))
        jacobian = np.concatenate([jacobian, shared], axis=2)
    white = (whitener @ residuals(data, state)[..., None])[..., 0]
    observations = {_POSITIONS: Observations(white, -whitener @ jacobian)}
    weights = {_POSITIONS: state.inlier.astype(np.float64)}
    count = jacobian.shape[2]
    if prior is not None:
        observations[_ATTITUDE] = _attitude(prior, state, count)
        weights[_ATTITUDE] = np.ones(1)
    size = np.sqrt(weight @ ((mapped - pivot) ** 2).sum(axis=1) / weight.sum())
    unit_m = np.ones(count)
    unit_m[:4] = max(size, 1e-9)
    normal = NormalEquations(
        observations, np.zeros(count), np.zeros(count), unit=1.0 / unit_m, open_directions="wide"
    )
    return _Equations(normal, weights, whitener, pivot, unit_m)


def _attitude(prior: RotationPrior, state: SimilarityState, count: int) -> Observations:
    """Return the measured rotation as one observation of three angles."""
    whitener = np.linalg.inv(np.linalg.cholesky(prior.cov_rad2))
    jacobian = np.zeros((1, 3, count))
    jacobian[0, :, 1:4] = -whitener
    residual = log_so3(prior.rotation @ state.geo_from_local.rotation.T)
    return Observations((whitener @ residual)[None], jacobian)


def _moved(state: SimilarityState, step: FloatArray, pivot: FloatArray) -> SimilarityState:
    bounded = np.concatenate([np.clip(step[:1], -1.0, 1.0), step[1:7]])
    bias = None if state.fix_bias_in_geo is None else state.fix_bias_in_geo + step[7:10]
    moved = perturbation(bounded, pivot) @ state.geo_from_local
    return replace(state, geo_from_local=moved, fix_bias_in_geo=bias)


def _rescaled(
    data: Correspondences, state: SimilarityState, *, robust: bool, leverage: AdjustedSimilarity | None = None
) -> SimilarityState:
    """Return the state with the excess scatter of each kind estimated anew."""
    excess = []
    for kind in (False, True):
        members = (data.control == kind) & (state.inlier | robust)
        excess.append(_excess(data, replace(state, excess_m=(0.0, 0.0)), members, robust, leverage))
    return replace(state, excess_m=(excess[0], excess[1]))


def _excess(
    data: Correspondences,
    state: SimilarityState,
    members: BoolArray,
    robust: bool,
    leverage: AdjustedSimilarity | None,
) -> float:
    """Return the σ per axis that makes the scatter of the members agree with their covariances; at least 0."""
    count = int(members.sum())
    if count < _LEAST_FOR_EXCESS:
        return 0.0
    residual, cov = residuals(data, state)[members], residual_covariances(data, state)[members]
    variances, axes = np.linalg.eigh(cov)
    along = (np.swapaxes(axes, 1, 2) @ residual[..., None])[..., 0] ** 2
    # The parameters absorb a part of the scatter: their redundancy is left.
    free = (
        1 - 7 / (3 * max(int(state.inlier.sum()), 3)) if leverage is None else _redundancy(data, leverage, members)
    )

    def surplus(sigma: float) -> float:
        squared = (along / (variances + sigma**2)).sum(axis=1)
        return float(np.median(squared) / median_chi2(3) if robust else squared.mean() / 3) - free

    if surplus(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.linalg.norm(residual, axis=1).max()) + 1e-9
    while surplus(high) > 0:
        high *= 2
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if surplus(middle) > 0 else (low, middle)
    return high


def _redundancy(data: Correspondences, solution: AdjustedSimilarity, members: BoolArray) -> float:
    """Return the mean redundancy of the members: 1 less the part of an error that the adjustment absorbs."""
    mapped = solution.state.geo_from_local.apply(data.in_local[members])
    absorbed = jacobian_at(mapped, solution.pivot) @ solution.response[members]
    absorbed_part = float(np.trace(absorbed, axis1=1, axis2=2).sum())
    if solution.state.fix_bias_in_geo is not None and not data.control[members].all():
        absorbed_part += 3.0
    return max(1 - absorbed_part / (3 * int(members.sum())), 0.05)
