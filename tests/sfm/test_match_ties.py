"""Places that matches do not determine are refused: a lens looks down from 10 m beside a model of the ground."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.cameras import Camera, bearings, project
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.sfm import joining
from pipelines.sfm.joining import join_by_matches
from pipelines.sfm.mapping import map_database
from pipelines.sfm.match_ties import Side, Tie, tie
from pipelines.sfm.unregistered import unregistered
from tests.refusals import numbers, said
from tests.sfm.test_joining import BEFORE, HEIGHT_M, WIDE, scene

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

DOWN = np.diag([1.0, -1.0, -1.0])
TRUE = np.array([0.4, 3.0, HEIGHT_M])  # of the photograph that waits
NOISE_PX = 0.3


def views(
    point: FloatArray, known: BoolArray, shift_m: FloatArray | float = 0.0, lens: Camera = WIDE
) -> tuple[Side, Side]:
    """What two photographs show of points (M, 3), of which `known` are the model's.

    The second one is the photograph that waits, in its own frame; it shows the points `shift_m` further on.
    """
    rng = np.random.default_rng(5)
    turn = exp_so3(np.array([0.02, -0.01, 0.3])) @ DOWN
    sides = []
    for rotation, center, seen, alone in (
        (DOWN, np.array([0.0, 0.0, HEIGHT_M]), point, False),
        (turn, TRUE, point + np.multiply.outer(shift_m, [0.0, 1.0, 0.0]), True),
    ):
        xy = project(lens, (seen - center) @ rotation.T) + rng.normal(0, NOISE_PX, (len(point), 2))
        sides.append(
            Side(
                {1: lens},
                np.full(len(point), 2 if alone else 1),
                np.ones(len(point), dtype=np.int64),
                xy,
                bearings(lens, xy),
                np.broadcast_to(np.eye(3) if alone else rotation, (len(point), 3, 3)),
                np.broadcast_to(np.zeros(3) if alone else center, (len(point), 3)),
                np.where((known & (not alone))[:, None], point, np.nan),
            )
        )
    return sides[0], sides[1]


def ground(count: int, half_m: float = 3.0) -> FloatArray:
    """Points of a square with a relief of a quarter of its side, which both photographs show."""
    half, middle = np.array([half_m, 0.8 * half_m, 0.25 * half_m]), np.array([0.0, 1.5, 0.0])
    return np.random.default_rng(2).uniform(middle - half, middle + half, (count, 3))


def test_matches_that_agree_tie_it() -> None:
    """The rule's other side: what is refused below is refused for its reason alone."""
    point = ground(80)
    found = tie(pycolmap, *views(point, np.arange(80) < 20), has_scale=False)
    assert isinstance(found, Tie)
    assert np.linalg.norm(found.model_from_part.apply(np.zeros(3)) - TRUE) < 4 * found.sigma * HEIGHT_M


@pytest.mark.parametrize(
    ("matches", "points", "said_numbers"),
    [
        (29, 29, [29, 30]),  # too few of all
        (60, 3, [60, 3, 0, 4]),  # too few of points: the distance would be a guess
        (60, 0, [60, 0, 0, 4]),
    ],
)
def test_too_few_matches_are_refused(matches: int, points: int, said_numbers: list[int]) -> None:
    refusal = tie(pycolmap, *views(ground(matches), np.arange(matches) < points), has_scale=False)
    assert isinstance(refusal, str)
    assert numbers(refusal) == said_numbers


@pytest.mark.parametrize(("points", "agree", "of"), [(120, 30, 120), (20, 5, 20)])
def test_matches_of_several_places_are_refused(points: int, agree: int, of: int) -> None:
    """Rows of a field: four groups of matches, each shifted by other periods along the rows, fit a place each.

    Along the line of flight, rays meet whatever the shift: only the points tell.
    """
    period = np.repeat([-2.4, -1.2, 1.2, 2.4], 30)
    model, part = views(ground(120), np.arange(120) % (120 // points) == 0, shift_m=period)
    refusal = tie(pycolmap, model, part, has_scale=False)
    assert isinstance(refusal, str)
    found = numbers(refusal)
    assert found[0] <= agree and found[1] == of


TELE = replace(WIDE, params=np.array([2700.0, 512.0, 384.0, 0.0]))


@pytest.mark.parametrize(("lens", "half_m"), [(WIDE, 0.15), (TELE, 0.05)])
def test_a_place_that_matches_leave_open_is_refused(lens: Camera, half_m: float) -> None:
    """Matches in a patch of 14 or 27 px: where the camera is, and how it is turned, they tell together only."""
    point = ground(60, half_m=half_m)
    refusal = tie(pycolmap, *views(point, np.ones(60, dtype=bool), lens=lens), has_scale=False)
    assert isinstance(refusal, str)
    (percent,) = numbers(refusal)
    assert percent > 3


def test_a_wrong_tie_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A place at which the photographs share no point with the model, whoever found it, changes nothing."""
    job, _ = scene(tmp_path, (0.0, 1.7))
    (alone, *_), _ = map_database(pycolmap, job, SILENT, lens_held=True)
    assert alone.num_reg_images() == len(BEFORE)
    points = alone.num_points3D()
    wrong = Similarity(1.0, exp_so3(np.array([0.0, 0.0, 1.5])), np.array([30.0, 0.0, 0.0]))
    monkeypatch.setattr(joining, "tie", lambda *_, **__: Tie(wrong, 0.001, 60, 1, 30))
    whole, joins = join_by_matches(pycolmap, job, alone, SILENT)
    assert joins == ()
    assert (whole.num_reg_images(), whole.num_points3D()) == (len(BEFORE), points)


def test_verified_matches_of_several_places_leave_the_photograph_out(tmp_path: Path) -> None:
    """Each pair across the gap is verified by itself; together they fit no place, and the photograph is named."""
    job, _ = scene(tmp_path, (0.0,))
    (alone, *_), _ = map_database(pycolmap, job, SILENT, lens_held=True)
    _shift_across(job.database, len(BEFORE) + 1)
    whole, joins = join_by_matches(pycolmap, job, alone, SILENT)
    assert joins == () and whole.num_reg_images() == len(BEFORE)
    assert "05.jpg" in said(unregistered(pycolmap, job.database, whole), "photographs-not-registered")


def _shift_across(database: Path, image_id: int) -> None:
    """Exchange the verified matches of a photograph for those of other places of the same row."""
    with pycolmap.Database.open(database) as opened:
        seen: Any = np.asarray(opened.read_keypoints(image_id))[:, :2]
        order = np.argsort(seen[:, 1])
        for other in range(1, image_id):
            if not opened.exists_two_view_geometry(other, image_id):
                continue
            geometry = opened.read_two_view_geometry(other, image_id)
            rows = np.asarray(geometry.inlier_matches).copy()
            rank = np.empty(len(order), dtype=int)
            rank[order] = np.arange(len(order))
            moved = rank[rows[:, 1]] + np.resize([-40, -20, 20, 40], len(rows))
            rows[:, 1] = order[moved.clip(0, len(order) - 1)]
            geometry.inlier_matches = rows.astype(np.uint32)
            opened.delete_two_view_geometry(other, image_id)
            opened.write_two_view_geometry(other, image_id, geometry)
