"""Matches guided by the largest features, of two simulated photographs of which the true matches are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, project
from pipelines.geometry.rotations import exp_so3
from pipelines.sfm.guided_matches import MOST_DISTANCE, RATIO, GuidedFeatures, guided_matches
from pipelines.sfm.near_matches import DESCRIPTOR_LENGTH, Expected, SiftFeatures, matches_near

LENS = Camera("PINHOLE", 1600, 1200, np.array([1400.0, 1400.0, 800.0, 600.0]))
DOWN = np.diag([1.0, -1.0, -1.0])
POINTS = 9000
NOISE_PX = 0.4
LOOKS = 10  # of plants: features that look alike


@dataclass(frozen=True)
class Ground:
    """Points (N, 3) of a ground with relief: of each the size of a feature in metres, its azimuth and its look."""

    point: FloatArray
    size_m: FloatArray
    azimuth: FloatArray
    look: FloatArray

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, alike: float = 0.0) -> Ground:
        """Draw a ground, of which a share of the points look like many others."""
        point = rng.uniform((-60, -45, 0), (60, 45, 0.1), (POINTS, 3))
        point[:, 2] += 6 * (np.sin(point[:, 0] / 9) > 0.6)  # ridges, with steps
        look = rng.gamma(0.6, 1.0, (POINTS, 128))
        few = rng.gamma(0.6, 1.0, (LOOKS, 128))
        plants = rng.random(POINTS) < alike
        look[plants] = few[rng.integers(0, LOOKS, int(plants.sum()))]
        return cls(point, 0.08 * rng.pareto(2.0, POINTS) + 0.08, rng.uniform(-np.pi, np.pi, POINTS), look)

    def seen(self, rng: np.random.Generator, height_m: float, heading_deg: float) -> tuple[SiftFeatures, IntArray]:
        """Return the features of a photograph from above, and the points (F,) that they are of."""
        turn = exp_so3(np.array([0, 0, np.radians(heading_deg)])) @ exp_so3(rng.normal(0, 0.03, 3)) @ DOWN
        center = np.array([*rng.uniform(-8, 8, 2), height_m])
        tip = self.point + self.size_m[:, None] * np.stack(
            [np.cos(self.azimuth), np.sin(self.azimuth), np.zeros(POINTS)], axis=1
        )
        xy, end = (project(LENS, (each - center) @ turn) for each in (self.point, tip))
        shown = ((xy > 0) & (xy < (LENS.width, LENS.height))).all(axis=1) & (rng.random(POINTS) < 0.7)
        rows = rng.permutation(np.flatnonzero(shown))
        axis = (end - xy)[rows]
        spin, grown = rng.normal(0, 0.08, len(rows)), np.exp(rng.normal(0, 0.1, len(rows)))
        cos, sin = grown * np.cos(spin), grown * np.sin(spin)
        axis = np.stack([cos * axis[:, 0] - sin * axis[:, 1], sin * axis[:, 0] + cos * axis[:, 1]], axis=1)
        vector = np.maximum(self.look[rows] + rng.normal(0, 0.25, (len(rows), 128)), 0)
        vector *= DESCRIPTOR_LENGTH / np.linalg.norm(vector, axis=1, keepdims=True)
        noisy = xy[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))
        descriptor = vector.clip(0, 255).astype(np.uint8)
        return SiftFeatures(noisy.astype(np.float32), axis.astype(np.float32), descriptor), rows


def true_matches(one: IntArray, other: IntArray) -> set[tuple[int, int]]:
    _, mine, theirs = np.intersect1d(one, other, return_indices=True)
    return set(zip(mine.tolist(), theirs.tolist(), strict=True))


def compared_with_all(first: SiftFeatures, second: SiftFeatures) -> set[tuple[int, int]]:
    """The matches of features that are the best, and unique, among all of the other photograph."""
    one, other = (each.descriptor.astype(np.float64) for each in (first, second))
    square = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
    found: set[tuple[int, int]] = set()
    for table in (square, square.T):
        nearest = np.partition(table, 1, axis=1)[:, :2]
        good = (nearest[:, 0] < RATIO**2 * nearest[:, 1]) & (
            nearest[:, 0] < (MOST_DISTANCE * DESCRIPTOR_LENGTH) ** 2
        )
        pairs = np.stack([np.flatnonzero(good), table.argmin(axis=1)[good]], axis=1)
        pairs = pairs if table is square else pairs[:, ::-1]
        chosen = {(i, j) for i, j in pairs.tolist()}
        found = chosen if table is square else found & chosen
    return found


@pytest.mark.parametrize(("height_m", "heading_deg"), [(60.0, 0.0), (60.0, 175.0), (38.0, -60.0)])
def test_guided_matches_are_those_of_a_comparison_with_all(height_m: float, heading_deg: float) -> None:
    rng = np.random.default_rng(7)
    ground = Ground.drawn(rng)
    (first, one), (second, other) = ground.seen(rng, 60.0, 0.0), ground.seen(rng, height_m, heading_deg)
    rows = guided_matches(GuidedFeatures(first), GuidedFeatures(second))
    guided, true, plain = set(map(tuple, rows.tolist())), true_matches(one, other), compared_with_all(first, second)
    assert len(plain) > 0.9 * len(true)  # all are unique: the comparison with all finds nearly all
    # Steps of the ground displace a feature from where guides on the other storey tell it to be.
    assert len(guided & plain) > 0.97 * len(plain)
    assert len(guided - true) < 0.01 * len(guided)


def test_plants_that_look_alike_are_matched_where_guides_tell() -> None:
    rng = np.random.default_rng(3)
    ground = Ground.drawn(rng, alike=0.6)
    (first, one), (second, other) = ground.seen(rng, 60.0, 0.0), ground.seen(rng, 60.0, 90.0)
    rows = guided_matches(GuidedFeatures(first), GuidedFeatures(second))
    guided, true, plain = set(map(tuple, rows.tolist())), true_matches(one, other), compared_with_all(first, second)
    assert len(plain) < 0.45 * len(true)  # six of ten look like a tenth of the others
    assert len(guided & true) > 1.8 * len(plain)
    assert len(guided - true) < 0.03 * len(guided)  # at a tenth of the density, another plant is seldom in reach


def test_photographs_of_other_places_have_no_matches() -> None:
    rng = np.random.default_rng(5)
    (first, _), (second, _) = (Ground.drawn(rng).seen(rng, 60.0, 0.0) for _ in range(2))
    nothing = first.of(np.arange(0))
    for one, other in ((first, second), (first, nothing), (nothing, nothing)):
        assert guided_matches(GuidedFeatures(one), GuidedFeatures(other)).shape == (0, 2)


def test_descriptors_that_are_not_those_of_sift_are_not_read(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    kind = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        database.write_camera(pycolmap.Camera(camera_id=1, model="PINHOLE", width=9, height=9, params=[9, 9, 4, 4]))
        for key, values in enumerate((64, 128), start=1):
            database.write_image(pycolmap.Image(name=f"{key}.jpg", camera_id=1, image_id=key), use_image_id=True)
            database.write_keypoints(key, np.ones((5, 4), np.float32))
            database.write_descriptors(key, pycolmap.FeatureDescriptors(kind, np.ones((5, values), np.uint8)))
        assert [len(SiftFeatures.read(database, key)) for key in (1, 2)] == [0, 5]


def slow_matches(
    first: SiftFeatures, second: SiftFeatures, expected: Expected, ratio: float, most: float
) -> set[tuple[int, int]]:
    """`matches_near`, candidate by candidate."""
    apart = np.full((len(first.xy_px), len(second.xy_px)), np.inf)
    for i in range(len(first.xy_px)):
        for place, radius, axis in zip(*(part[i] for part in expected), strict=True):
            near = np.linalg.norm(second.xy_px - place, axis=1) <= radius
            size, other = np.linalg.norm(axis), np.linalg.norm(second.axis_px, axis=1)
            alike = (other < 2 * size) & (size < 2 * other)
            turned = second.axis_px @ axis > np.cos(0.5) * size * other
            rows = np.flatnonzero(near & alike & turned & (radius > 0))
            difference = second.descriptor[rows].astype(int) - first.descriptor[i].astype(int)
            apart[i, rows] = np.sqrt((difference**2).sum(axis=1)) / DESCRIPTOR_LENGTH

    def unique(distance: FloatArray, xy_px: Float32Array) -> dict[int, int]:
        best = {}
        for key, row in enumerate(distance):
            value = int(row.argmin())
            elsewhere = np.linalg.norm(xy_px - xy_px[value], axis=1) > 3
            if row[value] <= most and row[value] < ratio * row[elsewhere].min(initial=np.inf):
                best[key] = value
        return best

    forth, back = unique(apart, second.xy_px), unique(apart.T, first.xy_px)
    return {(i, j) for i, j in forth.items() if back.get(j) == i}


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 60), others=st.integers(1, 60))
def test_matches_near_expected_places_are_those_of_a_search_one_by_one(seed: int, count: int, others: int) -> None:
    rng = np.random.default_rng(seed)
    prototype = rng.integers(0, 120, (8, 128))

    def drawn(number: int) -> SiftFeatures:
        # Places on a grid wider than "the same place", where some have two features as SIFT's do.
        xy = 5 * rng.integers(0, 20, (number, 2))
        looks = prototype[rng.integers(0, 8, number)] + rng.integers(0, 40, (number, 128))
        axis = rng.normal((3, 0), 1, (number, 2))
        return SiftFeatures(xy.astype(np.float32), axis.astype(np.float32), looks.astype(np.uint8))

    first, second = drawn(count), drawn(others)
    place = rng.uniform(-10, 110, (count, 3, 2)).astype(np.float32)
    radius = rng.uniform(-5, 60, (count, 3)).astype(np.float32)
    axis = rng.normal((3, 0), 0.5, (count, 3, 2)).astype(np.float32)
    expected = Expected(place, radius, axis)
    rows = matches_near(first, second, expected, ratio=0.9, most_distance=0.8)
    assert set(map(tuple, rows.tolist())) == slow_matches(first, second, expected, 0.9, 0.8)
