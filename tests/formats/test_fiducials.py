"""Tags found in drawn pictures, against the truth of the drawing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from pipelines.formats.fiducials import (
    FoundTag,
    dictionary_named,
    dictionary_names,
    find_tags,
    tag_count,
    tag_modules,
)

APRIL, ARUCO = "DICT_APRILTAG_36h11", "DICT_4X4_250"
_SIZE = 900, 700  # width and height
_SAMPLES = 8  # per pixel along each axis


@dataclass(frozen=True)
class _Drawn:
    """A tag as drawn: its number, centre (2,) in pixels, and shortest side."""

    number: int
    center_px: np.ndarray
    side_px: float


def _picture(
    dictionary: str, seed: int, side_px: tuple[float, float], noise: float = 3.0
) -> tuple[np.ndarray, list[_Drawn]]:
    """Return a grey picture of twelve tags, turned and seen obliquely, with blur and noise, and what it shows."""
    random = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(random.integers(0, 255, _SIZE[::-1]).astype(np.float32), (0, 0), 6)
    ground = 110 + 6 * (ground - ground.mean())
    drawn = []
    for place in range(12):
        number = int(random.integers(tag_count(dictionary)))
        modules = np.pad(tag_modules(dictionary, number), 1, constant_values=1).astype(np.float32)
        half, angle = random.uniform(*side_px) / 2, random.uniform(0, 2 * np.pi)
        center = np.array([110 + 220 * (place % 4), 120 + 230 * (place // 4)]) + random.uniform(-20, 20, 2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        tilt = np.array([[1.0, 0.0], [0.0, random.uniform(0.75, 1.0)]])
        # A tag of width 2 about zero, into pixels
        oblique, shift = np.eye(3), np.eye(3)
        oblique[:2, :2], oblique[2, :2] = half * tilt @ turn, random.uniform(-0.05, 0.05, 2)
        shift[:2, 2] = center
        matrix = shift @ oblique
        corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) @ matrix.T
        corners = corners[:, :2] / corners[:, 2:]
        side = float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).min())
        drawn.append(_Drawn(number, center, side))
        first = np.floor(corners.min(axis=0) - half).astype(int)
        last = np.ceil(corners.max(axis=0) + half).astype(int)
        # Areas of pixels by many samples: their places on the tag, exactly
        width, height = (last - first).tolist()
        image_from_sample = np.array(
            [[1, 0, first[0] * _SAMPLES + 0.5], [0, 1, first[1] * _SAMPLES + 0.5], [0, 0, _SAMPLES]]
        )
        inner = (len(modules) - 2) / 2
        cell_from_tag = np.array([[inner, 0, inner + 1], [0, inner, inner + 1], [0, 0, 1]])
        to_middle = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # the nearest cell is the one it lies in
        cell_from_sample = to_middle @ cell_from_tag @ np.linalg.inv(matrix) @ image_from_sample
        grey = 30 + 190 * modules
        share, tag = (
            cv2.warpPerspective(
                cells,
                cell_from_sample,
                (width * _SAMPLES, height * _SAMPLES),
                flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            )
            .reshape(height, _SAMPLES, width, _SAMPLES)
            .mean(axis=(1, 3))
            for cells in (np.ones_like(grey), grey)
        )
        rows, columns = slice(first[1], last[1]), slice(first[0], last[0])
        ground[rows, columns] = ground[rows, columns] * (1 - share) + tag
    blurred = cv2.GaussianBlur(ground, (0, 0), 0.6) + random.normal(0, noise, ground.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8), drawn


def _pairs(drawn: list[_Drawn], found: list[FoundTag]) -> list[tuple[_Drawn, FoundTag]]:
    """Return what was drawn with what was found of it; a tag that was not drawn fails."""
    pairs = []
    for tag in found:
        mine = [one for one in drawn if np.linalg.norm(one.center_px - tag.center_px) < 0.5 * one.side_px]
        assert [one.number for one in mine] == [tag.number]
        pairs.append((mine[0], tag))
    return pairs


@pytest.mark.parametrize("dictionary", [APRIL, ARUCO])
def test_centres_are_found_as_well_as_their_sigma_says(dictionary: str) -> None:
    drawn, pairs = [], []
    for seed in range(8):
        picture, shown = _picture(dictionary, seed, (26, 70))
        drawn += shown
        pairs += _pairs(shown, find_tags(picture, [dictionary]))
    large = sum(one.side_px >= 20 for one in drawn)
    assert sum(one.side_px >= 20 for one, _ in pairs) >= 0.95 * large >= 60
    error = np.array([tag.center_px - one.center_px for one, tag in pairs])
    sigma = np.array([tag.sigma_px for _, tag in pairs])
    print(
        dictionary,
        len(pairs),
        len(drawn),
        np.sqrt((error**2).mean()),
        np.sqrt(((error / sigma[:, None]) ** 2).mean()),
    )
    assert np.sqrt((error**2).mean()) < 0.06
    assert 0.7 < np.sqrt(((error / sigma[:, None]) ** 2).mean()) < 1.4
    # No shift in one direction, as of half a pixel between two ways of counting
    assert np.abs(error.mean(axis=0)).max() < 0.02


def test_noise_raises_sigma() -> None:
    quiet, noisy = (
        np.median([tag.sigma_px for tag in find_tags(_picture(APRIL, 1, (40, 50), noise)[0], [APRIL])])
        for noise in (1.0, 12.0)
    )
    assert noisy > 1.5 * quiet


def test_other_dictionaries_and_texture_are_no_tags() -> None:
    picture, _ = _picture(APRIL, 2, (30, 60))
    assert find_tags(picture, ["DICT_5X5_100"]) == []
    texture = np.random.default_rng(0).integers(0, 255, (90, 120), dtype=np.uint8)
    blocks = cv2.resize(texture, (1200, 900), interpolation=cv2.INTER_NEAREST)
    assert find_tags(blocks, [APRIL, ARUCO]) == []


def test_hidden_and_cut_tags_are_not_shifted() -> None:
    picture, drawn = _picture(APRIL, 3, (60, 70))
    for one in drawn[:6]:  # a corner under grass
        x, y = (one.center_px + 0.2 * one.side_px).astype(int)
        cv2.rectangle(picture, (x, y), (x + 60, y + 60), 100, -1)
    for one, tag in _pairs(drawn, find_tags(picture, [APRIL])):
        assert np.abs(tag.center_px - one.center_px).max() < 0.3
    x, y = (drawn[7].center_px).astype(int)
    assert all(tag.number != drawn[7].number for tag in find_tags(picture[y:, x:], [APRIL]))


def test_hostile_pictures_find_nothing() -> None:
    for shape in ((1, 1), (1, 4000), (12, 12), (3000, 2)):
        assert find_tags(np.zeros(shape, dtype=np.uint8), [APRIL]) == []


def test_dictionaries_have_their_names_in_any_case() -> None:
    named = dictionary_named("dict_apriltag_36H11")
    assert named is not None and named.upper() == APRIL.upper()
    assert dictionary_named("DICT_NONE") is None
    assert {ARUCO} <= set(dictionary_names())
    assert tag_count(ARUCO) == 250
