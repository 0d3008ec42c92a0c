"""Unknowns as tensors: rotations, a similarity, cameras and lens that start anywhere, systematic errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.adjust.state import State, SystematicError, SystematicErrors
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, jacobian_at
from pipelines.train.geographic.unknowns import (
    CameraCorrections,
    LearnableErrors,
    LearnableSimilarity,
    exp_so3_tensor,
    log_so3_tensor,
)

PIVOT = np.array([2500.0, -1800.0, 40.0])
BASE = Similarity(1.3, exp_so3([0.4, -1.1, 2.0]), PIVOT + np.array([3.0, -2.0, 1.0]))


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
    np.testing.assert_allclose(similarity().apply(points()).detach(), BASE.apply(points()), rtol=0, atol=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_current_is_what_forward_does(seed: int) -> None:
    similarity = learnable(seed)
    moved = similarity.current().apply(points())
    assert np.abs(moved - BASE.apply(points())).max() > 0.1
    np.testing.assert_allclose(similarity().apply(points()).detach(), moved, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_exponential_and_its_derivative(size: float) -> None:
    vector = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * size
    np.testing.assert_allclose(exp_so3_tensor(vector), exp_so3(vector.numpy()), atol=1e-14)
    assert torch.autograd.gradcheck(exp_so3_tensor, (vector.requires_grad_(),))


def test_perturbation_is_that_of_the_record() -> None:
    # At y = 0 the derivative by y is ∂p'/∂(δ ln s, δω, δt) times the root of the covariance.
    similarity = learnable(seed=None)
    by_y = torch.func.jacrev(lambda y: torch.func.functional_call(similarity, {"y": y}, ()).apply(points()))(
        similarity.y.detach()
    )
    expected = jacobian_at(BASE.apply(points()), PIVOT) @ similarity.root.numpy()
    np.testing.assert_allclose(by_y, expected, atol=1e-9)


def test_direction_without_uncertainty_can_still_be_learned() -> None:
    certain = np.diag([0.0, 1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0])
    similarity = LearnableSimilarity(BASE, certain, PIVOT)
    assert np.linalg.matrix_rank(similarity.root.numpy(), tol=0) == 7
    similarity().apply(points()).sum().backward()
    assert similarity.y.grad is not None
    assert torch.isfinite(similarity.y.grad).all()


def test_log_of_a_rotation() -> None:
    vector = np.array([[0.0, 0, 0], [1e-9, 0, 0], [0.3, -0.2, 0.5], [0, 3.0, 0]])
    rotation = torch.from_numpy(exp_so3(vector)).requires_grad_()
    found = log_so3_tensor(rotation)
    np.testing.assert_allclose(found.detach(), vector, atol=1e-12)
    found.sum().backward()
    assert rotation.grad is not None
    assert torch.isfinite(rotation.grad).all()


def test_cameras_and_lens_start_where_they_are_told_and_move_by_the_basis() -> None:
    rng = np.random.default_rng(0)
    base = CameraPoses(exp_so3(rng.normal(size=(4, 3))), rng.normal(0, 40, (4, 3)))
    basis, lens_basis, z = rng.normal(0, 0.01, (4, 6, 5)), rng.normal(size=(3, 5)), rng.normal(size=5)
    start = State(Similarity(), 0.1 * rng.normal(size=(4, 6)), rng.normal(size=3))
    cameras, wanted = CameraCorrections(base, basis, lens_basis, start, z), start.poses(base)
    rotation, center = (each.detach().numpy() for each in cameras.moved())
    np.testing.assert_allclose(rotation, wanted.cam_from_model, atol=1e-12)
    np.testing.assert_allclose(center, wanted.cam_center_in_model, atol=1e-12)
    np.testing.assert_allclose(cameras.lens().detach(), start.lens, atol=1e-12)
    for index in range(4):
        pose = cameras.cam_from_model(index).detach().double().numpy()
        np.testing.assert_allclose(pose[:3, :3], rotation[index], atol=1e-7)
        # float32 at 50 m: 4e-6 m.
        np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], center[index], atol=2e-5)
    with torch.no_grad():
        cameras.z.add_(1.0)
    np.testing.assert_allclose(cameras.corrections().detach(), start.correction + basis.sum(axis=2), atol=1e-12)
    np.testing.assert_allclose(cameras.lens().detach(), start.lens + lens_basis.sum(axis=1), atol=1e-12)
    turned = cameras.moved()[0].detach().numpy()
    # R' = R Exp(−δω): the camera's axes, seen in the world, turn by +δω.
    turn = log_so3(np.swapaxes(turned, 1, 2) @ base.cam_from_model)
    np.testing.assert_allclose(turn, cameras.corrections().detach()[:, :3], atol=1e-12)
    frozen = CameraCorrections.frozen(base, start)
    assert len(frozen.z) == 0
    np.testing.assert_allclose(frozen.moved()[1].detach(), wanted.cam_center_in_model, atol=1e-12)


def test_prior_of_an_error_is_set_aside_where_the_error_is_far_larger() -> None:
    """The gradient of the prior of a base station that is metres off its stated centimetres is next to nothing."""
    errors = SystematicErrors((SystematicError("bias", (0.03, 0.03, 0.05), 0),))
    slopes = []
    for value in (0.03, 3.0):
        learned = LearnableErrors(errors, np.array([value, 0.0, 0.0]), np.full(3, 0.01))
        learned.prior().backward()
        assert learned.x.grad is not None
        slopes.append(float(learned.x.grad[0]) * 0.03**2 / (2 * 0.01 * value))
    assert slopes[0] == pytest.approx(1 / (1 + 1 / 7.815), rel=1e-6)
    assert slopes[1] < 1e-3
