"""Which part of a test view the training views cover, over level ground, where it can be told by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipelines.evaluate.photometric import TrainingCoverage
from pipelines.geometry.cameras import Pinhole, ViewPose

# From 10 m a nadir view shows 10 m across and 8 m along.
CAMERA = Pinhole(200, 160, 200.0, 200.0, 100.0, 80.0)
DOWN = np.diag([1.0, -1.0, -1.0])


def renderer_of(centres: list[tuple[float, float]], points: np.ndarray, turn: np.ndarray = DOWN) -> SimpleNamespace:
    """Training views at all centres but the last, the test view, which looks along the rows of `turn`."""
    poses = [ViewPose(CAMERA, DOWN, np.array([x, y, 10.0])) for x, y in centres]
    poses[-1] = ViewPose(CAMERA, turn, poses[-1].center_in_model)
    split = {"train": list(range(len(centres) - 1)), "test": [len(centres) - 1]}
    model = SimpleNamespace(point_in_model=lambda _sfm: points, indices=split.__getitem__)
    return SimpleNamespace(model=model, sfm=None, pose=poses.__getitem__)


@pytest.fixture
def ground() -> np.ndarray:
    plane = np.random.default_rng(0).uniform(-30, 30, size=(4000, 2))
    return np.column_stack([plane, np.zeros(len(plane))])


def test_covered_is_what_two_views_show(ground: np.ndarray) -> None:
    """Views at 0 and 4 m share −1 … 5 m; of the test view at 6 m, which shows 1 … 11 m, these are 40 %."""
    mask = TrainingCoverage(renderer_of([(0, 0), (4, 0), (6, 0)], ground)).covered(2)  # type: ignore[arg-type]
    assert mask is not None
    assert mask.shape == (160, 200)
    column = 1 / 48  # resolution of the answer
    assert float(mask.double().mean()) == pytest.approx(0.4, abs=column)
    assert mask[:, : int(200 * (0.4 - column))].all()
    assert not mask[:, int(200 * (0.4 + column)) :].any()


def test_one_view_is_not_enough(ground: np.ndarray) -> None:
    mask = TrainingCoverage(renderer_of([(0, 0), (0, 0)], ground)).covered(1)  # type: ignore[arg-type]
    assert mask is not None
    assert not mask.any()


def test_sky_is_not_covered(ground: np.ndarray) -> None:
    """A level view: the horizon lies in the middle row."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    centres = [(x, y) for x in range(-20, 21, 2) for y in range(0, 41, 2)]
    mask = TrainingCoverage(renderer_of([*centres, (0, 0)], ground, level)).covered(len(centres))  # type: ignore[arg-type]
    assert mask is not None
    assert not mask[:80].any()
    assert mask[150:].all()


def test_without_points_nothing_is_known() -> None:
    assert TrainingCoverage(renderer_of([(0, 0), (0, 0)], np.zeros((0, 3)))).covered(1) is None  # type: ignore[arg-type]
