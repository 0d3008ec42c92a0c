"""The standard's arithmetic, against figures worked out by hand and against drawn errors of known σ."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.evaluate.asprs import assess, classes_cm, error_stats, few_points, tolerance_test
from tests.refusals import numbers

EXACT = np.zeros((3, 3))


def test_figures_by_hand() -> None:
    stats = error_stats([[0.03, 0.04, -0.01], [0.0, 0.0, 0.02], [-0.06, 0.08, 0.02]])
    assert stats.count == 3
    assert (stats.mean_e_m, stats.mean_n_m, stats.mean_u_m) == pytest.approx((-0.01, 0.04, 0.01))
    assert stats.mean_h_m == pytest.approx(0.05)  # of 5, 0 and 10 cm
    assert stats.median_h_m == pytest.approx(0.05)
    assert stats.rmse_h_m == pytest.approx(np.sqrt(0.0125 / 3))
    assert stats.rmse_v_m == pytest.approx(np.sqrt(0.0009 / 3))
    assert stats.rmse_3d_m == pytest.approx(np.sqrt(0.0134 / 3))
    assert (stats.max_h_m, stats.max_v_m, stats.max_3d_m) == pytest.approx((0.1, 0.02, np.sqrt(0.0104)))


def test_survey_is_added_in_quadrature() -> None:
    # Every error 3 cm east and 5 cm up; surveyed to √(4² + 0²) cm in the plane and 12 cm in height.
    assessment = assess(np.tile([0.03, 0.0, -0.05], (30, 1)), np.tile(np.diag([0.04, 0.0, 0.12]) ** 2, (30, 1, 1)))
    assert assessment.survey is not None
    assert assessment.with_survey is not None
    assert (assessment.survey.rmse_h_m, assessment.survey.rmse_v_m) == pytest.approx((0.04, 0.12))
    assert (assessment.with_survey.rmse_h_m, assessment.with_survey.rmse_v_m) == pytest.approx((0.05, 0.13))
    assert assessment.with_survey.rmse_3d_m == pytest.approx(np.hypot(0.05, 0.13))
    assert classes_cm(assessment.with_survey.rmse_h_m, assessment.with_survey.rmse_v_m) == [5, 13]
    assert assessment.stats.rmse_h_m == pytest.approx(0.03)  # the raw one stays beside it
    asprs = assessment.asprs
    assert (asprs.horizontal_class, asprs.vertical_class, asprs.class_3d) == ("5 cm", "13 cm", "14 cm")  # 3-D: 13.9
    assert asprs.statement is not None
    assert "RMSE_3D 13.9 cm" in asprs.statement
    assert assessment.asprs.enough_points is True
    assert assessment.without_blunders is None


@pytest.mark.parametrize(("error_m", "class_cm"), [(0.0101, 2), (0.01, 1), (0.0499, 5), (1.234, 124), (1e-4, 1)])
def test_class_is_the_smallest_that_is_met(error_m: float, class_cm: int) -> None:
    assessment = assess(np.tile([error_m, 0, error_m], (30, 1)), np.tile(EXACT, (30, 1, 1)))
    assert assessment.with_survey is not None
    assert classes_cm(assessment.with_survey.rmse_h_m, assessment.with_survey.rmse_v_m) == [class_cm, class_cm]


def test_too_few_points_are_told_plainly() -> None:
    few = assess(np.full((12, 3), 0.01), np.tile(EXACT, (12, 1, 1)))
    assert few.asprs.statement is not None
    assert few.asprs.statement.startswith(few_points(few.asprs))
    assert numbers(few_points(few.asprs))[:2] == [12, 30]
    assert few.asprs.enough_points is False
    many = assess(np.full((30, 3), 0.01), np.tile(EXACT, (30, 1, 1)))
    assert many.asprs.statement is not None
    assert many.asprs.enough_points is True
    assert few_points(many.asprs) not in many.asprs.statement


@pytest.mark.parametrize(
    ("area_km2", "points"), [(None, 30), (0.2, 30), (1000, 30), (1000.1, 40), (2500, 50), (9999, 120), (5e4, 120)]
)
def test_large_project_needs_more_points(area_km2: float | None, points: int) -> None:
    asprs = assess(np.full((40, 3), 0.01), np.tile(EXACT, (40, 1, 1)), area_km2=area_km2).asprs
    assert (asprs.least_points, asprs.enough_points) == (points, points <= 40)


def test_vegetation_enters_neither_class_nor_accuracy() -> None:
    # Two σ of height: 3 cm in the open, 20 cm under vegetation, where grass hides the ground.
    rng = np.random.default_rng(2)
    error, vegetated = rng.normal(0, 0.03, (400, 3)), np.arange(400) % 4 == 0
    error[vegetated, 2] = rng.normal(0, 0.2, 100)
    assessment = assess(error, np.tile(EXACT, (400, 1, 1)), vegetated)
    asprs, total = assessment.asprs, assessment.with_survey
    assert total is not None
    assert asprs.vegetated is not None
    # The bounds are 3 σ of the RMSE of 300 and of 100 draws: σ / √(2 N).
    assert total.rmse_v_m == pytest.approx(0.03, abs=3 * 0.03 / np.sqrt(600))
    assert asprs.vegetated.rmse_v_m == pytest.approx(0.2, abs=3 * 0.2 / np.sqrt(200))
    assert (asprs.points, asprs.vegetated.count, asprs.vertical_class) == (300, 100, "3 cm")
    assert not assessment.blunder[vegetated].any()
    assert asprs.statement is not None
    assert f"{100 * asprs.vegetated.rmse_v_m:.1f} cm at 100 points under vegetation (VVA)" in asprs.statement
    alone = assess(error, np.tile(EXACT, (400, 1, 1)), np.ones(400, dtype=bool))
    assert alone.with_survey is None
    assert alone.asprs.vertical_class is None


@pytest.mark.parametrize("count", [5, 9, 40])
@pytest.mark.parametrize("axis", [0, 2])
def test_blunder_cannot_hide_among_few(count: int, axis: int) -> None:
    error = np.random.default_rng(0).normal(0, 0.02, (count, 3))
    error[1, axis] = 0.6
    assessment = assess(error, np.tile(EXACT, (count, 1, 1)))
    assert np.flatnonzero(assessment.blunder).tolist() == [1]
    assert assessment.stats.count == count  # it stays in the statistics
    assert assessment.without_blunders == error_stats(np.delete(error, 1, axis=0))
    assert assessment.without_blunders is not None
    assert assessment.without_blunders.count == count - 1


def test_honest_errors_are_not_blunders() -> None:
    # 3 × RMSE_H is 4.2 σ of a Rayleigh distribution (1e-4), 3 × RMSE_V is 3 σ (0.3 %); the class is rounded up.
    flagged = [
        assess(np.random.default_rng(seed).normal(0, 0.02, (40, 3)), np.tile(EXACT, (40, 1, 1))).blunder.sum()
        for seed in range(50)
    ]
    assert np.mean(flagged) < 0.25


def test_survey_that_is_poor_makes_no_blunders() -> None:
    rng = np.random.default_rng(1)
    error, cov = rng.normal(0, 0.005, (20, 3)), np.tile(np.eye(3) * 0.03**2, (20, 1, 1))
    error[4] = [0.08, 0.0, 0.0]  # less than 3 σ of its survey
    assert not assess(error, cov).blunder.any()


def test_half_in_plan_and_half_in_height_leave_no_others() -> None:
    error = np.zeros((4, 3))
    error[:2, 0] = error[2:, 2] = 1.0
    assessment = assess(error, np.tile(EXACT, (4, 1, 1)))
    assert assessment.stats.count == 4
    assert assessment.stats.rmse_h_m == pytest.approx(np.sqrt(0.5))


def test_nothing_measured_is_nothing_stated() -> None:
    assessment = assess(np.empty((0, 3)), np.empty((0, 3, 3)))
    assert assessment.stats.count == 0
    assert assessment.stats.rmse_h_m is None
    assert assessment.with_survey is None
    assert assessment.asprs.statement is None


@pytest.mark.parametrize(
    ("rmse_m", "points", "area_km2", "verdict"),
    [
        (0.049, 30, None, "pass"),
        (0.050, 30, 2.0, "pass"),
        (0.0501, 30, None, "fail"),
        (0.049, 29, None, "met"),
        (0.049, 30, 1500.0, "met"),  # so large a project needs 40
        (0.2, 3, None, "fail"),
        (None, 0, None, "untested"),
    ],
)
def test_a_required_accuracy_needs_the_rmse_and_the_number(
    rmse_m: float | None, points: int, area_km2: float | None, verdict: str
) -> None:
    assert tolerance_test("vertical", 0.05, rmse_m, points, area_km2).verdict == verdict
