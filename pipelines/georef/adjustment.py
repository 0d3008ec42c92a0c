"""Least-squares adjustment of the similarity `geo_from_local`, every residual whitened by its covariance.

Observations are camera centres against GNSS fixes, control points against their survey, and, where the layout
leaves the rotation open, the recorded attitudes. The state may carry one more vector: a bias that all fixes share.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.georef.normal_equations import NormalEquations, Observations, Weights
from pipelines.robust.statistics import median_chi2, outlier_gate, squared_mahalanobis

OUTLIER_GATE = outlier_gate(3)
# What a bias of all fixes must save in −2 ln likelihood to be believed: as much as an outlier costs.
BIAS_COST = OUTLIER_GATE - 1.0
_LEAST_FOR_EXCESS = 5  # with fewer points of a kind their scatter says too little
_STEPS = 12
_POSITIONS, _ATTITUDE = "positions", "attitude"


@dataclass(frozen=True)
class Correspondences:
    """n points known in both frames.

    Attributes:
        name: of the image or the control point.
        control: (n,) control point (True) or camera centre (False).
        in_local: (n, 3), in units of local.
        cov_in_local: (n, 3, 3).
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
        """Return some of them."""
        return Correspondences(
            name=tuple(name for name, take in zip(self.name, chosen, strict=True) if take),
            control=self.control[chosen],
            in_local=self.in_local[chosen],
            cov_in_local=self.cov_in_local[chosen],
            in_geo=self.in_geo[chosen],
            cov_in_geo=self.cov_in_geo[chosen],
        )

    def joined(self, other: Correspondences) -> Correspondences:
        """Return these, then the others."""
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
    """A measured rotation geo ← local, and its covariance (3, 3) in rad²."""

    rotation: FloatArray
    cov_rad2: FloatArray


@dataclass(frozen=True)
class SimilarityState:
    """Unknowns of the adjustment, and how far the scatter exceeds the stated σ.

    Attributes:
        geo_from_local: the similarity.
        inlier: (n,) the correspondences in use.
        fix_bias_in_geo: (3,) metres, or None where it is not estimated.
        excess_m: σ beyond the stated one, of fixes and of control points.
    """

    geo_from_local: Similarity
    inlier: BoolArray
    fix_bias_in_geo: FloatArray | None = None
    excess_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class AdjustedSimilarity:
    """A state with what follows from it.

    Attributes:
        state: the solution.
        covariance: (7, 7) about `pivot`, see `SimilarityRecord`.
        pivot: (3,) in geo.
        bias_cov: (3, 3) m² of the bias; zero where it is not estimated.
        response: (n, 7, 3) change of the parameters per metre of error of each measured position.
        residual: (n, 3) metres, measured (less bias) minus mapped.
        squared: (n,) whitened squared residuals.
        cost: −2 ln likelihood, outliers counted as if at the gate; compares solutions of the same data.
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
    """Adjust robustly from a start that is nearly right.

    Each round solves for the parameters, measures the excess scatter (what SfM's own errors and optimistic σ add,
    after Paule and Mandel, doi 10.6028/jres.087.022), and gates the outliers at 0.1 %.
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
    """Return the measured position, less the bias of the fixes, minus the mapped one (n, 3)."""
    missed = data.in_geo - state.geo_from_local.apply(data.in_local)
    if state.fix_bias_in_geo is not None:
        missed = missed - np.where(data.control[:, None], 0.0, state.fix_bias_in_geo)
    return np.asarray(missed)


def residual_covariances(data: Correspondences, state: SimilarityState) -> FloatArray:
    """Return the covariances (n, 3, 3) of the residuals: measured, of the point in local, and the excess."""
    turn = state.geo_from_local.scale * state.geo_from_local.rotation
    excess = np.where(data.control, state.excess_m[1], state.excess_m[0])
    cov = data.cov_in_geo + turn @ data.cov_in_local @ turn.T
    return np.asarray(cov + excess[:, None, None] ** 2 * np.eye(3))


def _gated(data: Correspondences, state: SimilarityState) -> SimilarityState:
    squared = squared_mahalanobis(residuals(data, state), residual_covariances(data, state))
    inlier = squared <= OUTLIER_GATE
    if inlier.sum() < 3:  # never fewer than determine a similarity
        inlier = squared <= np.sort(squared)[min(2, len(squared) - 1)]
    return replace(state, inlier=inlier)


def _solve(data: Correspondences, state: SimilarityState, prior: RotationPrior | None) -> AdjustedSimilarity:
    """Gauss–Newton over the inliers, with weights, excess and inliers held."""
    for _ in range(_STEPS):
        equations = _equations(data, state, prior)
        step = equations.normal.solve(equations.weights)
        state = _moved(state, step, equations.pivot)
        if np.abs(step * equations.unit_m).max() < 1e-9:
            break
    equations = _equations(data, state, prior)
    normal, weights = equations.normal, equations.weights
    covariance = normal.covariance(weights)
    missed, cov = residuals(data, state), residual_covariances(data, state)
    squared = squared_mahalanobis(missed, cov)
    stretch = np.linalg.slogdet(cov)[1] - np.linalg.slogdet(data.cov_in_geo)[1]
    pull = np.swapaxes(-normal.observations[_POSITIONS].jacobian, 1, 2) @ equations.whitener
    return AdjustedSimilarity(
        state=state,
        covariance=covariance[:7, :7],
        pivot=equations.pivot,
        bias_cov=covariance[7:, 7:] if state.fix_bias_in_geo is not None else np.zeros((3, 3)),
        response=(covariance @ pull)[:, :7] * state.inlier[:, None, None],
        residual=missed,
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
    """The rotation as it was measured: one observation of three angles."""
    whitener = np.linalg.inv(np.linalg.cholesky(prior.cov_rad2))
    jacobian = np.zeros((1, 3, count))
    jacobian[0, :, 1:4] = -whitener
    missed = log_so3(prior.rotation @ state.geo_from_local.rotation.T)
    return Observations((whitener @ missed)[None], jacobian)


def _moved(state: SimilarityState, step: FloatArray, pivot: FloatArray) -> SimilarityState:
    bounded = np.concatenate([np.clip(step[:1], -1.0, 1.0), step[1:7]])
    bias = None if state.fix_bias_in_geo is None else state.fix_bias_in_geo + step[7:10]
    moved = perturbation(bounded, pivot) @ state.geo_from_local
    return replace(state, geo_from_local=moved, fix_bias_in_geo=bias)


def _rescaled(
    data: Correspondences, state: SimilarityState, *, robust: bool, leverage: AdjustedSimilarity | None = None
) -> SimilarityState:
    """The state with the excess scatter of each kind measured anew."""
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
    """σ to add to each axis so that the scatter of the members is what their covariances say; at least 0."""
    count = int(members.sum())
    if count < _LEAST_FOR_EXCESS:
        return 0.0
    missed, cov = residuals(data, state)[members], residual_covariances(data, state)[members]
    variances, axes = np.linalg.eigh(cov)
    along = (np.swapaxes(axes, 1, 2) @ missed[..., None])[..., 0] ** 2
    # The share of the scatter that the parameters have taken up.
    free = (
        1 - 7 / (3 * max(int(state.inlier.sum()), 3)) if leverage is None else _redundancy(data, leverage, members)
    )

    def surplus(sigma: float) -> float:
        squared = (along / (variances + sigma**2)).sum(axis=1)
        return float(np.median(squared) / median_chi2(3) if robust else squared.mean() / 3) - free

    if surplus(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.linalg.norm(missed, axis=1).max()) + 1e-9
    while surplus(high) > 0:
        high *= 2
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if surplus(middle) > 0 else (low, middle)
    return high


def _redundancy(data: Correspondences, solution: AdjustedSimilarity, members: BoolArray) -> float:
    """Mean redundancy of the members: 1 less the part of an error that the adjustment absorbs."""
    mapped = solution.state.geo_from_local.apply(data.in_local[members])
    absorbed = jacobian_at(mapped, solution.pivot) @ solution.response[members]
    absorbed_part = float(np.trace(absorbed, axis1=1, axis2=2).sum())
    if solution.state.fix_bias_in_geo is not None and not data.control[members].all():
        absorbed_part += 3.0
    return max(1 - absorbed_part / (3 * int(members.sum())), 0.05)
