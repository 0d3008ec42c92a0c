"""Default effort: the preset's, more for more and for larger photographs, never more Gaussians than fit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.memory import USABLE, predicted_peak_bytes
from pipelines.train.estimate import training_size, with_effort
from pipelines.train.options import MOST_LOOKS, PRESETS, TrainOptions

STANDARD = PRESETS["standard"]
SIDE_PX = 4 * STANDARD.max_image_size
LARGE = Pinhole(SIDE_PX, SIDE_PX * 3 // 4, 2e3, 2e3, SIDE_PX / 2, SIDE_PX * 3 / 8)
PIXELS = LARGE.width * LARGE.height
FREE = 256 * 2**30


def limit(options: TrainOptions, photographs: int, camera: Pinhole, free_bytes: int | None = FREE) -> int:
    return with_effort(options, photographs, camera, free_bytes).effort.max_gaussians


def test_what_the_user_states_and_small_photographs_stay_as_they_are() -> None:
    own = TrainOptions(max_gaussians=5000, max_image_size=SIDE_PX)
    assert with_effort(own, 90, LARGE, FREE) is own
    small = TrainOptions()
    assert with_effort(small, 90, LARGE.limited(STANDARD.max_image_size), FREE) is small


def test_larger_photographs_have_more_as_far_as_there_are_pixels() -> None:
    options, preset = TrainOptions(max_image_size=SIDE_PX), STANDARD.max_gaussians
    assert limit(options, 100, LARGE) == 16 * preset
    assert limit(options, 4, LARGE) == 4 * PIXELS // 40 > preset
    assert limit(options, 1, LARGE) == max(preset, PIXELS // 40)


@pytest.mark.parametrize("times", [3, 9])
def test_larger_photographs_have_no_more_than_fit(times: int) -> None:
    options = TrainOptions(max_image_size=SIDE_PX)
    size = training_size(options, 100, LARGE)
    free_bytes = int(predicted_peak_bytes(replace(size, gaussians=times * STANDARD.max_gaussians)) / USABLE)
    count = limit(options, 100, LARGE, free_bytes)
    assert count == pytest.approx(times * STANDARD.max_gaussians, abs=2000)
    assert predicted_peak_bytes(replace(size, gaussians=count)) <= USABLE * free_bytes


def test_memory_does_not_go_below_the_presets_number() -> None:
    """What does not fit with that is refused, or trained in blocks."""
    options = TrainOptions(max_image_size=SIDE_PX)
    assert limit(options, 100, LARGE, 2**28) == STANDARD.max_gaussians


def test_more_than_a_hundred_photographs_have_as_many_looks_each() -> None:
    small, preset = LARGE.limited(STANDARD.max_image_size), STANDARD
    effort = with_effort(TrainOptions(), 1000, small, FREE).effort
    assert (effort.iterations, effort.max_gaussians) == (10 * preset.iterations, 10 * preset.max_gaussians)
    assert with_effort(TrainOptions(iterations=70, max_gaussians=900), 1000, small, FREE).effort.iterations == 70


def test_few_photographs_are_not_looked_at_again_and_again() -> None:
    small = LARGE.limited(STANDARD.max_image_size)
    effort = with_effort(TrainOptions(), 18, small, FREE).effort
    assert (effort.iterations, effort.max_gaussians) == (18 * MOST_LOOKS, STANDARD.max_gaussians)
    assert with_effort(TrainOptions(iterations=2000), 18, small, FREE).effort.iterations == 2000
