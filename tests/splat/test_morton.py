"""Z-order: a permutation in which neighbours in memory are neighbours in space."""

from __future__ import annotations

import itertools

import torch

from pipelines.splat.spatial import morton_order


def test_cells_of_a_grid_follow_the_z_curve() -> None:
    cells = torch.tensor(list(itertools.product(range(8), repeat=3)), dtype=torch.float32)
    shuffled = cells[torch.randperm(512, generator=torch.Generator().manual_seed(0))]
    ordered = shuffled[morton_order(shuffled)]
    # Each run of eight is one block of 2×2×2 cells, and each run of sixty-four one of 4×4×4.
    for run, size in ((8, 2), (64, 4)):
        corner = (ordered // size).reshape(-1, run, 3)
        assert (corner == corner[:, :1]).all()


def test_degenerate_clouds_are_permuted_too() -> None:
    assert morton_order(torch.zeros(0, 3)).tolist() == []
    assert morton_order(torch.ones(4, 3)).tolist() == [0, 1, 2, 3]
