"""Adam over Gaussians: torch's own where all rows move, and what happens to rows that do not, or are edited."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pipelines.splat.gaussians import Gaussians
from pipelines.splat.optimizer import EPS, GaussianAdam, LearningRates

ITERATIONS = 50


def random_gaussians(count: int, degree: int = 2, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(count, 3), normal(count, 4), normal(count, 3), normal(count), normal(count, (degree + 1) ** 2, 3)
    )


def fill_gradients(gaussians: Gaussians, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for tensor in gaussians.tensors().values():
        tensor.grad = torch.randn(tensor.shape, generator=generator) * 1e-4


def test_all_rows_is_plain_adam() -> None:
    start = random_gaussians(40)
    rates = LearningRates()
    ours = GaussianAdam(start, extent_m=5.0, iterations=ITERATIONS, rates=rates)
    theirs = {name: tensor.clone().requires_grad_() for name, tensor in start.tensors().items()}
    sh_rest = theirs.pop("sh")
    sh_dc, sh_rest = (
        sh_rest[:, :1].detach().clone().requires_grad_(),
        sh_rest[:, 1:].detach().clone().requires_grad_(),
    )
    groups = [{"params": [tensor], "lr": getattr(rates, name)} for name, tensor in theirs.items()]
    groups += [{"params": [sh_dc], "lr": rates.sh_dc}, {"params": [sh_rest], "lr": rates.sh_rest}]
    adam, first = torch.optim.Adam(groups, eps=EPS), [group["lr"] for group in groups]
    for iteration in range(ITERATIONS):
        fill_gradients(ours.gaussians, iteration)
        for name, tensor in theirs.items():
            tensor.grad = ours.gaussians.tensors()[name].grad.clone()
        sh_dc.grad, sh_rest.grad = ours.gaussians.sh.grad[:, :1].clone(), ours.gaussians.sh.grad[:, 1:].clone()
        # The centres' rate falls to a hundredth all the time, the others to a tenth from six tenths of it on.
        progress = iteration / ITERATIONS
        for group, rate in zip(adam.param_groups, first, strict=True):
            group["lr"] = rate * 0.1 ** (max(progress - 0.6, 0) / 0.4)
        adam.param_groups[0]["lr"] = 5.0 * 1.6e-4 * 0.01**progress
        ours.step(iteration)
        adam.step()
    expected = {**theirs, "sh": torch.cat([sh_dc, sh_rest], dim=1)}
    for name, tensor in ours.gaussians.tensors().items():
        # Fifty float32 steps of about the learning rate, rounded at the magnitude of the parameter.
        torch.testing.assert_close(tensor, expected[name], rtol=2e-6, atol=2e-6)


def test_only_the_given_rows_move() -> None:
    adam = GaussianAdam(random_gaussians(20), 1.0, ITERATIONS)
    before, state = adam.gaussians.detached().select(torch.arange(20)), adam.state()
    rows = torch.tensor([3, 11, 4])
    fill_gradients(adam.gaussians, 1)
    adam.step(0, rows)
    still = torch.ones(20, dtype=torch.bool)
    still[rows] = False
    for name, tensor in adam.gaussians.tensors().items():
        assert torch.equal(tensor[still], before.tensors()[name][still])
        assert (tensor[rows] != before.tensors()[name][rows]).all()
    for name, tensor in adam.state().items():
        assert torch.equal(tensor[still], state[name][still])


def test_copies_of_some_rows_move_these_rows_as_all_would() -> None:
    every, some = (GaussianAdam(random_gaussians(30), 2.0, ITERATIONS) for _ in range(2))
    tensors = GaussianAdam(random_gaussians(30), 2.0, ITERATIONS)
    for iteration in range(5):
        rows = torch.randperm(30, generator=torch.Generator().manual_seed(iteration))[:17].sort().values
        places = torch.arange(0, 17, 2)
        fill_gradients(every.show(), iteration)
        for adam in (some, tensors):
            for name, tensor in adam.show(rows).tensors().items():
                tensor.grad = every.gaussians.tensors()[name].grad[rows]
        every.step(iteration, rows[places])
        some.step(iteration, places)
        with torch.no_grad():
            tensors._step_by_tensors(iteration, places)
    for name, tensor in every.gaussians.tensors().items():
        assert torch.equal(tensor, some.gaussians.tensors()[name])
        torch.testing.assert_close(tensor, tensors.gaussians.tensors()[name], rtol=1e-6, atol=1e-6)


def test_first_update_of_a_row_is_one_rate_whenever_it_comes() -> None:
    adam = GaussianAdam(random_gaussians(2), 1.0, ITERATIONS, LearningRates())
    for iteration in range(30):
        fill_gradients(adam.gaussians, iteration)
        adam.step(iteration, torch.tensor([0]))
    before = adam.gaussians.log_scales[1].detach().clone()
    adam.step(30, torch.tensor([1]))
    moved = (adam.gaussians.log_scales[1] - before).abs()
    # m̂ / √v̂ = ±1 after one step with bias correction.
    torch.testing.assert_close(moved, torch.full((3,), 5e-3), rtol=1e-3, atol=1e-6)


def test_tensor_form_for_other_devices_agrees_with_the_kernel() -> None:
    kernel, tensors = (GaussianAdam(random_gaussians(30), 2.0, ITERATIONS) for _ in range(2))
    for iteration in range(5):
        rows = torch.randperm(30, generator=torch.Generator().manual_seed(iteration))[:17]
        fill_gradients(kernel.gaussians, iteration)
        fill_gradients(tensors.gaussians, iteration)
        kernel.step(iteration, rows)
        with torch.no_grad():
            tensors._step_by_tensors(iteration, rows)
    for name, tensor in kernel.gaussians.tensors().items():
        torch.testing.assert_close(tensor, tensors.gaussians.tensors()[name], rtol=1e-6, atol=1e-6)


def test_rearranged_rows_keep_their_moments_and_new_ones_have_none() -> None:
    adam = GaussianAdam(random_gaussians(6), 1.0, ITERATIONS)
    fill_gradients(adam.gaussians, 0)
    adam.step(0)
    before = adam.state()
    source = torch.tensor([5, 0, -1, 2])
    adam.rearrange(random_gaussians(4, seed=9), source)
    after = adam.state()
    for name in before:
        assert torch.equal(after[name][[0, 1, 3]], before[name][[5, 0, 2]])
        assert (after[name][2] == 0).all()
    assert all(tensor.requires_grad and tensor.is_leaf for tensor in adam.gaussians.tensors().values())


def test_overwriting_a_tensor_forgets_its_moments_only() -> None:
    adam = GaussianAdam(random_gaussians(6), 1.0, ITERATIONS)
    fill_gradients(adam.gaussians, 0)
    adam.step(0)
    before = adam.state()
    adam.overwrite("logit_opacities", torch.full((6,), -4.6))
    after = adam.state()
    assert (adam.gaussians.logit_opacities == -4.6).all()
    assert (after["exp_avg"][:, 10] == 0).all()
    assert (after["exp_avg_sq"][:, 10] == 0).all()
    keep = [column for column in range(before["exp_avg"].shape[1]) if column != 10]
    assert torch.equal(after["exp_avg"][:, keep], before["exp_avg"][:, keep])


def test_restored_state_continues_exactly() -> None:
    first = GaussianAdam(random_gaussians(12), 1.0, ITERATIONS)
    for iteration in range(3):
        fill_gradients(first.gaussians, iteration)
        first.step(iteration)
    second = GaussianAdam(first.gaussians, 1.0, ITERATIONS)
    second.restore(first.state())
    for adam in (first, second):
        fill_gradients(adam.gaussians, 7)
        adam.step(3)
    for name, tensor in first.gaussians.tensors().items():
        assert torch.equal(tensor, second.gaussians.tensors()[name])


def test_state_of_other_gaussians_is_refused() -> None:
    adam = GaussianAdam(random_gaussians(12), 1.0, ITERATIONS)
    with pytest.raises(ValueError, match="exp_avg"):
        adam.restore(GaussianAdam(random_gaussians(11), 1.0, ITERATIONS).state())


def test_step_without_gradient_is_refused() -> None:
    adam = GaussianAdam(random_gaussians(3), 1.0, ITERATIONS)
    fill_gradients(adam.gaussians, 0)
    adam.show()
    with pytest.raises(ValueError, match="means, quats_wxyz"):
        adam.step(0)


def test_rate_of_the_centres_falls_a_hundredfold() -> None:
    adam = GaussianAdam(random_gaussians(1), 1.0, ITERATIONS, LearningRates())
    assert adam.means_rate(0) == pytest.approx(1.6e-4)
    assert adam.means_rate(ITERATIONS // 2) == pytest.approx(1.6e-5)
    assert adam.means_rate(ITERATIONS) == pytest.approx(1.6e-6)


def test_short_trainings_have_higher_rates() -> None:
    assert LearningRates.for_iterations(30_000) == LearningRates()
    assert LearningRates.for_iterations(100_000) == LearningRates()
    short = LearningRates.for_iterations(3_750)
    assert short.sh_dc == pytest.approx(2 * 2.5e-3)
    assert short.log_scales == pytest.approx(8**0.6 * 5e-3)
    assert short.sh_rest == pytest.approx(8 * 1.25e-4)
    assert short.means_final / short.means == pytest.approx(0.01)
    assert LearningRates.for_iterations(1).sh_dc == pytest.approx(4 * 2.5e-3)
    assert LearningRates.for_iterations(1).sh_rest == pytest.approx(12 * 1.25e-4)
