"""The geographic half linearised: which constant errors the measurements show, and how well everything is known.

Whitened residuals are e₀ + A x + B z, with x the similarity and the errors, and z the cameras, which are N(0, I):
without the cameras, e₀ + A x has the covariance I + B Bᵀ. That matrix is as large as the residuals are many,
whatever the number of cameras, and has to be factored once for each set of weights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.georef.losses import CAUCHY_SCALE2, cauchy

# Cauchy's weight also falls on what is only noise. Under Gaussian noise of the stated σ, weights divided by this
# give the covariance that the estimator has: E[w] E[w² χ²/3] / E[∂(w r)/∂r]² for χ² with 3 degrees of freedom.
WEIGHT_OF_NOISE = 0.7886
_ROUNDS, _STILL = 50, 1e-6
_CHUNK = 64


@dataclass(frozen=True)
class Linearised:
    """Whitened residuals of M observations and how they change; float64, on the CPU.

    Attributes:
        base: (3 M,) extrapolated to x = 0, z = 0.
        by_x: (3 M, 7 + p), similarity then errors.
        gram: (3 M, 3 M), B Bᵀ.
        precision: (7 + p,) diagonal of the prior information of x.
        x: (7 + p,) at which it was linearised.
        white: (3 M,) residuals there, with the cameras where they are.
    """

    base: Tensor
    by_x: Tensor
    gram: Tensor
    precision: Tensor
    x: Tensor
    white: Tensor


@dataclass(frozen=True)
class Solution:
    """Minimum of the robust cost: x (7 + p,), the residuals (3 M,) there, and the cost, a −2 ln likelihood."""

    x: Tensor
    white: Tensor
    cost: float


def linearise(
    residuals: Callable[[Tensor, Tensor, Tensor], Tensor],
    at: tuple[Tensor, Tensor, Tensor, Tensor],
    basis: Tensor,
    precision: Tensor,
) -> Linearised:
    """Differentiate whitened residuals.

    Args:
        residuals: (M, 3) of the similarity's coordinates y (7,), everything that the cameras' corrections move
            (c,), the errors (p,).
        at: y, what is moved, v and the cameras' coordinates z (k,).
        basis: (c, k), what is moved = basis · z.
        precision: (7 + p,) of the prior of y and v.
    """
    y, moved, v, z = (each.detach() for each in at)
    by_y, by_moved, by_v = torch.func.jacrev(residuals, argnums=(0, 1, 2), chunk_size=_CHUNK)(y, moved, v)
    by_z = by_moved.flatten(0, 1) @ basis
    by_x = torch.cat([by_y, by_v], dim=2).flatten(0, 1)
    white, x = residuals(y, moved, v).detach().flatten(), torch.cat([y, v])
    base = white - by_x @ x - by_z @ z
    return Linearised(*(each.detach().cpu() for each in (base, by_x, by_z @ by_z.T, precision, x, white)))


def solve(model: Linearised, start: Tensor, free: Tensor) -> Solution:
    """Iteratively reweighted least squares with Cauchy's kernel.

    Args:
        start: (7 + p,) where the first weights are taken.
        free: (7 + p,) bool; the others stay at zero.
    """
    by_x, precision = model.by_x[:, free], model.precision[free]
    # The cameras as the linearisation had them: good enough for the first weights.
    white = model.white + model.by_x @ (torch.where(free, start, 0.0) - model.x)
    found, of_cameras = start[free], 0.0
    for _ in range(_ROUNDS):
        root = _weights(white).sqrt()
        weighted = root[:, None] * torch.cat([by_x, model.base[:, None]], dim=1)
        pull = torch.cholesky_solve(weighted, _factor(model, root))
        normal = weighted[:, :-1].T @ pull[:, :-1] + precision.diag()
        found = -torch.linalg.solve(normal, weighted[:, :-1].T @ pull[:, -1])
        left = pull[:, :-1] @ found + pull[:, -1]
        before, white = white, left / root
        of_cameras = float((root * left) @ (model.gram @ (root * left)))
        if float((white - before).abs().max()) < _STILL:
            break
    x = torch.zeros_like(start)
    x[free] = found
    rho = cauchy(white.view(-1, 3).square().sum(dim=1))
    return Solution(x, white, float(rho.sum() + (model.precision * x.square()).sum()) + of_cameras)


def posterior(model: Linearised, white: Tensor) -> Tensor:
    """Covariance (7 + p, 7 + p) of x, the cameras marginalised out, with the weights of residuals (3 M,).

    The similarity's part is that of its whitened coordinates y.
    """
    root = (_weights(white) / WEIGHT_OF_NOISE).sqrt()
    whitened = torch.linalg.solve_triangular(_factor(model, root), root[:, None] * model.by_x, upper=False)
    normal = whitened.T @ whitened + model.precision.diag()
    return torch.linalg.solve(normal, torch.eye(len(normal), dtype=normal.dtype))


def _weights(white: Tensor) -> Tensor:
    """Cauchy's weight of each coordinate (3 M,)."""
    return (1.0 / (1.0 + white.view(-1, 3).square().sum(dim=1) / CAUCHY_SCALE2)).repeat_interleave(3)


def _factor(model: Linearised, root: Tensor) -> Tensor:
    matrix = root[:, None] * model.gram * root + torch.eye(len(root), dtype=root.dtype)
    return torch.linalg.cholesky(matrix)
