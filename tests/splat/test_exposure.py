"""Exposures of photographs: found again where they differ, and never by changing all of them together."""

from __future__ import annotations

import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.exposure import Exposures, fitted_affine, squared_radius, with_affine, with_vignetting

CPU = torch.device("cpu")
TRAIN = torch.tensor([0, 1, 3])


def identities(count: int) -> torch.Tensor:
    return torch.eye(3, 4).repeat(count, 1, 1)


def picture(seed: int = 0) -> torch.Tensor:
    return torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(seed))


def test_gains_that_differ_are_found_and_their_mean_is_frozen() -> None:
    # Photograph 0 is 10 % brighter and 1 is 10 % darker than the scene; 3 is as the scene is.
    gain = {0: 1.1, 1: 0.9, 3: 1.0}
    exposures, colour = Exposures(identities(4), TRAIN, 600), picture()
    for iteration in range(1, 601):
        index = int(TRAIN[iteration % 3])
        shown = exposures.apply(index, colour)
        (shown - gain[index] * colour).square().mean().backward()
        exposures.step(iteration)
    for index, factor in gain.items():
        shown = with_affine(colour, exposures.affine[index])
        assert float((shown - factor * colour).abs().max()) < 0.01
    torch.testing.assert_close(exposures.affine[TRAIN].mean(dim=0), torch.eye(3, 4), atol=1e-6, rtol=0)
    assert torch.equal(exposures.affine[2], torch.eye(3, 4))


def test_a_photograph_without_light_has_the_gains_of_its_neighbours() -> None:
    """Photograph 1 is black: it tells its offset alone. Those beside it are brighter than the others."""
    gain, train = {0: 1.1, 1: 1.0, 2: 1.1, 3: 0.9, 4: 0.9}, torch.arange(5)
    exposures, colour = Exposures(identities(5), train, 1000), picture()
    for iteration in range(1, 1001):
        index = iteration % 5
        shown = exposures.apply(index, 0 * colour if index == 1 else colour)
        target = 0 * colour if index == 1 else gain[index] * colour
        (shown - target).square().mean().backward()
        exposures.step(iteration)
    gains = torch.stack([exposures.affine[index, :, :3].diagonal() for index in range(5)])
    assert float((gains[1] - (gains[0] + gains[2]) / 2).abs().max()) < 0.02
    assert float((gains[0] - gains[3]).min()) > 0.15


def test_a_common_gain_is_left_to_the_gaussians() -> None:
    exposures, colour = Exposures(identities(4), TRAIN, 300), picture()
    for iteration in range(1, 301):
        shown = exposures.apply(int(TRAIN[iteration % 3]), colour)
        (shown - 1.2 * colour).square().mean().backward()
        exposures.step(iteration)
    # The last step moves one of three further than the others: a rate of 5e-4 at the end.
    assert float((exposures.affine - torch.eye(3, 4)).abs().max()) < 0.01


def test_vignetting_of_each_lens_is_found_beside_the_exposures() -> None:
    """To 1.5 % in every pixel, of up to 30 %: the mean of the exposures, and the middle, are frozen at 1."""
    whole = Pinhole(32, 24, 30.0, 30.0, 16.5, 11.0)
    radius2 = squared_radius(whole, whole, CPU)
    assert 0.9 < float(radius2.max()) <= 1.0
    part = Pinhole(8, 6, 30.0, 30.0, 16.5 - 20, 11.0 - 10)
    torch.testing.assert_close(squared_radius(part, whole, CPU), radius2[10:16, 20:28])
    true = {7: torch.tensor([-0.3, 0.1, -0.1]), 9: torch.tensor([-0.1, 0.0, 0.05])}
    lens, gain, colour = [7, 7, 7, 9], {0: 1.1, 1: 0.9, 3: 1.0}, torch.rand(24, 32, 3)
    exposures = Exposures(identities(4), TRAIN, 1500, lens)
    for iteration in range(1, 1501):
        index = int(TRAIN[iteration % 3])
        shown = exposures.apply(index, colour, radius2)
        (shown - gain[index] * with_vignetting(colour, radius2, true[lens[index]])).square().mean().backward()
        exposures.step(iteration)
    grey = torch.ones(24, 32, 3)
    for row, number in enumerate(exposures.lenses):
        found = with_vignetting(grey, radius2, exposures.vignetting[row])
        assert float((found - with_vignetting(grey, radius2, true[number])).abs().max()) < 0.015
    shown = with_affine(colour, exposures.affine[0])
    assert float((shown - gain[0] * colour).abs().max()) < 0.01


def test_the_kernel_has_values_and_gradients_of_the_plain_version() -> None:
    draw = torch.Generator().manual_seed(3)
    exposures = Exposures(torch.eye(3, 4) + 0.1 * torch.rand(4, 3, 4, generator=draw), TRAIN, 10)
    exposures.vignetting.copy_(torch.tensor([[-0.3, 0.1, -0.05]]))
    camera = Pinhole(16, 12, 15.0, 15.0, 8.5, 5.5)
    radius2, weight = squared_radius(camera, camera, CPU), torch.rand(12, 16, 3, generator=draw)
    colours = [picture().requires_grad_() for _ in range(2)]
    leaves = [exposures.affine[1].clone().requires_grad_(), exposures.vignetting[0].clone().requires_grad_()]
    plain = with_affine(with_vignetting(colours[0], radius2, leaves[1]), leaves[0])
    shown = exposures.apply(1, colours[1], radius2)
    torch.testing.assert_close(shown, plain)
    for image in (plain, shown):
        (weight * image.square()).sum().backward()
    assert exposures._used is not None
    for one, other in zip((colours[0], *leaves), (colours[1], *exposures._used[1:]), strict=True):
        torch.testing.assert_close(other.grad, one.grad)


def test_a_state_continues_exactly() -> None:
    def run(exposures: Exposures, first: int, last: int) -> None:
        for iteration in range(first, last):
            shown = exposures.apply(int(TRAIN[iteration % 3]), picture())
            (shown - picture(iteration % 3 + 1)).abs().mean().backward()
            exposures.step(iteration)

    whole, part, resumed = (Exposures(identities(4), TRAIN, 40) for _ in range(3))
    run(whole, 1, 30)
    run(part, 1, 13)
    resumed.restore(part.state())
    run(resumed, 13, 30)
    assert torch.equal(whole.affine, resumed.affine)


def test_least_squares_finds_an_affine_change_exactly_and_ignores_what_is_masked() -> None:
    true = torch.tensor([[0.9, 0.1, 0.0, 0.05], [0.0, 1.1, 0.0, -0.02], [0.02, 0.0, 0.8, 0.1]])
    rendered = picture()
    photograph, mask = with_affine(rendered, true), torch.ones(12, 16, dtype=torch.bool)
    photograph[:3], mask[:3] = 7.0, False
    torch.testing.assert_close(fitted_affine(rendered, photograph, mask), true, atol=1e-5, rtol=0)


def test_a_render_of_one_colour_still_has_a_fit() -> None:
    fit = fitted_affine(torch.full((4, 4, 3), 0.5), torch.full((4, 4, 3), 0.25))
    torch.testing.assert_close(with_affine(torch.full((3,), 0.5), fit), torch.full((3,), 0.25), atol=1e-6, rtol=0)
