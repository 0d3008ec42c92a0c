"""Photographs that a strip of matches ties to the model: a lens looks down from 10 m, along a line with a gap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import umeyama
from pipelines.sfm import rounds
from pipelines.sfm.features import SfmJob
from pipelines.sfm.joining import join_by_matches
from pipelines.sfm.mapping import map_database
from tests.refusals import logged_codes
from tests.sfm_truth import Views, matched_views, survey_of_views

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

HEIGHT_M = 10.0
WIDE = Camera("SIMPLE_RADIAL", 1024, 768, np.array([900.0, 512.0, 384.0, -0.05]))
FISHEYE = Camera("OPENCV_FISHEYE", 1024, 768, np.array([900.0, 900.0, 512.0, 384.0, 0.01, -0.02, 0.0, 0.0]))
REACH_M = HEIGHT_M * 384 / 900  # that a photograph sees before and behind: 4.27 m
BEFORE = (0.0, 1.7, 3.4, 5.1, 6.8)  # places along the line, of the first group
SEAM = BEFORE[-1] + 6.3  # of the second: the strip that both see is 2.2 m wide
_TIES = 12  # points of the strip that further photographs of each group show: the mapper asks for 30


def scene(
    folder: Path, beyond: tuple[float, ...], lens: Camera = WIDE, ties: int = _TIES
) -> tuple[SfmJob, FloatArray]:
    """Photographs of both groups, with noise of 0.3 px, and their centres."""
    rng = np.random.default_rng(4)
    along = [*BEFORE, *(SEAM + place for place in beyond)]
    count = round(110 * (along[-1] + 2 * REACH_M))
    point = rng.uniform((-5.5, -REACH_M, -0.7), (5.5, along[-1] + REACH_M, 0.7), (count, 3))
    center = np.stack([rng.normal(0, 0.1, len(along)), along, HEIGHT_M + rng.normal(0, 0.1, len(along))], axis=1)
    rotation = np.array([exp_so3(rng.normal(0, 0.01, 3)) @ np.diag([1.0, -1.0, -1.0]) for _ in along])
    views = Views([f"{number:02d}.jpg" for number in range(len(along))], [1] * len(along), rotation, center)
    survey = survey_of_views(views, {1: lens})
    # Of the points that a further photograph of each group shows in the strip, so many are left.
    shown = np.ones((len(along), len(point)))
    before = np.flatnonzero(abs(point[:, 1] - (SEAM - REACH_M + BEFORE[-2] + REACH_M) / 2) < 0.8)
    after = np.flatnonzero(abs(point[:, 1] - (SEAM + 1.7 - REACH_M + BEFORE[-1] + REACH_M) / 2) < 0.8)
    shown[: len(BEFORE) - 1, before] = 0
    shown[: len(BEFORE) - 1, before[abs(point[before, 1] - SEAM + REACH_M - 0.25).argsort()[:ties]]] = 1
    shown[len(BEFORE) + 1 :, after] = 0
    shown[len(BEFORE) + 1 :, after[abs(point[after, 1] - BEFORE[-1] - REACH_M + 0.25).argsort()[:ties]]] = 1
    return matched_views(folder, survey, views, {1: lens}, point, noise_px=0.3, shown=shown), center


def error_beyond(model: Any, center: FloatArray) -> FloatArray:
    """Errors (N,) in metres of the second group's centres beside the first's: along the line, and in length."""
    known = sorted(model.reg_image_ids())
    solved = np.array([model.images[key].projection_center() for key in known])
    true = center[np.array(known) - 1]
    first = np.array(known) <= len(BEFORE)
    place = umeyama(solved[first], true[first])
    return np.asarray(np.linalg.norm((place.apply(solved) - true)[~first], axis=1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("beyond", "lens"),
    [((0.0, 1.7, 3.4), WIDE), ((0.0, 1.7), FISHEYE), ((0.0,), WIDE)],
)
def test_a_strip_of_matches_joins_what_lies_beyond(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, beyond: tuple[float, ...], lens: Camera
) -> None:
    """A model of three photographs, a pair, or one photograph."""
    job, center = scene(tmp_path, beyond, lens)
    alone, _ = map_database(pycolmap, job, SILENT, lens_held=True)
    assert alone[0].num_reg_images() == len(BEFORE)  # the mapper leaves the others out
    whole, joins = join_by_matches(pycolmap, job, alone[0], SILENT)
    print(joins, error_beyond(whole, center))
    assert whole.num_reg_images() == len(center)
    assert alone[0].num_reg_images() == len(BEFORE)
    sigma_m = HEIGHT_M * max(join.tie.sigma for join in joins)
    assert sigma_m < 0.1
    assert error_beyond(whole, center).max() < 4 * sigma_m
    aligned = rounds.map_in_rounds(pycolmap, job, SILENT)
    assert aligned.registered == len(center)
    assert logged_codes(caplog) == ["joined-by-matches"]


@pytest.mark.slow
def test_what_a_joined_photograph_does_not_show_stays_as_it_is(tmp_path: Path) -> None:
    """A part that positions have placed fits the lens of the others only when all is adjusted."""
    job, _ = scene(tmp_path, (0.0,))
    model = map_database(pycolmap, job, SILENT, lens_held=True)[0][0]
    last = len(BEFORE)  # shows the strip, alone
    aside = [
        key for key, each in model.points3D.items() if last not in {part.image_id for part in each.track.elements}
    ]
    assert len(aside) > 50
    for key in aside:
        model.points3D[key].xyz = model.points3D[key].xyz + 0.05 * model.points3D[key].xyz[2] * np.array([1, 0, 0])
    model.update_point_3d_errors()
    assert min(model.points3D[key].error for key in aside) > 4  # what the mapper leaves out
    whole, joins = join_by_matches(pycolmap, job, model, SILENT)
    assert [join.images for join in joins] == [(last + 1,)]
    assert set(aside) <= set(whole.points3D)
