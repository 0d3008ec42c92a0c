"""Variance factors in the covariances of a survey, and where the same assumption was made twice."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.survey.measurement_errors import VarianceFactor, factor_of_check_points, with_variance_factors
from pipelines.survey.survey import Survey
from tests.scenes import Measured, Noise, make_scene, survey_of


def _factor(applied: float, source: str, group: str = "control points") -> VarianceFactor:
    return VarianceFactor.model_validate(
        {
            "group": group,
            "count": 5,
            "used": 5,
            "redundancy": 8.0,
            "estimated": applied,
            "probability": 1.0,
            "applied": applied,
            "sigma_source": source,
        }
    )


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ((_factor(9000.0, "default"),), 9000.0),
        ((_factor(9000.0, "stated"),), 1.0),  # the control's σ was stated: it says nothing of other points
        ((_factor(0.1, "default"),), 1.0),  # the solution fits what it knows
        ((_factor(9.0, "default", "fixes"),), 1.0),
        ((), 1.0),
    ],
)
def test_the_factor_of_an_assumption_is_that_of_check_points(
    factors: tuple[VarianceFactor, ...], expected: float
) -> None:
    assert factor_of_check_points(factors) == expected


def _survey() -> Survey:
    survey = survey_of(make_scene(points=20), Noise(), Measured(gcps=True), np.random.default_rng(0))
    first, second, *control = survey.control_points
    of_its_own = second.model_copy(update={"cov_in_geo": tuple(map(tuple, (0.01**2 * np.eye(3)).tolist()))})
    return survey.model_copy(update={"control_points": tuple(control), "check_points": (first, of_its_own)})


def test_it_applies_to_check_points_of_the_same_sigma_alone() -> None:
    survey = _survey()
    before = [np.array(point.cov_in_geo) for point in survey.check_points]
    weighted = with_variance_factors(survey, {"control points": 9.0}, of_assumed_checks=9.0)
    after = [np.array(point.cov_in_geo) for point in weighted.check_points]
    np.testing.assert_allclose(after[0], 9.0 * before[0])
    np.testing.assert_array_equal(after[1], before[1])
    same = with_variance_factors(survey, {"control points": 9.0})
    assert [point.cov_in_geo for point in same.check_points] == [point.cov_in_geo for point in survey.check_points]
