"""Normal equations of weighted, whitened observations: one solver and one posterior for every adjustment.

Near a state, the residuals of each kind of observation are e + J δ with a step δ (P,). The prior of δ is N(−o,
Λ⁻¹), with o the distance of the state from the mean of the prior. Iteratively reweighted least squares finds the
minimum of

    Σ_kinds Σ_m ρ(|e_m + J_m δ|²) + (δ + o)ᵀ Λ (δ + o).

The curvature there gives the posterior. ρ is Cauchy's kernel, unless the caller passes weights of its own, such as
a gate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import cho_solve, cholesky, qr

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.robust.kernels import NOISE_WEIGHT, cauchy_loss, cauchy_weight

_ROUNDS, _STILL = 50, 1e-6  # of reweighting; the change of a whitened residual that ends it
_FLOOR = 1e-12  # eigenvalue over the largest one, below which a direction counts as open

# By kind of observation: weights (M,), residuals (M, d).
Weights = Mapping[str, FloatArray]
Residuals = Mapping[str, FloatArray]


@dataclass(frozen=True)
class Observations:
    """M whitened observations of one kind near a state.

    Attributes:
        residual: (M, d) at the state.
        jacobian: (M, d, P) derivative by the parameters.
    """

    residual: FloatArray
    jacobian: FloatArray

    def after(self, step: FloatArray) -> FloatArray:
        """Return the residuals (M, d) after a step (P,), to first order."""
        return np.asarray(self.residual + self.jacobian @ step)


@dataclass(frozen=True)
class RobustMinimum:
    """Minimum of the robust cost.

    Attributes:
        step: (P,) from the state to the minimum.
        residuals: at the minimum.
        cost: −2 ln likelihood.
    """

    step: FloatArray
    residuals: Residuals
    cost: float


@dataclass(frozen=True)
class NormalEquations:
    """Observations by kind, with the prior of the P parameters.

    Attributes:
        observations: by the name of their kind.
        precision: (P,) diagonal Λ of the prior; zero: no prior.
        offset: (P,) o, distance of the state from the mean of the prior.
        unit: (P,) size of a step of each parameter in common units; scales the decompositions.
        open_directions: treatment of parameters that nothing determines: "refuse", or a "wide" but finite
            variance.
        advice: message of the error with "refuse".
    """

    observations: Mapping[str, Observations]
    precision: FloatArray
    offset: FloatArray
    unit: FloatArray | None = None
    open_directions: Literal["refuse", "wide"] = "refuse"
    advice: str = "the observations do not determine all unknowns"

    def residuals(self, step: FloatArray | None = None) -> Residuals:
        """Return the residuals at the state, or to first order after a step (P,)."""
        if step is None:
            return {name: rows.residual for name, rows in self.observations.items()}
        return {name: rows.after(step) for name, rows in self.observations.items()}

    def matrix(self, weights: Weights) -> FloatArray:
        """Return the normal matrix Jᵀ W J + Λ (P, P)."""
        normal = np.diag(self.precision)
        for name, rows in self.observations.items():
            flat = _flat(rows.jacobian)
            normal = normal + (flat * np.repeat(weights[name], rows.residual.shape[1])[:, None]).T @ flat
        return normal

    def solve(self, weights: Weights, free: BoolArray | None = None) -> FloatArray:
        """Return the step (P,) to the minimum of the weighted squares.

        Args:
            weights: of the observations.
            free: (P,) mask of the parameters to adjust; the others stay. None: all.

        Raises:
            DegenerateGeometryError: a direction is open, with `open_directions` "refuse".
        """
        return self._solve(weights, np.zeros(len(self.precision)), self._all() if free is None else free)

    def minimum(self, start: FloatArray | None = None, free: BoolArray | None = None) -> RobustMinimum:
        """Return the minimum of the robust cost.

        Args:
            start: (P,) step at which the first weights are taken; None: the state itself.
            free: (P,) mask of the parameters to adjust; the others keep the value of `start`. None: all.

        Raises:
            DegenerateGeometryError: as `solve`.
        """
        step = np.zeros(len(self.precision)) if start is None else start
        free = self._all() if free is None else free
        residuals = self.residuals(step)
        for _ in range(_ROUNDS):
            step = self._solve(robust_weights(residuals), step, free)
            before, residuals = residuals, self.residuals(step)
            if all(np.abs(residuals[name] - before[name]).max(initial=0.0) < _STILL for name in residuals):
                break
        from_prior = step + self.offset
        return RobustMinimum(step, residuals, robust_cost(residuals) + float(self.precision @ from_prior**2))

    def covariance(self, weights: Weights, free: BoolArray | None = None) -> FloatArray:
        """Return the covariance (P, P) of the parameters, the inverse normal matrix; zero for held ones.

        Args:
            weights: of the observations.
            free: (P,) mask of the parameters that are not held. None: all.

        Raises:
            DegenerateGeometryError: as `solve`.
        """
        free = self._all() if free is None else free
        covariance = np.zeros((len(free), len(free)))
        covariance[np.ix_(free, free)] = self._inverse_times(weights, free, np.eye(int(free.sum())))
        return covariance

    def inverse_times(self, weights: Weights, right: FloatArray) -> FloatArray:
        """Return the product (P, m) of the inverse normal matrix N⁻¹ and vectors (P, m).

        Raises:
            DegenerateGeometryError: as `solve`.
        """
        return self._inverse_times(weights, self._all(), right)

    def spread(self, weights: Weights, jacobian: FloatArray) -> FloatArray:
        """Return A N⁻¹ Aᵀ (J, d, d) of derivatives A (J, d, P): the covariance that the parameters cause.

        Raises:
            DegenerateGeometryError: as `solve`.
        """
        solved = self.inverse_times(weights, _flat(jacobian).T).T.reshape(jacobian.shape)
        return np.asarray(solved @ np.swapaxes(jacobian, 1, 2))

    def condition_number(self, weights: Weights) -> float:
        """Return the condition number of the scaled normal matrix, at most 1e12."""
        values = np.linalg.eigvalsh(self._scaled(weights, self._all()))
        return float(values[-1] / max(values[0], _FLOOR * values[-1]))

    def _solve(self, weights: Weights, held: FloatArray, free: BoolArray) -> FloatArray:
        """Return the step (P,) that minimises over the free parameters, the others held at `held`."""
        step = np.where(free, 0.0, held)
        slope = self.precision * (self.offset + step)
        for name, rows in self.observations.items():
            slope = slope + _flat(rows.jacobian).T @ (weights[name][:, None] * rows.after(step)).ravel()
        step[free] = -self._inverse_times(weights, free, slope[free])
        return step

    def _inverse_times(self, weights: Weights, free: BoolArray, right: FloatArray) -> FloatArray:
        unit = self._units()[free].reshape(-1, *[1] * (right.ndim - 1))
        if self.open_directions == "wide":
            values, vectors = np.linalg.eigh(self._scaled(weights, free))
            inverse = vectors / np.maximum(values, _FLOOR * values[-1])
            return np.asarray(inverse @ (vectors.T @ (right * unit)) * unit)
        return np.asarray(cho_solve((self._root(weights, free), False), right * unit) * unit)

    def _scaled(self, weights: Weights, free: BoolArray) -> FloatArray:
        """Return the normal matrix of the free parameters in their units."""
        unit = self._units()[free]
        return np.asarray(self.matrix(weights)[np.ix_(free, free)] * unit[:, None] * unit)

    def _root(self, weights: Weights, free: BoolArray) -> FloatArray:
        """Return the upper triangle U with UᵀU = the scaled normal matrix.

        Cholesky's method loses half of the digits. If too few are left, a QR decomposition of the weighted
        Jacobian gives U, at a higher cost.
        """
        try:
            return np.asarray(cholesky(self._scaled(weights, free)))
        except np.linalg.LinAlgError:
            rows = [
                np.repeat(weights[name], block.residual.shape[1])[:, None] ** 0.5 * _flat(block.jacobian)
                for name, block in self.observations.items()
            ]
            stacked = np.concatenate([*rows, np.diag(self.precision**0.5)])[:, free] * self._units()[free]
            root = qr(stacked, mode="economic")[1]
            size = np.abs(np.diag(root))
            if size.min() <= _FLOOR * size.max():
                raise DegenerateGeometryError(self.advice) from None
            return np.asarray(root)

    def _all(self) -> BoolArray:
        return np.ones(len(self.precision), dtype=bool)

    def _units(self) -> FloatArray:
        return np.ones(len(self.precision)) if self.unit is None else self.unit


def robust_weights(residuals: Residuals) -> Weights:
    """Return Cauchy's weights (M,) of whitened residuals (M, d), by kind."""
    return {name: cauchy_weight(_chi2(rows), rows.shape[1]) for name, rows in residuals.items()}


def posterior_weights(residuals: Residuals) -> Weights:
    """Return the weights (M,), by kind, whose normal matrix is the inverse covariance of the estimate.

    Cauchy's weight is also below 1 under pure noise: see `robust.kernels.NOISE_WEIGHT`.
    """
    weights = robust_weights(residuals)
    return {name: weights[name] / NOISE_WEIGHT[rows.shape[1]] for name, rows in residuals.items()}


def robust_cost(residuals: Residuals) -> float:
    """Return Σ ρ of whitened residuals of all kinds."""
    return sum(float(cauchy_loss(_chi2(rows), rows.shape[1]).sum()) for rows in residuals.values())


def _chi2(rows: FloatArray) -> FloatArray:
    return np.asarray((rows**2).sum(axis=1))


def _flat(jacobian: FloatArray) -> FloatArray:
    return jacobian.reshape(-1, jacobian.shape[-1])
