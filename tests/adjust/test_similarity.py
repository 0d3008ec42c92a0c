"""The learnable similarity: its two forms agree, its gradients are exact, its unit is the prior's σ."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.so3 import exp_so3
from pipelines.geometry.rotations import exp_so3 as exp_so3_numpy
from pipelines.geometry.similarity import Similarity, jacobian_at

PIVOT = np.array([2500.0, -1800.0, 40.0])
BASE = Similarity(1.3, exp_so3_numpy([0.4, -1.1, 2.0]), PIVOT + np.array([3.0, -2.0, 1.0]))


def covariance() -> np.ndarray:
    half = np.random.default_rng(0).normal(size=(7, 7)) * np.array([0.01, 0.02, 0.02, 0.02, 1.0, 1.0, 2.0])
    return half.T @ half


def learnable(seed: int | None = 1) -> LearnableSimilarity:
    similarity = LearnableSimilarity(BASE, covariance(), PIVOT)
    if seed is not None:
        with torch.no_grad():
            similarity.y.copy_(torch.from_numpy(np.random.default_rng(seed).normal(size=7)))
    return similarity


def points() -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(2).normal(0, 50, (5, 3)))


def test_starts_at_the_base() -> None:
    similarity = learnable(seed=None)
    # 2 500 m in float64: 1e-12 m.
    np.testing.assert_allclose(similarity(points()).detach(), BASE.apply(points()), rtol=0, atol=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_current_is_what_forward_does(seed: int) -> None:
    similarity = learnable(seed)
    moved = similarity.current().apply(points())
    assert np.abs(moved - BASE.apply(points())).max() > 0.1
    np.testing.assert_allclose(similarity(points()).detach(), moved, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_exponential_and_its_derivative(size: float) -> None:
    vector = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * size
    np.testing.assert_allclose(exp_so3(vector), exp_so3_numpy(vector.numpy()), atol=1e-14)
    assert torch.autograd.gradcheck(exp_so3, (vector.requires_grad_(),))


def test_gradients_are_exact() -> None:
    similarity = learnable()

    def forward(y: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(similarity, {"y": y}, (at,))

    at = torch.from_numpy(np.random.default_rng(2).normal(size=(3, 3))).requires_grad_()
    assert torch.autograd.gradcheck(forward, (similarity.y.detach().requires_grad_(), at), atol=1e-4)


def test_perturbation_is_that_of_the_record() -> None:
    # At y = 0 the derivative by y is ∂p'/∂(δ ln s, δω, δt) times the root of the covariance.
    similarity = learnable(seed=None)
    by_y = torch.func.jacrev(lambda y: torch.func.functional_call(similarity, {"y": y}, (points(),)))(
        similarity.y.detach()
    )
    expected = jacobian_at(BASE.apply(points()), PIVOT) @ similarity.root.numpy()
    np.testing.assert_allclose(by_y, expected, atol=1e-9)


def test_unit_of_y_is_the_prior() -> None:
    np.testing.assert_allclose(learnable().prior_covariance(), covariance(), atol=1e-12)


def test_direction_without_uncertainty_can_still_be_learned() -> None:
    certain = np.diag([0.0, 1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0])
    similarity = LearnableSimilarity(BASE, certain, PIVOT)
    assert np.linalg.matrix_rank(similarity.root.numpy(), tol=0) == 7
    similarity(points()).sum().backward()
    assert similarity.y.grad is not None
    assert torch.isfinite(similarity.y.grad).all()
