"""Density control: who is cloned, split, removed and reset, when, and with what memory."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.densify import DefaultSettings, DefaultStrategy, DensityEdit
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import ScreenStats

CAMERA = Pinhole(200, 100, 100.0, 100.0, 100.0, 50.0)
SETTINGS = DefaultSettings(start=0, stop=1000, every=10, reset_every=0, prune_scale_from=1000, max_gaussians=100)
EXTENT_M = 10.0
SMALL_M, LARGE_M = 0.05, 0.5  # either side of 1 % of the extent


def gaussians(sigma_m: list[float], opacity: float = 0.5) -> Gaussians:
    count = len(sigma_m)
    index = torch.arange(count, dtype=torch.float32)
    return Gaussians(
        means=torch.stack([index, 0.1 * index, -index], dim=1),
        quats_wxyz=torch.tensor([0.5, 0.5, -0.5, 0.5]).repeat(count, 1),
        log_scales=torch.tensor(sigma_m).log()[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=index[:, None, None].repeat(1, 4, 3),
    )


def stats_of(gradient_px: Tensor, rows: Tensor | None = None) -> ScreenStats:
    rows = torch.arange(len(gradient_px)) if rows is None else rows
    return ScreenStats(rows, gradient_px)


def setup(
    start: Gaussians, settings: DefaultSettings = SETTINGS, seed: int = 0
) -> tuple[GaussianAdam, DefaultStrategy]:
    return GaussianAdam(start, EXTENT_M, 1000), DefaultStrategy(settings, EXTENT_M, len(start), seed)


def hot(count: int, rows: list[int]) -> Tensor:
    gradient = torch.zeros(count, 2)
    gradient[rows, 0] = 1e-5  # ndc: 1e-5 × 200 px / 2 = 1e-3, five times the threshold
    return gradient


def test_threshold_is_in_normalised_device_coordinates() -> None:
    # 2e-4 in ndc is 2e-6 per pixel along 200 pixels, and 4e-6 along 100.
    gradient = torch.tensor([[2.1e-6, 0], [1.9e-6, 0], [0, 4.1e-6], [0, 3.9e-6]])
    adam, strategy = setup(gaussians([SMALL_M] * 4))
    strategy.observe(stats_of(gradient), CAMERA)
    assert strategy.update(10, adam) == DensityEdit(cloned=2)


def test_gradient_is_the_mean_over_the_views_that_saw_it() -> None:
    adam, strategy = setup(gaussians([SMALL_M] * 2))
    strategy.observe(stats_of(torch.tensor([[3e-6, 0], [3e-6, 0]])), CAMERA)
    strategy.observe(stats_of(torch.tensor([[0.5e-6, 0]]), rows=torch.tensor([1])), CAMERA)
    # Row 0 has a mean of 3e-6, row 1 of 1.75e-6.
    assert strategy.update(10, adam) == DensityEdit(cloned=1)
    assert sorted(adam.gaussians.sh[:, 0, 0].tolist()) == [0, 0, 1]


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    adam, strategy = setup(gaussians([SMALL_M, LARGE_M, SMALL_M]))
    strategy.observe(stats_of(hot(3, [0, 1])), CAMERA)
    assert strategy.update(10, adam) == DensityEdit(cloned=1, split=1)
    after = adam.gaussians
    label, sigma = after.sh[:, 0, 0], after.log_scales[:, 0].exp()
    assert sorted(label.tolist()) == [0, 0, 1, 1, 2]
    torch.testing.assert_close(sigma[label == 0], torch.full((2,), SMALL_M))
    torch.testing.assert_close(sigma[label == 1], torch.full((2,), LARGE_M / 1.6))
    assert torch.equal(after.means[label == 0][0], after.means[label == 0][1])
    distance = (after.means[label == 1] - torch.tensor([1.0, 0.1, -1.0])).norm(dim=1)
    assert (distance > 0).all()
    assert (distance < 5 * LARGE_M).all()


def test_children_are_spread_like_their_parent() -> None:
    # 4000 samples of σ = (0.5, 0.2, 0.1) turned by the quaternion: the covariance is known to about 5 %.
    start = gaussians([LARGE_M] * 2000)
    start.means = torch.zeros(2000, 3)
    start.log_scales = torch.tensor([0.5, 0.2, 0.1]).log().repeat(2000, 1)
    adam, strategy = setup(start, replace(SETTINGS, max_gaussians=10_000))
    strategy.observe(stats_of(hot(2000, list(range(2000)))), CAMERA)
    strategy.update(10, adam)
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # (½, ½, −½, ½) as a matrix
    expected = turn @ torch.diag(torch.tensor([0.25, 0.04, 0.01])) @ turn.T
    sample = adam.gaussians.means.detach().T.cov()
    torch.testing.assert_close(sample, expected, rtol=0.12, atol=0.006)


def test_transparent_and_oversized_ones_are_removed() -> None:
    # A tenth of extent and distance from the middle: 1 m at the first, 6 m at the last, which is a part of the sky.
    start = gaussians([SMALL_M, SMALL_M, 1.4, 5.0])
    start.means[3] = torch.tensor([0.0, 30.0, 40.0])
    start.logit_opacities[1] = math.log(0.004 / 0.996)
    adam, strategy = setup(start, replace(SETTINGS, prune_scale_from=10))
    assert strategy.update(10, adam) == DensityEdit(pruned=1)  # the size counts later
    assert strategy.update(20, adam) == DensityEdit(pruned=1)
    assert sorted(adam.gaussians.sh[:, 0, 0].tolist()) == [0, 3]


def test_limit_takes_the_largest_gradients_first() -> None:
    adam, strategy = setup(gaussians([SMALL_M] * 4), replace(SETTINGS, max_gaussians=6))
    gradient = torch.tensor([[3e-6, 0], [9e-6, 0], [5e-6, 0], [7e-6, 0]])
    strategy.observe(stats_of(gradient), CAMERA)
    assert strategy.update(10, adam) == DensityEdit(cloned=2)
    assert sorted(adam.gaussians.sh[:, 0, 0].tolist()) == [0, 1, 1, 2, 3, 3]
    strategy.observe(stats_of(hot(6, [0, 1, 2])), CAMERA)
    assert strategy.update(20, adam) == DensityEdit()


def test_moments_follow_their_gaussians() -> None:
    adam, strategy = setup(gaussians([SMALL_M, LARGE_M, SMALL_M, SMALL_M]))
    for tensor in adam.gaussians.tensors().values():
        tensor.grad = torch.ones_like(tensor) * torch.arange(1, 5).reshape(4, *[1] * (tensor.ndim - 1))
    adam.step(1)
    before = adam.state()
    strategy.observe(stats_of(hot(4, [0, 1])), CAMERA)
    strategy.update(10, adam)
    after, label = adam.state(), adam.gaussians.sh[:, 0, 0].round().int()
    for row in range(4):
        copies = after["exp_avg"][label == row]
        known = copies[copies.abs().sum(dim=1) > 0]
        expected = before["exp_avg"][row : row + 1] if row != 1 else before["exp_avg"][:0]
        assert torch.equal(known, expected)


def test_reset_caps_the_opacities() -> None:
    adam, strategy = setup(gaussians([SMALL_M] * 3, opacity=0.5), replace(SETTINGS, every=7, reset_every=10))
    with torch.no_grad():
        adam.gaussians.logit_opacities[1] = -6.0
    assert strategy.update(10, adam) == DensityEdit(opacity_reset=True)
    opacity = torch.sigmoid(adam.gaussians.logit_opacities)
    torch.testing.assert_close(opacity, torch.tensor([0.01, 1 / (1 + math.exp(6)), 0.01]))


def test_nothing_happens_outside_the_schedule() -> None:
    settings = replace(SETTINGS, start=20, stop=50, reset_every=30)
    adam, strategy = setup(gaussians([SMALL_M] * 3), settings)
    strategy.observe(stats_of(hot(3, [0, 1, 2])), CAMERA)
    assert [strategy.update(iteration, adam) for iteration in (10, 20, 25, 55, 60)] == [DensityEdit()] * 5
    assert strategy.update(40, adam) == DensityEdit(cloned=3)


def test_same_seed_same_gaussians_and_restored_state_continues_exactly() -> None:
    start = gaussians([LARGE_M] * 5)
    results = []
    for saved in (False, False, True):
        adam, strategy = setup(start, seed=3)
        strategy.observe(stats_of(hot(5, [0, 3])), CAMERA)
        strategy.update(10, adam)
        strategy.observe(stats_of(hot(7, [1])), CAMERA)
        if saved:
            state, moments = strategy.state(), adam.state()
            strategy = DefaultStrategy(SETTINGS, EXTENT_M, len(adam.gaussians), seed=99)
            adam = GaussianAdam(adam.gaussians, EXTENT_M, 1000)
            strategy.restore(state)
            adam.restore(moments)
        strategy.update(20, adam)
        results.append(adam.gaussians.means.detach())
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


@pytest.mark.parametrize("iterations", [300, 1000, 3000, 7000])
def test_short_schedules_still_densify_and_leave_time_to_settle(iterations: int) -> None:
    settings = DefaultSettings.for_iterations(iterations, 1000)
    edits = [i for i in range(settings.start + 1, settings.stop + 1) if i % settings.every == 0]
    assert len(edits) >= 2
    assert settings.stop <= iterations / 2
    assert settings.reset_every == 0 or iterations - settings.reset_every > 1500


def test_schedule_of_30000_iterations_is_that_of_the_paper() -> None:
    assert DefaultSettings.for_iterations(30_000, 1_000_000) == DefaultSettings()


def test_large_survey_has_the_schedule_of_a_small_one_in_as_many_times_the_iterations() -> None:
    # A Gaussian is seen by a tenth of the share of the photographs: as often between two edits, and never reset.
    one, ten = (
        DefaultSettings.for_iterations(1500, 1000),
        DefaultSettings.for_iterations(15_000, 1000, surveys=10.0),
    )
    assert (ten.start, ten.stop, ten.every) == (10 * one.start, 10 * one.stop, 10 * one.every)
    assert one.reset_every == ten.reset_every == 0


def test_render_without_backward_is_refused() -> None:
    _, strategy = setup(gaussians([SMALL_M]))
    with pytest.raises(ValueError, match="backward"):
        strategy.observe(ScreenStats(torch.zeros(1, dtype=torch.int64)), CAMERA)
