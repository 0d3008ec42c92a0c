"""The schedule of a training: order of views, harmonics, size of photographs, weight and rate."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from pipelines.train.options import LossOptions
from pipelines.train.schedule import JointOptions, TrainingSchedule
from pipelines.train.target_images import Crops

VIEWS = np.array([0, 1, 2, 4, 5, 6, 7, 8, 10, 11, 12, 13])


def test_every_view_is_seen_once_an_epoch_in_an_order_of_its_own() -> None:
    schedule, other = (TrainingSchedule(JointOptions(60, seed=seed), VIEWS) for seed in (0, 1))
    seen = [schedule.view(iteration) for iteration in range(1, 37)]
    assert Counter(seen) == dict.fromkeys(VIEWS.tolist(), 3)
    for epoch in range(3):
        assert len(set(seen[12 * epoch : 12 * epoch + 12])) == 12
    assert seen[:12] != seen[12:24]
    assert seen != [other.view(iteration) for iteration in range(1, 37)]


def test_harmonics_grow_up_to_half_of_the_training() -> None:
    schedule = TrainingSchedule(JointOptions(60, sh_degree=2), VIEWS)
    assert [schedule.sh_degree(iteration) for iteration in range(1, 61)] == [0] * 9 + [1] * 10 + [2] * 41


def test_photographs_are_shrunken_early_and_never_below_their_least_size() -> None:
    schedule = TrainingSchedule(JointOptions(100, coarse=((4, 0.1), (2, 0.3)), coarse_least_px=160), VIEWS)
    assert [schedule.shrink(iteration, 640, 480) for iteration in (1, 10, 11, 30, 31, 100)] == [4, 4, 2, 2, 1, 1]
    assert [schedule.shrink(1, side, side) for side in (639, 320, 319, 100)] == [3, 2, 1, 1]


def test_large_photographs_are_pyramids() -> None:
    """20 megapixels are seen as a whole, then at half of that factor, then as they are."""
    options = JointOptions(100, coarse=((2, 0.3),), crops=Crops(1024))
    schedule = TrainingSchedule(options, VIEWS)
    at = [schedule.shrink(iteration, 5472, 3648) for iteration in (1, 30, 31, 50, 51, 100)]
    assert at == [5, 5, 2, 2, 1, 1]
    assert [schedule.shrink(iteration, 1024, 768) for iteration in (30, 31)] == [2, 1]


def test_weight_rises_or_stays_and_rates_fall() -> None:
    rising, constant = (
        TrainingSchedule(JointOptions(1000, losses=LossOptions(geo_weight=0.05, geo_schedule=kind)), VIEWS)
        for kind in ("rising", "constant")
    )
    # Eq. 27 with τ of a tenth of the training.
    assert rising.geographic_weight(100) == pytest.approx(0.05 * (1 - np.exp(-1)))
    assert rising.geographic_weight(1000) == pytest.approx(0.05, rel=1e-4)
    assert constant.geographic_weight(1) == 0.05
    assert rising.geographic_rate(0) == 1.0
    assert rising.geographic_rate(1000) == pytest.approx(0.05)


def test_extended_training_neither_shrinks_photographs_again_nor_drops_harmonics() -> None:
    """Where it goes on, the longer schedule has shrunken photographs and degree 0: a step back."""
    schedule = TrainingSchedule(JointOptions(1000, sh_degree=3, coarse=((2, 0.3),)), VIEWS)
    assert (schedule.shrink(120, 640, 480), schedule.sh_degree(120)) == (2, 0)
    schedule.extended_from = 100
    assert (schedule.shrink(120, 640, 480), schedule.sh_degree(120)) == (1, 3)
    assert schedule.geographic_rate(120) == pytest.approx(0.05**0.12), "rates are those of the longer training"
