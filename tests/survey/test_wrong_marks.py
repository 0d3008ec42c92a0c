"""A wrong mark costs a mark: one in ten, wrong by 5 to 200 px, is named, and the result is as good as without."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import mark_rays, wrong_marks
from pipelines.survey.survey import Survey, SurveyedPoint
from tests.refusals import codes, said
from tests.scenes import CAMERA, WITH_GCPS, Noise, make_scene, sparse_model, survey_of

NOISE = Noise()
SHARE = 0.1


def flown(layout: str, seed: int = 0) -> tuple[Survey, SparseModel]:
    scene, rng = make_scene(layout, gcps=10), np.random.default_rng(seed)
    return survey_of(scene, NOISE, WITH_GCPS, rng), sparse_model(scene, NOISE, rng)


def spoiled(points: tuple[SurveyedPoint, ...], seed: int) -> tuple[tuple[SurveyedPoint, ...], set[tuple[str, str]]]:
    """Return points with one mark in ten moved by 5 to 200 px, evenly in their logarithm, and which these are."""
    rng, wrong, changed = np.random.default_rng(seed), set(), []
    for point in points:
        marks = list(point.marks)
        for place in rng.choice(len(marks), max(1, round(SHARE * len(marks))), replace=False):
            angle, off = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(5), np.log(200)))
            x, y = marks[place].x_px + off * np.cos(angle), marks[place].y_px + off * np.sin(angle)
            # Within the photograph, or a reader would refuse it.
            moved = {
                "x_px": float(np.clip(x, 1, CAMERA.width - 1)),
                "y_px": float(np.clip(y, 1, CAMERA.height - 1)),
            }
            if np.hypot(moved["x_px"] - marks[place].x_px, moved["y_px"] - marks[place].y_px) < 5:
                continue
            marks[place] = marks[place].model_copy(update=moved)
            wrong.add((point.name, marks[place].image))
        changed.append(point.model_copy(update={"marks": tuple(marks)}))
    return tuple(changed), wrong


@pytest.mark.parametrize("layout", ["orbit", "grid"])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_marks_are_found_and_no_others(layout: str, seed: int) -> None:
    survey, model = flown(layout, seed)
    assert wrong_marks(survey.control_points, model) == ()
    points, wrong = spoiled(survey.control_points, seed)
    found = wrong_marks(points, model)
    assert {(mark.point, mark.image) for mark in found} == wrong
    assert min(mark.off_px for mark in found) > 4
    assert len(mark_rays(points, model).point) == len(mark_rays(points, model, wrong=True).point) - len(wrong)


def test_the_result_is_as_good_as_without_them() -> None:
    """Within 10 % of the error: no control point is lost, and each wrong mark is named with its photograph."""
    survey, model = flown("orbit")
    points, wrong = spoiled(survey.control_points, 5)
    located = geolocate(survey, model, GeolocateOptions()).points
    clean, no_warnings = estimate_similarity(survey, model, located, InitSim3Options())
    spoilt, warnings = estimate_similarity(
        survey.model_copy(update={"control_points": points}), model, located, InitSim3Options()
    )
    assert spoilt.solution.control_outliers == clean.solution.control_outliers == ()
    assert spoilt.solution.cautions == clean.solution.cautions
    assert codes(no_warnings) == []
    sentence = said(warnings, "wrong-marks")
    assert all(f"{image} of point {point} (" in sentence for point, image in wrong)
    error = [one.solution.initial.residuals["gcp"].rmse_3d_m for one in (spoilt, clean)]
    assert error[0] == pytest.approx(error[1], rel=0.1)


def test_three_marks_and_marks_that_are_all_wrong_are_left_to_the_adjustment() -> None:
    survey, model = flown("orbit")
    few = survey.control_points[0].model_copy(update={"marks": survey.control_points[0].marks[:3]})
    assert wrong_marks(spoiled((few,), 0)[0], model) == ()
    flipped = tuple(
        mark.model_copy(update={"x_px": CAMERA.width - mark.x_px}) for mark in survey.control_points[0].marks
    )
    turned = survey.control_points[0].model_copy(update={"marks": flipped})
    assert wrong_marks((turned,), model) == ()
