"""The fast strategy: views together decide what is added, and what no view would miss goes."""

from __future__ import annotations

import pytest
import torch

from pipelines.splat.densify import (
    DefaultSettings,
    DensityEdit,
    FastSettings,
    FastStrategy,
    Probe,
    ViewContributions,
    view_contributions,
)
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings, ScreenStats
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from tests import tiny_training as tiny

SETTINGS = DefaultSettings(start=0, stop=50, every=10, reset_every=0, max_gaussians=100)
FAST = FastSettings(views=2, high_error_px=1.0, least_px=0.5, least_views=2, prune_stop=90)
POSE = torch.eye(4)


def setup(count: int = 4) -> tuple[GaussianAdam, FastStrategy]:
    start = tiny.true_gaussians(count)
    start.sh[:, 0] = torch.arange(count)[:, None].float()
    adam, strategy = GaussianAdam(start, 1000.0, 100), FastStrategy(SETTINGS, FAST, 1000.0, count)
    strategy.observe(ScreenStats(torch.arange(count), torch.ones(count, 2)), tiny.PINHOLE)
    return adam, strategy


def probe(*views: tuple[list[float], list[float]]) -> Probe:
    def look(count: int, generator: torch.Generator) -> list[ViewContributions]:
        assert count == FAST.views
        return [ViewContributions(torch.tensor(weight), torch.tensor(error)) for weight, error in views]

    return look


def labels(adam: GaussianAdam) -> list[float]:
    return sorted(adam.gaussians.sh[:, 0, 0].tolist())


def test_only_what_views_agree_to_be_wrong_is_added_to() -> None:
    adam, strategy = setup()
    # All four have gradients. 0 is wrong in both views, 1 in one of two, 2 in the only one that sees it, 3 in none.
    seen = probe(([9.0, 9.0, 0.0, 9.0], [1.2, 1.8, 0.0, 0.1]), ([9.0, 9.0, 9.0, 9.0], [1.2, 0.0, 1.1, 0.1]))
    assert strategy.update(10, adam, seen) == DensityEdit(cloned=2)
    assert labels(adam) == [0, 0, 1, 2, 2, 3]


def test_what_no_view_would_miss_goes_if_enough_views_saw_it() -> None:
    adam, strategy = setup()
    # 0 is needed by one view, 1 by none of two, 2 was hardly seen by one alone, 3 was not seen.
    seen = probe(([0.1, 0.4, 0.2, 0.0], [0.0] * 4), ([2.0, 0.4, 0.0, 0.0], [0.0] * 4))
    assert strategy.update(10, adam, seen) == DensityEdit(pruned=1)
    assert labels(adam) == [0, 2, 3]


def test_after_the_last_addition_it_only_removes() -> None:
    adam, strategy = setup()
    seen = probe(([9.0, 0.1, 9.0, 9.0], [9.0] * 4), ([9.0, 0.1, 9.0, 9.0], [9.0] * 4))
    assert strategy.update(70, adam, seen) == DensityEdit()
    assert strategy.update(80, adam, seen) == DensityEdit(pruned=1)
    assert strategy.update(120, adam, seen) == DensityEdit()


def test_it_cannot_work_without_views() -> None:
    adam, strategy = setup()
    with pytest.raises(ValueError, match="needs a probe"):
        strategy.update(10, adam)


def test_contributions_are_what_each_gaussian_adds_to_the_pixels() -> None:
    gaussians = tiny.true_gaussians(12)
    error = torch.zeros(48, 64)
    error[:, :32] = 0.5
    error[:, 32:] = 0.02  # below a tenth of the largest
    contributions = view_contributions(gaussians, POSE, tiny.PINHOLE, error, CpuRasterizer())

    def alpha(part: Gaussians) -> torch.Tensor:
        return CpuRasterizer().render(part, POSE, tiny.PINHOLE, RasterSettings(sh_degree=0)).alpha

    # Σ over Gaussians of w is the image's alpha, and a lone Gaussian's weight is its own alpha.
    whole = alpha(gaussians)
    assert float(contributions.weight_px.sum()) == pytest.approx(float(whole.sum()), rel=1e-4)
    assert float(contributions.high_error_px.sum()) == pytest.approx(float(whole[:, :32].sum()), rel=1e-4)
    lone = gaussians.select(torch.tensor([3]))
    single = view_contributions(lone, POSE, tiny.PINHOLE, error, CpuRasterizer())
    assert float(single.weight_px[0]) == pytest.approx(float(alpha(lone).sum()), rel=1e-4)
