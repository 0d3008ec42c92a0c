"""Held-out squares of a measured cloud, and the error of a surface at their points, whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipelines.core.products import save_npz
from pipelines.core.types import rows_of
from pipelines.evaluate.held_out import held_out_depths
from pipelines.geometry.cameras import CameraPoses, Pinhole, ViewPose
from pipelines.geometry.similarity import Similarity
from pipelines.surface.lidar_cloud import in_held_out_squares
from pipelines.survey.lidar_report import HeldOutPoints
from pipelines.train.lidar import held_out_points
from tests.towns import EXTRA, FOCAL_PX, SIGMA_M, SIZE, TOWN, WITH_EXTRA, Town, scanned, views_of

CAMERA = Pinhole(*SIZE, FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2)
VIEWS = views_of(TOWN)
DEPTH = VIEWS.depth_m.reshape(12, SIZE[1], SIZE[0])


def test_squares_are_the_same_whatever_else_the_cloud_holds() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-400, 400, (200_000, 3))
    held = in_held_out_squares(points, 4.0, 0.05)
    # 40 000 squares: σ of the share is 0.001.
    assert held.mean() == pytest.approx(0.05, abs=0.005)
    some = rng.permutation(len(points))[:1000]
    assert (in_held_out_squares(points[some], 4.0, 0.05) == held[some]).all()
    corner = np.floor(points / 4.0)[:, :2]
    squares = {tuple(place) for place in corner[held].tolist()}
    assert squares.isdisjoint(tuple(place) for place in corner[~held].tolist())
    assert not in_held_out_squares(points, 4.0, 0.0).any()


def split(town: Town) -> tuple[Any, Any]:
    cloud = scanned(town)
    held = in_held_out_squares(cloud.position_in_model, 4.0, 0.3)
    return rows_of(cloud, held), rows_of(cloud, ~held)


def maps(up_m: float) -> Any:
    """Depth maps of the town that lies higher."""
    poses = CameraPoses(VIEWS.cam_from_world, VIEWS.center_in_world + np.array([0, 0, up_m]))
    return SimpleNamespace(
        scene=SimpleNamespace(train=np.arange(12), poses=poses), camera=lambda _: CAMERA, depth=DEPTH.__getitem__
    )


def renderer() -> Any:
    """Renders of the town as it is, in a model of half its size."""
    pose = [ViewPose(CAMERA, VIEWS.cam_from_world[index], VIEWS.center_in_world[index]) for index in range(12)]
    return SimpleNamespace(geo_from_model=Similarity(scale=0.5), pose=pose.__getitem__, depth_m=DEPTH.__getitem__)


def test_a_surface_that_lies_higher_is_in_front_of_level_points_by_that(tmp_path: Any) -> None:
    """Points of the ground and of roofs: the planes have the scanner's noise over the root of their neighbours."""
    held, used = split(TOWN)
    found = held_out_points(held, np.zeros(len(held), dtype=bool), used, maps(0.3), 0.3)
    assert len(found.view) + int(found.unseen) == len(held) and len(found.view) > 0.8 * len(held)
    level = found.normal_in_model[:, 2] > 0.95
    assert np.nanmedian(found.before_m[level]) == pytest.approx(0.3, abs=0.01)
    rows = {name: vars(found)[name][level] for name in ("point_in_model", "normal_in_model", "view", "before_m")}
    save_npz(tmp_path / "held_out.npz", vars(replace(found, **rows)))
    result = held_out_depths(renderer(), HeldOutPoints.load(tmp_path / "held_out.npz"))
    # Lengths of the result are those of the Earth, where the town has half its size in the model.
    assert result.before.bias_m == pytest.approx(0.15, abs=0.005)
    assert result.after.median_m is not None and result.after.median_m < 0.5 * SIGMA_M
    assert (result.before.points, result.share) == (result.after.points, pytest.approx(0.3))
    assert 0.9 * result.points < result.after.points <= min(result.known_before, result.known_after)


def test_what_has_changed_and_what_is_hidden_does_not_count() -> None:
    """A building that is gone: its points are left out, and hide nothing; a wall's far side is no view's."""
    held, used = split(WITH_EXTRA)
    low, high = EXTRA[0] + [-0.1, -0.1, 0.5], EXTRA[1] + 0.1
    gone = [
        ((cloud.position_in_model > low) & (cloud.position_in_model < high)).all(axis=1) for cloud in (held, used)
    ]
    assert gone[0].sum() > 20
    found = held_out_points(held, gone[0], rows_of(used, ~gone[1]), maps(0.0), 0.3)
    assert int(found.changed) == gone[0].sum()
    assert np.nanpercentile(np.abs(found.before_m), 80) < 0.1
