"""Gaussians that are written and read again are the same tensors."""

from __future__ import annotations

from pathlib import Path

import torch

from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians


def test_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(0)
    before = Gaussians(
        torch.randn(9, 3, requires_grad=True),
        torch.randn(9, 4),
        torch.randn(9, 3),
        torch.randn(9),
        torch.randn(9, 9, 3),
    )
    write_gaussians(tmp_path / "splat.ply", before)
    after = read_gaussians(tmp_path / "splat.ply")
    assert after.sh_degree == 2
    for name, tensor in before.tensors().items():
        assert torch.equal(after.tensors()[name], tensor)
        assert not after.tensors()[name].requires_grad
