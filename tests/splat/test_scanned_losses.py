"""Losses of Gaussians by their places: in free space, and beside measured planes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import FreeSpace, FreeSpaceLoss, MeasuredPlanes, PlaneAttraction

CPU = torch.device("cpu")


def gaussians(places: list[tuple[float, float, float]], opacity: float = 0.8) -> Gaussians:
    count = len(places)
    parts = Gaussians(
        torch.tensor(places),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.zeros(count, 3),
        torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        torch.zeros(count, 1, 3),
    )
    for tensor in parts.tensors().values():
        tensor.requires_grad_()
    return parts


def test_only_visible_gaussians_in_free_cells_fade() -> None:
    free = np.zeros((4, 4, 4), dtype=bool)
    free[1, 2, 3] = True
    loss = FreeSpaceLoss(FreeSpace(np.array([10.0, 0.0, 0.0]), 0.5, free), CPU)
    # In the free cell, in it but not visible, in another cell, outside the grid on either side.
    scene = gaussians([(10.7, 1.2, 1.6), (10.7, 1.2, 1.7), (10.2, 1.2, 1.6), (9.9, 1.2, 1.6), (10.7, 1.2, 2.1)])
    value = loss(scene, torch.tensor([0, 2, 3, 4]))
    assert value.item() == pytest.approx(0.8 / 4)
    value.backward()
    assert scene.logit_opacities.grad is not None and scene.means.grad is None
    np.testing.assert_array_equal(scene.logit_opacities.grad.numpy() > 0, [True, False, False, False, False])


def ground() -> MeasuredPlanes:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 5, 0.25), np.arange(0, 5, 0.25)))
    position = np.stack([x, y, np.full(len(x), 2.0)], axis=1)
    return MeasuredPlanes(position, np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.full(len(x), 0.5), 0.1, 0.5)


def test_loss_is_that_of_the_distance_from_the_plane() -> None:
    loss = PlaneAttraction(ground(), CPU)
    for height_m in (0.0, 0.05, 0.3):
        scene = gaussians([(2.1, 3.3, 2.0 + height_m)])
        expected = 0.8 * 0.5 * np.log1p((height_m / 0.1) ** 2)
        assert loss(scene, torch.tensor([0])).item() == pytest.approx(expected, abs=1e-5)


def test_gaussians_fall_to_the_plane_and_distant_ones_stay() -> None:
    scene = gaussians([(2.1, 3.3, 2.2), (2.1, 3.3, 1.9), (2.1, 3.3, 4.0), (9.0, 3.3, 2.2), (-30.0, 0.0, 2.0)])
    PlaneAttraction(ground(), CPU)(scene, torch.arange(5)).backward()
    assert scene.means.grad is not None
    np.testing.assert_array_equal(np.sign(scene.means.grad[:, 2].numpy()), [1, -1, 0, 0, 0])
    assert not scene.means.grad[:, :2].any()
    assert scene.logit_opacities.grad is None  # no Gaussian escapes by fading
