"""Second epoch of the simulator: what changes, and what stays."""

import numpy as np
import pytest

from pipelines.simulate.mesh import Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.scene import build_scene


def test_the_town_changes_where_it_says_and_nowhere_else() -> None:
    """A pit of radius r and depth h has the volume π h r² (1/2 − 2/π²); cells of 2.5 m cost a little."""
    options = SimulateOptions(epoch="2", changes="excavation,new", change_height=1.5)
    seed = 3
    first, second = (
        build_scene("city", np.random.SeedSequence(seed)),
        build_scene("city", np.random.SeedSequence(seed), options),
    )
    line = np.arange(-45, 45, 0.5)
    place = np.stack([*(axis.ravel() for axis in np.meshgrid(line, line)), np.full(len(line) ** 2, 150.0)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], place.shape)
    risen = np.subtract(*(Raycaster(one.mesh).first_hits(place, down).distance for one in (first, second)))
    pit = np.pi * 1.5 * 64 * (0.5 - 2 / np.pi**2)
    assert -np.minimum(risen, 0).sum() * 0.25 == pytest.approx(pit, rel=0.05)
    assert {change.kind for change in second.changes} == {"excavation", "new"}
    building = next(change for change in second.changes if change.kind == "new").outline
    middle = building.mean(axis=0)
    far = np.linalg.norm(place[:, :2] - middle, axis=1) > 9
    assert np.maximum(risen[far], 0).max() < 0.01
    assert risen[np.argmin(np.linalg.norm(place[:, :2] - middle, axis=1))] > 4
    assert not np.allclose(first.sun, second.sun)
