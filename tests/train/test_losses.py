"""The sum of a training's losses: weights, schedule, shares of crops, and losses that a view does not have."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch

from pipelines.splat.surface import SurfaceSettings
from pipelines.survey.photographs import ImageCache
from pipelines.train.losses import Loss, training_losses, weighted_sum
from pipelines.train.schedule import JointOptions, TrainingSchedule
from tests import tiny_training as tiny

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageCache:
    return tiny.photographs(tmp_path_factory.mktemp("photographs"), tiny.true_gaussians())


def test_weights_shares_and_values_are_multiplied_and_added() -> None:
    leaf = torch.tensor(3.0, requires_grad=True)

    def never(_view: object) -> torch.Tensor:
        raise AssertionError("a loss without weight is not computed")

    losses = [
        Loss("plain", lambda _view: 2 * leaf),
        Loss("weighted", lambda _view: leaf.square(), lambda iteration: 0.5 * iteration, lambda _view: 4.0),
        Loss("of other views", lambda _view: None),
        Loss("not due", never, lambda _iteration: 0.0),
    ]
    total, values = weighted_sum(losses, cast(Any, None), 3)
    total.backward()
    assert float(total.detach()) == 2 * 3 + 4 * 1.5 * 9
    assert leaf.grad is not None and float(leaf.grad) == 2 + 4 * 1.5 * 2 * 3
    assert {name: float(value.detach()) for name, value in values.items()} == {"plain": 6, "weighted": 9}


def test_the_list_of_a_training(images: ImageCache) -> None:
    """Measured surfaces add their losses before the normals, whose turn comes at times.

    A loss whose weight nobody has set stands in the list without being in use.
    """
    settings = SurfaceSettings(normals=0.02, normals_from=0.5, normals_every=4)
    schedule = TrainingSchedule(JointOptions(40, surface=settings), np.arange(len(images)))
    trainer = tiny.trainer(images, schedule.options)
    measured = Loss("planes", lambda _view: None)
    losses = training_losses(trainer.problem, trainer.strategy, schedule, extent_m=1.0, measured=[measured])
    names = [
        "photometric",
        "transparency",
        "control_by_depth",
        "geographic",
        "density control",
        "flatness",
        "compactness",
        "depth",
    ]
    in_use = {loss.name: loss for loss in losses if loss.weight(40)}
    assert list(in_use) == [*names, "planes", "normals"]
    assert [in_use["normals"].weight(iteration) for iteration in (8, 20, 21, 24)] == [0, 0, 0, 0.08]
    assert in_use["geographic"].weight(40) == schedule.geographic_weight(40)
    plain = TrainingSchedule(JointOptions(40), np.arange(len(images)))
    without = training_losses(trainer.problem, trainer.strategy, plain, extent_m=1.0, measured=[measured])
    assert [loss.name for loss in without if loss.weight(40)] == names[:5]
