"""Marks in photographs: where points appear, what marks give, and the files that `--gcp` reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.ground_points import read_ground_points
from pipelines.survey.marks import triangulated_points
from pipelines.survey.survey import SurveyedPoint
from pipelines.view.marking import (
    CHECK,
    CONTROL,
    MarkedPoint,
    appears_in,
    mark_texts,
    points_to_mark,
    rays_of,
    residuals_px,
)
from pipelines.view.measuring import MeasuringModel
from tests.refusals import refused

PLACE = np.array([3.0, -2.0, 5.8])


def test_a_point_appears_where_its_marks_intersect_again(model: MeasuringModel) -> None:
    solution, sparse = model.solution, model.reader.renderer.sparse
    shown = appears_in(PLACE, solution, sparse)
    assert len(shown) == len(sparse.image_name)  # all cameras look at the hill
    marks = {sparse.image_name[camera]: (float(x), float(y)) for camera, (x, y) in shown}
    rays = rays_of(MarkedPoint("P", None, marks=marks), sparse)
    found = triangulated_points(solution, rays)[0]
    np.testing.assert_allclose(found, PLACE, atol=1e-6)
    assert residuals_px(PLACE, rays, solution).max() < 1e-4
    # A mark that is 5 px off shows it, and the others hardly move.
    image, (x, y) = next(iter(marks.items()))
    wrong = rays_of(MarkedPoint("P", None, marks={**marks, image: (x + 5.0, y)}), sparse)
    residual = residuals_px(triangulated_points(solution, wrong)[0], wrong, solution)
    names = [sparse.image_name[camera] for camera in wrong.camera]
    assert residual[names.index(image)] == pytest.approx(5.0, abs=1.5)
    assert np.median(residual) < 1.0


def test_points_behind_all_cameras_appear_nowhere(model: MeasuringModel) -> None:
    assert appears_in(np.array([0.0, 0.0, 500.0]), model.solution, model.reader.renderer.sparse) == []


def test_files_of_marks_are_read_again(tmp_path: Path, model: MeasuringModel) -> None:
    survey = model.survey

    def xyz_of(points: tuple[SurveyedPoint, ...]) -> np.ndarray:
        position = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        return model.target.xyz_from_geo(position) if len(position) else position

    points = points_to_mark(survey, xyz_of)
    new = MarkedPoint("new", (404000.123, 5097000.25, 1650.5), marks={"a.jpg": (12.25, 700.5), "b.jpg": (1.0, 2.0)})
    bare = MarkedPoint("bare", (1.0, 2.0, 3.0))
    texts = mark_texts("EPSG:32632", [*points, new, bare])
    assert list(texts) == [CONTROL, CHECK]
    for name, text in texts.items():
        (tmp_path / name).write_text(text, "utf-8")
    control = read_ground_points(tmp_path / CONTROL)
    assert control.crs_text == "EPSG:32632"
    assert [(point.name, tuple(point.xyz)) for point in control.points] == [("new", new.xyz)]
    assert [(m.name, m.x_px, m.y_px, m.image) for m in control.marks] == [
        ("new", x, y, image) for image, (x, y) in new.marks.items()
    ]
    check = read_ground_points(tmp_path / CHECK)
    assert {mark.name for mark in check.marks} == {point.name for point in survey.check_points}
    for mark in check.marks:
        point = next(point for point in points if point.name == mark.name)
        assert (mark.x_px, mark.y_px) == pytest.approx(point.marks[mark.image], abs=5e-4)
    for listed in check.points:
        point = next(point for point in points if point.name == listed.name)
        np.testing.assert_allclose(listed.xyz, point.xyz, atol=1e-4)


def test_names_that_the_format_cannot_hold_are_refused() -> None:
    point = MarkedPoint("two words", (1.0, 2.0, 3.0), marks={"a.jpg": (1.0, 1.0)})
    with refused("name-with-space", InputError) as error:
        mark_texts("EPSG:4326", [point])
    assert "'two words'" in str(error.value)


def test_a_mark_is_replaced_and_taken_away() -> None:
    point = MarkedPoint("P", None, marks={"a": (1.0, 2.0)})
    assert point.with_mark("a", (3.0, 4.0)).marks == {"a": (3.0, 4.0)}
    assert point.with_mark("a", None) == replace(point, marks={})
