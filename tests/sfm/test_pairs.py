"""Pairs to match: whatever the layout, images that overlap are tied together, and those that cannot are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.sfm.features import candidate_pairs, select_pairs
from tests.sfm_scenes import CONFIG, survey_of

DOWN = np.array([0.0, 0.0, -1.0])


def looking(position: np.ndarray, axis: np.ndarray = DOWN) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(position, dtype=np.float64), np.broadcast_to(axis, (len(position), 3)).copy()


def test_all_pairs_are_every_unordered_pair_once() -> None:
    four, one = (candidate_pairs(survey_of([f"{index}.jpg" for index in range(n)]), CONFIG) for n in (4, 1))
    assert four.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert one.shape == (0, 2)


def test_lines_with_dense_forward_overlap_are_tied_across() -> None:
    # Ten lines 40 m apart, a photograph every 4 m: the sixteen nearest of any image all lie on its own line.
    lines, along = 10, 30
    north, east = np.meshgrid(40.0 * np.arange(lines), 4.0 * np.arange(along), indexing="ij")
    pairs = select_pairs(*looking(np.column_stack([east.ravel(), north.ravel(), np.full(east.size, 80.0)])), 16)
    line = np.arange(lines * along) // along
    across = pairs[line[pairs[:, 0]] != line[pairs[:, 1]]]
    for first in range(lines - 1):
        joining = (line[across] == [first, first + 1]).all(axis=1)
        assert joining.sum() >= along  # each image of a line is tied, on average, to the next one
    assert len(pairs) <= 17 * lines * along


def test_views_that_look_apart_are_not_matched() -> None:
    # An orbit that looks outwards: opposite images are near each other and have nothing in common.
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(24)])
    pairs = select_pairs(5.0 * outwards, outwards, 20)
    cosine = (outwards[pairs[:, 0]] * outwards[pairs[:, 1]]).sum(axis=1)
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() <= 60.0 + 1e-6
    assert len(pairs) >= 24 * 3  # 15° apart: up to four neighbours on either side look alike


def test_back_to_back_views_stay_apart() -> None:
    # Two facades, photographed back to back from one lane.
    position = np.column_stack([np.tile(3.0 * np.arange(12), 2), np.repeat([0.0, 1.0], 12), np.full(24, 10.0)])
    axis = np.repeat([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], 12, axis=0)
    pairs = select_pairs(position, axis, 8)
    crossing = pairs[(pairs[:, 0] < 12) & (pairs[:, 1] >= 12)]
    assert crossing.tolist() == [[11, 12]]  # successors in the list, which may well be a turn


def test_images_without_position_are_paired_with_all() -> None:
    position = np.column_stack([100.0 * np.arange(60), np.zeros(60), np.full(60, 80.0)])
    position[[7, 30]] = np.nan
    pairs = {tuple(pair) for pair in select_pairs(*looking(position), 4).tolist()}
    for lost in (7, 30):
        assert {(min(i, lost), max(i, lost)) for i in range(60) if i != lost} <= pairs
    assert (0, 50) not in pairs


def test_unknown_view_direction_does_not_exclude() -> None:
    position = np.column_stack([10.0 * np.arange(8), np.zeros(8), np.full(8, 80.0)])
    position, axis = looking(position)
    axis[3], axis[4] = np.nan, -DOWN
    pairs = {tuple(pair) for pair in select_pairs(position, axis, 6).tolist()}
    assert (2, 3) in pairs
    assert (1, 3) in pairs
    assert (2, 4) not in pairs


@pytest.mark.parametrize("same_place", [False, True])
def test_two_images(same_place: bool) -> None:
    position = np.zeros((2, 3)) if same_place else np.array([[0.0, 0, 80], [10, 0, 80]])
    assert select_pairs(*looking(position), 16).tolist() == [[0, 1]]


@given(
    count=st.integers(1, 40),
    neighbours=st.integers(2, 20),
    unknown=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_pairs_are_sorted_unique_ordered_and_connected(
    count: int, neighbours: int, unknown: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    position = rng.normal(0, 50, (count, 3))
    position[rng.random(count) < unknown] = np.nan
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    axis[rng.random(count) < unknown] = np.nan
    pairs = select_pairs(position, axis, neighbours)
    assert pairs.shape[1] == 2
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.tolist() == [list(pair) for pair in sorted({tuple(pair) for pair in pairs.tolist()})]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    assert connected_components(graph, directed=False)[0] == 1
