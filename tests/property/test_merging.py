"""Merged Gaussians keep mass, mean, covariance and colour, and every Gaussian is in exactly one leaf of a tree."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.types import rows_of
from pipelines.formats.splat_ply import SplatArrays
from pipelines.splat.level_of_detail import (
    DetailTile,
    Mixture,
    Tiler,
    best_cut,
    bounds_of,
    build_tiles,
    drawn,
    merged,
    mixture_of,
    scene_box,
)

SEEDS = st.integers(0, 2**32 - 1)


def splat(seed: int, count: int, opacity: float = 0.5) -> SplatArrays:
    """Clusters, single Gaussians far away, giants, and several at the same place."""
    rng = np.random.default_rng(seed)

    def rows(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    means = rows(3) * np.exp(2 * rows(1))
    means[rng.random(count) < 0.2] = means[0]
    scales = 0.7 * rows(3) - 2 + 3 * (rng.random((count, 1)) < 0.05)
    logit = np.full(count, np.log(opacity / (1 - opacity)), np.float32) + rows()
    return SplatArrays(means, rows(4), scales.astype(np.float32), logit, rows(4, 3))


def moments(mixture: Mixture) -> tuple[np.ndarray, ...]:
    """Mass, mean, covariance and harmonics of all rows together, by the definition."""
    share = mixture.mass / mixture.mass.sum()
    mean = share @ mixture.means
    second = mixture.covariances + np.einsum("ni,nj->nij", mixture.means, mixture.means)
    covariance = np.einsum("n,nij->ij", share, second) - np.outer(mean, mean)
    return mixture.mass.sum(), mean, covariance, np.einsum("n,nkc->kc", share, mixture.sh)


@given(seed=SEEDS, count=st.integers(2, 60), groups=st.integers(1, 8))
@settings(max_examples=40, deadline=None)
def test_merging_keeps_the_moments(seed: int, count: int, groups: int) -> None:
    mixture = mixture_of(splat(seed, count))
    starts = np.unique(np.append(0, np.random.default_rng(seed).integers(0, count, groups)))
    fewer = merged(mixture, starts)
    assert len(fewer.mass) == len(starts)
    for once in (fewer, merged(fewer, np.array([0]))):  # and what is merged again
        for value, expected in zip(moments(once), moments(mixture), strict=True):
            # Harmonics are float32; the second moments of far groups cancel.
            np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-5)


@given(seed=SEEDS, count=st.integers(1, 40))
@settings(max_examples=20, deadline=None)
def test_what_fits_is_drawn_with_its_moments(seed: int, count: int) -> None:
    """Gaussians that are neither too massive nor too small to be shown are drawn as they are."""
    gaussians = splat(seed, count, opacity=0.2)
    before = mixture_of(gaussians)
    after = mixture_of(drawn(before, 0.0))
    np.testing.assert_allclose(after.mass, before.mass, rtol=1e-4)
    size = np.einsum("nii->n", before.covariances)[:, None, None]
    np.testing.assert_allclose(after.covariances / size, before.covariances / size, atol=1e-5)
    np.testing.assert_array_equal(after.means, gaussians.means)


@given(seed=SEEDS, count=st.integers(1, 800), largest=st.integers(20, 200), most_parts=st.integers(1, 9))
@settings(max_examples=12, deadline=None)
def test_tree(seed: int, count: int, largest: int, most_parts: int) -> None:
    gaussians = splat(seed, count, opacity=0.05)
    number = np.arange(count, dtype=np.float32)
    gaussians.sh[:, 0, 0] = number
    rows = np.array_split(np.argsort(gaussians.means[:, 0]), min(most_parts, count))
    parts = [rows_of(gaussians, part) for part in rows]
    contents: dict[str, SplatArrays] = {}
    leaves: list[str] = []

    def write(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
        assert name not in contents
        contents[name] = content
        leaves.extend([name] * is_leaf)

    root = build_tiles(parts, scene_box(gaussians.means), Tiler(largest, write))
    tiles = list(root.all())
    assert sorted(tile.name for tile in tiles) == sorted(contents)
    assert sorted(tile.name for tile in tiles if not tile.children) == sorted(leaves)
    held = np.concatenate([contents[name].sh[:, 0, 0] for name in leaves])
    np.testing.assert_array_equal(np.sort(held), number)
    mass = mixture_of(gaussians).mass.sum()
    for tile in tiles:
        content = contents[tile.name]
        assert tile.count == len(content) <= largest
        _assert_inside(bounds_of(mixture_of(content)), tile)
        for child in tile.children:
            assert tile.error_m >= 2 * child.error_m
            _assert_inside(child.bounds, tile)
        assert (tile.error_m > 0) == bool(tile.children)
    # The root shows as much as all of them, as far as no group is more than opaque.
    assert mixture_of(contents[root.name]).mass.sum() <= mass * (1 + 1e-4)
    cut = best_cut(root, 2 * largest)
    assert sum(tile.count for tile in cut) <= max(2 * largest, root.count)
    assert _leaves_of(cut) == sorted(leaves)


def _leaves_of(tiles: list[DetailTile]) -> list[str]:
    return sorted(tile.name for top in tiles for tile in top.all() if not tile.children)


def _assert_inside(box: np.ndarray, tile: DetailTile) -> None:
    margin = 1e-6 * (1 + np.abs(box).max())
    assert (box[0] >= tile.bounds[0] - margin).all()
    assert (box[1] <= tile.bounds[1] + margin).all()
