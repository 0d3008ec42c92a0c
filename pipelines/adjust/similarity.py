"""Learnable similarity: seven whitened coordinates about the initial estimate, in float64."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.estimate import TensorSimilarity
from pipelines.adjust.similarity_fit import RotationPrior
from pipelines.adjust.so3 import exp_so3
from pipelines.core.types import FloatArray
from pipelines.geometry import rotations
from pipelines.geometry.similarity import Similarity, perturbation


class LearnableSimilarity(torch.nn.Module):
    """Similarity `geo_from_model` = perturbation(root · y) ∘ base, with y ~ N(0, diag(1 / held)) a priori.

    The perturbation is that of `geometry.similarity.SimilarityRecord`: (δ ln s, δω, δt) about `pivot` in the
    target frame. All seven coordinates y are of the same size, whatever the extent of the scene, so that one
    learning rate fits.

    The prior is the whole initial estimate, or only the `attitude` that entered it. In the second case, the axes
    of y are rotated to make this prior diagonal too: `held` is the attitude's share of the information in the
    initial estimate along each axis, and y = 0 has the rotation of the attitude.

    Args:
        initial: initial estimate.
        covariance: (7, 7) of the initial estimate; its root is the unit of y.
        pivot: (3,) in the target frame, metres.
        attitude: measured rotation geo ← model that the initial estimate used; None: the prior is the whole
            estimate.
    """

    def __init__(
        self, initial: Similarity, covariance: FloatArray, pivot: FloatArray, attitude: RotationPrior | None = None
    ) -> None:
        super().__init__()
        self.pivot_in_geo = np.asarray(pivot, dtype=np.float64)
        root, held, start = _root(covariance), np.ones(7), np.zeros(7)
        if attitude is not None:
            root, held, start = _about_attitude(root, initial.rotation, attitude)
        self.base = base = perturbation(root @ start, self.pivot_in_geo).inverse() @ initial
        self.y = torch.nn.Parameter(torch.from_numpy(start))
        self.root: Tensor
        self.held: Tensor
        self.register_buffer("root", torch.from_numpy(root))
        self.register_buffer("held", torch.from_numpy(held))
        self.base_rotation: Tensor
        self.base_shift: Tensor
        self.pivot: Tensor
        self.register_buffer("base_rotation", torch.tensor(base.rotation, dtype=torch.float64))
        self.register_buffer("base_shift", torch.tensor(base.translation, dtype=torch.float64))
        self.register_buffer("pivot", torch.tensor(self.pivot_in_geo))

    def forward(self, points: Tensor) -> Tensor:
        """Return points (N, 3), float64, mapped from `model` to `geo`."""
        return self.at(self.y).apply(points)

    def at(self, y: Tensor) -> TensorSimilarity:
        """Return the similarity of coordinates y (7,), differentiable in them."""
        delta = self.root @ y
        turn, grow = exp_so3(delta[1:4]), torch.exp(delta[0])
        return TensorSimilarity(
            grow * self.base.scale,
            turn @ self.base_rotation,
            self.pivot + delta[4:] + grow * (turn @ (self.base_shift - self.pivot)),
        )

    def place(self, value: Similarity) -> None:
        """Set the present similarity to `value`."""
        away = value @ self.base.inverse()
        shift = away.apply(self.pivot_in_geo) - self.pivot_in_geo
        delta = np.array([np.log(away.scale), *rotations.log_so3(away.rotation), *shift])
        with torch.no_grad():
            self.y.copy_(torch.from_numpy(np.linalg.solve(self.root.cpu().numpy(), delta)))

    def current(self) -> Similarity:
        """Return the present similarity."""
        delta = (self.root @ self.y).detach().cpu().numpy()
        return perturbation(delta, self.pivot_in_geo) @ self.base

    def prior(self) -> Tensor:
        """Return −2 ln of the prior density of y, up to a constant; scalar."""
        return self.held @ self.y.square()

    def prior_covariance(self) -> FloatArray:
        """Return the covariance (7, 7) of the initial estimate."""
        root = self.root.cpu().numpy()
        return np.asarray(root @ root.T)


def _about_attitude(
    root: FloatArray, rotation: FloatArray, attitude: RotationPrior
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the root along whose axes the attitude's information is diagonal; that information; y of the estimate.

    The attitude has no information on scale and translation: four of the seven axes are free of it.
    """
    information = np.zeros((7, 7))
    information[1:4, 1:4] = np.linalg.solve(attitude.cov_rad2, np.eye(3))
    part, turn = np.linalg.eigh(root.T @ information @ root)
    root = root @ turn
    held = np.where(np.arange(7) < 4, 0.0, np.clip(part, 0.0, 1.0))
    away = np.concatenate([[0.0], rotations.log_so3(rotation @ attitude.rotation.T), np.zeros(3)])
    start = np.where(np.arange(7) < 4, 0.0, np.linalg.solve(root, away))
    return root, held, start


def _root(covariance: FloatArray) -> FloatArray:
    """Return a square root of a positive semi-definite matrix, with a floor for directions without uncertainty."""
    value, vector = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vector * np.sqrt(np.maximum(value, 1e-12 * max(value.max(), 1e-12))))
