"""Camera corrections: one pose in every form, exact gradients, and a gauge that no correction moves."""

from __future__ import annotations

import numpy as np
import torch

from pipelines.adjust.cameras import CameraCorrections
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.similarity import umeyama
from tests.georef_scenes import make_block

BLOCK = make_block(images=5)


def corrected(scale: float, seed: int = 0) -> CameraCorrections:
    corrections = CameraCorrections(BLOCK.poses, BLOCK.basis)
    with torch.no_grad():
        corrections.z.copy_(scale * torch.from_numpy(np.random.default_rng(seed).normal(size=len(corrections.z))))
    return corrections


def test_all_forms_tell_the_same_pose() -> None:
    corrections = corrected(30.0)
    current = corrections.current()
    assert np.abs(current.cam_center_in_model - BLOCK.poses.cam_center_in_model).max() > 0.1
    for index in range(5):
        pose = corrections.cam_from_model(index).detach().double().numpy()
        np.testing.assert_allclose(pose[:3, :3], current.cam_from_model[index], atol=1e-7)
        # float32 at 50 m: 4e-6 m.
        center = -pose[:3, :3].T @ pose[:3, 3]
        np.testing.assert_allclose(center, current.cam_center_in_model[index], atol=2e-5)
        assert pose[3].tolist() == [0, 0, 0, 1]
    np.testing.assert_array_equal(corrections.centers().detach(), current.cam_center_in_model)
    product = current.cam_from_model @ np.swapaxes(current.cam_from_model, 1, 2)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (5, 1, 1)), atol=1e-13)


def test_rotation_turns_the_camera_as_the_basis_says() -> None:
    # R' = R Exp(−δω): the camera's axes, seen in the world, turn by +δω.
    corrections = corrected(1.0)
    turn = (corrections.basis[:, :3] @ corrections.z).detach().numpy()
    before, after = BLOCK.poses.cam_from_model, corrections.current().cam_from_model
    np.testing.assert_allclose(log_so3(np.swapaxes(after, 1, 2) @ before), turn, atol=1e-14)


def test_gradients_are_exact() -> None:
    corrections = corrected(1.0)
    weight = torch.from_numpy(np.random.default_rng(3).normal(size=(4, 4)))

    def total(z: torch.Tensor, index: int) -> torch.Tensor:
        return (torch.func.functional_call(_Pose(corrections, index), {"cameras.z": z}, ()) * weight).sum()

    for index in (0, 3):
        z = corrections.z.detach().clone().requires_grad_()
        (found,) = torch.autograd.grad(total(z, index), z)
        step = 1e-2 * torch.eye(len(z), dtype=torch.float64)
        wanted = torch.stack([(_exact(z + e, index, weight) - _exact(z - e, index, weight)) / 2e-2 for e in step])
        # The pose itself is rounded to float32, so its gradient is good to 1e-7 of itself.
        np.testing.assert_allclose(found, wanted.detach(), rtol=2e-5, atol=1e-6)


class _Pose(torch.nn.Module):
    def __init__(self, cameras: CameraCorrections, index: int) -> None:
        super().__init__()
        self.cameras, self.index = cameras, index

    def forward(self) -> torch.Tensor:
        return self.cameras.cam_from_model(self.index)


def _exact(z: torch.Tensor, index: int, weight: torch.Tensor) -> torch.Tensor:
    corrections = CameraCorrections(BLOCK.poses, BLOCK.basis)
    with torch.no_grad():
        corrections.z.copy_(z)
        rotation, center = corrections.rotations()[index], corrections.centers()[index]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
        return (pose * weight).sum()


def test_no_correction_is_a_similarity_of_the_whole() -> None:
    for seed in range(5):
        center = corrected(1.0, seed).current().cam_center_in_model
        fitted = umeyama(BLOCK.poses.cam_center_in_model, center)
        # Scale and shift are of the centres alone; the constraint on the turn is shared with the rotations.
        assert abs(np.log(fitted.scale)) < 1e-6
        assert np.abs(center.mean(axis=0) - BLOCK.poses.cam_center_in_model.mean(axis=0)).max() < 1e-12


def test_without_basis_the_cameras_stay() -> None:
    fixed = CameraCorrections(BLOCK.poses, np.zeros((5, 6, 0)))
    np.testing.assert_array_equal(fixed.current().cam_center_in_model, BLOCK.poses.cam_center_in_model)
    np.testing.assert_allclose(fixed.cam_from_model(2).detach()[:3, :3], BLOCK.poses.cam_from_model[2], atol=1e-7)
