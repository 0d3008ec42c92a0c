"""Known distances in the adjustment: the scale that they give, a wrong one named, and those kept as checks."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.core.products import Remark
from pipelines.survey.marks import mark_rays
from pipelines.survey.survey import KnownDistance, PointMarks, Survey, SurveyedPoint
from tests.drawn_surveys import Receiver, drawn, flight, missed, surveyed
from tests.refusals import numbers, said

pytestmark = pytest.mark.usefixtures("one_thread")
CONSUMER = Receiver((2.5, 2.5, 5.0), (2.0, 2.0, 4.0))
FLIGHT = flight(30, 300, check=16)
SIGMA_M, BARS = 0.004, 6  # the first twelve check points are the ends of bars, the others are measured below


def bar(ends: tuple[SurveyedPoint, ...], length_m: float, use: str = "control") -> KnownDistance:
    marked = tuple(PointMarks(name=end.name, marks=end.marks) for end in ends)
    return KnownDistance.model_validate({"ends": marked, "distance_m": length_m, "sigma_m": SIGMA_M, "use": use})


def survey_of(rng: np.random.Generator) -> Survey:
    """Consumer's fixes, and six distances across the block, measured to 4 mm."""
    survey = surveyed(FLIGHT, drawn(FLIGHT, rng), CONSUMER, None, rng)
    distances = []
    for index in range(BARS):
        ends = survey.check_points[2 * index : 2 * index + 2]
        true_m = np.linalg.norm(np.subtract(*(end.position_in_geo for end in ends)))
        distances.append(bar(ends, float(true_m + rng.normal(0, SIGMA_M))))
    return survey.model_copy(update={"distances": tuple(distances)})


def solved(survey: Survey) -> tuple[Posterior, tuple[Remark, ...]]:
    points = geolocate(survey, FLIGHT.model, GeolocateOptions()).points
    return estimate_similarity(survey, FLIGHT.model, points, InitSim3Options())


def lengths(posterior: Posterior, survey: Survey) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the distances between the last four check points, and their predicted σ."""
    held_out = survey.check_points[2 * BARS :]
    pairs = [bar(pair, 1.0) for pair in combinations(held_out, 2)]
    ends = [end for pair in combinations(held_out, 2) for end in pair]
    true = np.array([end.position_in_geo for end in ends])
    found = (
        true
        + missed(posterior, survey.model_copy(update={"check_points": tuple(held_out)}))[0][
            [held_out.index(end) for end in ends]
        ]
    )
    rays = mark_rays([end for pair in pairs for end in pair.ends], posterior.sparse)
    length_m = [np.linalg.norm(place[::2] - place[1::2], axis=1) for place in (found, true)]
    return length_m[0] - length_m[1], np.sqrt(posterior.of_distances(found, rays))


@pytest.mark.slow
def test_distances_set_the_scale_with_the_sigma_that_is_predicted() -> None:
    """Fixes of 2.5 m leave the scale to half a percent, six distances across the block to 0.1 thousandths."""
    normalised, with_bars, without = [], [], []
    for seed in range(6):
        survey = survey_of(np.random.default_rng(seed))
        posterior, _ = solved(survey)
        error, sigma = lengths(posterior, survey)
        normalised.append((error / sigma) ** 2)
        with_bars.append(posterior.of_similarity[0, 0] ** 0.5)
        states = [row for row in posterior.solution.measurements if row.kind == "distance"]
        assert [row.used for row in states] == [True] * BARS and len(states[0].residual) == 1
        if not seed:
            alone = survey.model_copy(update={"distances": ()})
            without.append(solved(alone)[0].of_similarity[0, 0] ** 0.5)
            checks = tuple(one.model_copy(update={"use": "check"}) for one in survey.distances)
            unused, _ = solved(survey.model_copy(update={"distances": checks}))
            assert unused.of_similarity[0, 0] ** 0.5 == pytest.approx(without[0], rel=1e-9)
    # Six draws of six pairs that share their points: the mean of the squares has a σ of about 0.3.
    assert 0.4 < np.mean(normalised) < 1.9
    assert np.mean(with_bars) < 0.1 * without[0]


def test_a_wrong_distance_is_named_and_not_used() -> None:
    survey = survey_of(np.random.default_rng(1))
    wrong = survey.distances[2]
    wrong = wrong.model_copy(update={"distance_m": wrong.distance_m + 0.5})
    distances = (*survey.distances[:2], wrong, *survey.distances[3:])
    kept, warnings = solved(survey.model_copy(update={"distances": distances}))
    assert kept.solution.distance_outliers == (wrong.name,)
    told = said(warnings, "distance-outliers")
    assert wrong.name in told and numbers(told)[-1] == pytest.approx(0.5, abs=0.06)
    (row,) = (one for one in kept.solution.measurements if one.name == wrong.name)
    assert not row.used
    error, sigma = lengths(kept, survey)
    assert np.abs(error / sigma).max() < 4
