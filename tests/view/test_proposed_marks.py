"""Quartered targets against the truth of drawn pictures, and marks that the cameras propose."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.workspace import Workspace
from pipelines.formats.ground_points import read_marks
from pipelines.geometry.cameras import project
from pipelines.survey.survey import Mark, Survey, SurveyedPoint
from pipelines.view.measuring import MeasuringModel
from pipelines.view.options import ProposalOptions
from pipelines.view.proposed_marks import propose_marks, proposed_marks
from pipelines.view.quarters import find_quarters
from tests.refusals import refused

_SAMPLES = 6  # per pixel along each axis


def _draw(picture: np.ndarray, center: np.ndarray, matrix: np.ndarray) -> None:
    """Draw a target into grey values (H, W) in place; `matrix` (2, 2) leads from the square ±1 to pixels."""
    reach = int(np.abs(matrix).sum(axis=1).max()) + 2
    first = np.maximum(np.floor(center).astype(int) - reach, 0)
    last = np.minimum(np.floor(center).astype(int) + reach, picture.shape[::-1])
    if (last <= first).any():
        return
    width, height = last - first
    x = first[0] + (np.arange(width * _SAMPLES) + 0.5) / _SAMPLES
    y = first[1] + (np.arange(height * _SAMPLES) + 0.5) / _SAMPLES
    on = np.stack([*np.meshgrid(x - center[0], y - center[1])], axis=-1) @ np.linalg.inv(matrix).T
    inside = (np.abs(on) < 1).all(axis=-1)
    white = (on[..., 0] > 0) == (on[..., 1] > 0)
    blocks = height, _SAMPLES, width, _SAMPLES
    share = inside.reshape(blocks).mean(axis=(1, 3))
    target = np.where(inside, np.where(white, 200, 30), 0).reshape(blocks).mean(axis=(1, 3))
    part = picture[first[1] : last[1], first[0] : last[0]]
    part *= 1 - share
    part += target


def _ground(random: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    texture = cv2.GaussianBlur(random.normal(0, 1, size), (0, 0), 2.5)
    return np.asarray(110 + 18 * texture / texture.std())


def _photographed(picture: np.ndarray, random: np.random.Generator, noise: float) -> np.ndarray:
    blurred = cv2.GaussianBlur(picture, (0, 0), 0.6) + random.normal(0, noise, picture.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def _turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_middles_of_quartered_targets_are_as_good_as_their_sigma_says() -> None:
    random, error, sigma = np.random.default_rng(0), [], []
    for number in range(80):
        picture, width = _ground(random, (100, 100)), (9, 14, 24, 40)[number % 4]
        center = 50 + random.uniform(-8, 8, 2)
        oblique = np.diag([1.0, random.uniform(0.7, 1.0)])
        _draw(picture, center, _turn(random.uniform(0, 6)) @ oblique @ _turn(random.uniform(0, 6)) * width / 2)
        found = find_quarters(_photographed(picture, random, 3.0), np.array([50.0, 50.0]), 14.0)
        if found is not None:
            error.append(found.center_px - center)
            sigma.append(found.sigma_px)
    assert len(error) >= 76
    assert np.abs(error).max() < 0.5  # none wrong
    assert np.sqrt(np.mean(np.square(error))) < 0.12
    assert 0.7 < np.sqrt(np.mean(np.square(np.array(error) / np.array(sigma)[:, None]))) < 1.4


def test_texture_and_two_targets_are_no_target() -> None:
    random, false = np.random.default_rng(1), 0
    for _ in range(30):
        grey = _photographed(_ground(random, (100, 100)), random, 3.0)
        false += find_quarters(grey, np.array([50.0, 50.0]), 14.0) is not None
    assert false == 0
    two = _ground(random, (100, 100))
    for x in (42.0, 58.0):
        _draw(two, np.array([x, 50.0]), np.eye(2) * 6)
    assert find_quarters(_photographed(two, random, 2.0), np.array([50.0, 50.0]), 14.0) is None
    for beyond in ((-40.0, 50.0), (50.0, 1e4), (3.0, 3.0)):
        assert find_quarters(two.astype(np.uint8), np.array(beyond), 14.0) is None


def _with_points(survey: Survey, places: np.ndarray, marks: tuple[Mark, ...]) -> Survey:
    """Return the survey with points at places (J, 3) alone, the last of which has marks."""
    points = tuple(
        SurveyedPoint(
            name=f"P{j}", position_in_geo=tuple(place.tolist()),
            cov_in_geo=((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)),
            marks=marks if j == len(places) - 1 else (),
        )
        for j, place in enumerate(places)
    )  # fmt: skip
    return survey.model_copy(update={"control_points": points, "check_points": (), "unmarked_points": ()})


def test_targets_are_proposed_where_the_cameras_expect_them(model: MeasuringModel) -> None:
    solution, sparse, random = model.solution, model.reader.renderer.sparse, np.random.default_rng(2)
    poses = solution.poses
    places = np.array([[3.0, -2.0, 5.8], [-6.0, 5.0, 5.0], [9.0, 8.0, 4.0]])
    half_m = 3.0
    pictures, true = [], {}
    for camera, name in enumerate(sparse.image_name):
        lens = sparse.camera_of(camera)
        picture = _ground(random, (lens.height, lens.width))
        for j, place in enumerate(places):
            corners = place + half_m * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
            in_model = solution.similarity.inverse().apply(corners)
            in_cam = (in_model - poses.cam_center_in_model[camera]) @ poses.cam_from_model[camera].T
            pixel = project(lens, in_cam)
            _draw(picture, pixel[0], (pixel[1:] - pixel[0]).T)
            true[f"P{j}", name] = pixel[0]
        grey = _photographed(picture, random, 2.0)
        pictures.append(np.repeat(grey[..., None], 3, axis=2))
    hand = tuple(
        Mark(image=name, x_px=true["P2", name][0], y_px=true["P2", name][1], sigma_px=0.5)
        for name in sparse.image_name[:2]
    )
    # Surveyed and adjusted places differ by decimetres: targets are pixels from where they are expected.
    survey = _with_points(model.survey, places + np.array([0.3, -0.2, 0.1]), hand)
    found, left_out = proposed_marks(survey, solution, sparse, lambda camera: pictures[camera], 10.0)
    assert len(left_out) <= 1
    assert not {("P2", mark.image) for mark in hand} & {(each.point, each.mark.image) for each in found}
    quarters = [each for each in found if each.how == "quarters"]
    assert len(quarters) >= 0.9 * (len(true) - 2)
    off = [np.array([each.mark.x_px, each.mark.y_px]) - true[each.point, each.mark.image] for each in quarters]
    assert np.abs(off).max() < 0.5 and np.sqrt(np.mean(np.square(off))) < 0.15


def test_the_table_is_read_as_marks_with_sigma(viewed: Workspace, tmp_path: Path) -> None:
    summary = propose_marks(viewed, ProposalOptions())
    text = summary.file.read_text(encoding="utf-8")
    assert text.splitlines()[0] == "image,label,x,y,sigma,how,score"
    table = tmp_path / "marks.csv"
    table.write_text("image,label,x,y,sigma,how,score\na.jpg,P,1.5,2.5,0.06,quarters,0.9\nb.jpg,P,1,2,,,\n")
    assert [(mark.x_px, mark.sigma_px) for mark in read_marks(table)] == [(1.5, 0.06), (1.0, None)]


def test_a_survey_without_points_is_refused(model: MeasuringModel) -> None:
    with refused("no-ground-points", InputError):
        none = _with_points(model.survey, np.empty((0, 3)), ())
        sparse = model.reader.renderer.sparse
        proposed_marks(none, model.solution, sparse, lambda _: pytest.fail("read"), 24.0)
