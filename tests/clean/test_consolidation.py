"""Fewer Gaussians that show nearly the same: what is merged keeps its light, and leaves no holes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.clean.consolidation import consolidated, most_shown
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.level_of_detail import mixture_of
from pipelines.splat.metrics import psnr
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer


def wall(count: int = 3000, seed: int = 0) -> Gaussians:
    """Return opaque balls that cover a wall 4 m ahead, whose colour changes along it."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-3, 3, (count, 2)), np.full(count, 4.0)])
    colour = 0.5 + 0.4 * np.sin(2 * place[:, :1] + [0, 1, 2])
    return Gaussians(
        torch.from_numpy(place).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), float(np.log(0.08))),
        torch.full((count,), 1.5),
        torch.from_numpy((colour - 0.5) / 0.28209479).float()[:, None],
    )


def picture(gaussians: Gaussians) -> torch.Tensor:
    camera = Pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)
    return CpuRasterizer().render(gaussians, torch.eye(4), camera, RasterSettings(0)).colour


@pytest.mark.parametrize("share", [0.6, 0.3])
def test_merged_show_more_of_the_whole_than_the_chosen_alone(share: float) -> None:
    whole, shown = wall(), np.random.default_rng(1).uniform(size=3000).astype(np.float32)
    most = int(share * len(whole))
    fewer, chosen = consolidated(whole, shown, most), whole.select(torch.from_numpy(most_shown(shown, most)))
    assert len(fewer) == len(chosen) == most
    merged_db, chosen_db = (psnr(picture(some), picture(whole)) for some in (fewer, chosen))
    assert merged_db > chosen_db + 2


def test_merged_ones_have_the_moments_of_both_and_others_stay() -> None:
    """Two equal balls side by side, one far from all that stays, and one that nothing is near."""
    place = torch.tensor([[0.0, 0, 4], [0.1, 0, 4], [9.0, 0, 4], [-5.0, 0, 4]])
    four = Gaussians(**{name: tensor[:4].clone() for name, tensor in wall().tensors().items()})
    four.means, four.sh = place, torch.tensor([0.0, 1.0, 2.0, 3.0])[:, None, None].repeat(1, 1, 3)
    fewer = consolidated(four, np.array([4.0, 1.0, 0.5, 3.0], dtype=np.float32), 2)
    torch.testing.assert_close(fewer.means, torch.tensor([[0.05, 0, 4], [-5.0, 0, 4]]))
    torch.testing.assert_close(fewer.sh[:, 0, 0], torch.tensor([0.5, 3.0]))
    for name, tensor in fewer.tensors().items():  # to the last bit
        assert torch.equal(tensor[1], four.tensors()[name][3])
    before, after = (mixture_of(SplatArrays(**some.arrays())) for some in (four, fewer))
    assert after.mass[0] == pytest.approx(before.mass[:2].sum(), rel=1e-4)
    # Variance of the pair along x: that of each, and a quarter of the distance squared.
    assert after.covariances[0, 0, 0] / after.covariances[0, 1, 1] == pytest.approx(
        (0.08**2 + 0.05**2) / 0.08**2, rel=1e-3
    )


def test_few_enough_are_returned_as_they_are() -> None:
    whole = wall(20)
    assert consolidated(whole, np.ones(20, dtype=np.float32), 20) is whole
