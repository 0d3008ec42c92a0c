"""Default limit of Gaussians: the preset's at its image size, more for larger photographs, never more than fit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.memory import USABLE, predicted_peak_bytes
from pipelines.train.gaussian_limit import training_size, with_gaussian_limit
from pipelines.train.options import TrainOptions
from pipelines.train.presets import PRESETS

LARGE = Pinhole(2560, 1920, 2000.0, 2000.0, 1280.0, 960.0)  # four times the size of `standard`
FREE = 64 * 2**30


def limit(options: TrainOptions, photographs: int, camera: Pinhole, free_bytes: int | None = FREE) -> int:
    return with_gaussian_limit(options, photographs, camera, free_bytes).effort.max_gaussians


def test_what_the_user_states_and_small_photographs_stay_as_they_are() -> None:
    own = TrainOptions(max_gaussians=5000, max_image_size=2560)
    assert with_gaussian_limit(own, 1000, LARGE, FREE) is own
    small = TrainOptions()
    assert with_gaussian_limit(small, 1000, LARGE.limited(640), FREE) is small


def test_larger_photographs_have_more_as_far_as_there_are_pixels() -> None:
    options, preset = TrainOptions(max_image_size=2560), PRESETS["standard"].max_gaussians
    assert limit(options, 1000, LARGE) == 16 * preset
    assert limit(options, 4, LARGE) == 4 * 2560 * 1920 // 40
    assert limit(options, 1, LARGE) == max(preset, 2560 * 1920 // 40)


@pytest.mark.parametrize("free_gib", [2, 4])
def test_larger_photographs_have_no_more_than_fit(free_gib: int) -> None:
    options, free_bytes = TrainOptions(max_image_size=2560), free_gib * 2**30
    count = limit(options, 1000, LARGE, free_bytes)
    assert PRESETS["standard"].max_gaussians < count < 16 * PRESETS["standard"].max_gaussians
    size = training_size(options.model_copy(update={"max_gaussians": count}), 1000, LARGE)
    assert predicted_peak_bytes(size) <= USABLE * free_bytes
    assert predicted_peak_bytes(replace(size, gaussians=count + 2000)) > USABLE * free_bytes


def test_memory_does_not_go_below_the_presets_number() -> None:
    """What does not fit with that is refused, or trained in blocks."""
    options = TrainOptions(max_image_size=2560)
    assert limit(options, 1000, LARGE, 2**28) == PRESETS["standard"].max_gaussians
