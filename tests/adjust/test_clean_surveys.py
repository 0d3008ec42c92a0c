"""Clean surveys: everything drawn with the σ that it states. The statement must be true, and blame nobody."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tests.adjusted_scenes import adjusted_model, block
from tests.scenes import WITH_GCPS, Layout, Noise, session_of, survey_of
from tests.statements import state

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
CONTROL = 8  # ground points of a block before its check points
RTK, PPK, CONSUMER = (0.02, 0.02, 0.03), (0.05, 0.05, 0.08), (1.5, 1.5, 3.0)
# They name what nothing checks, and blame no source.
BLAMELESS = {"no-control-points", "hardly-checked", "default-sigma"}


@dataclass(frozen=True)
class Case:
    """Flight, number of photographs, σ of the fixes in metres, number of control points."""

    layout: Layout
    images: int
    fix_m: tuple[float, float, float]
    control: int


CASES = [
    Case(layout, images, fix_m, control)
    for layout, images, receivers in (
        ("orbit", 10, (RTK, CONSUMER)),
        ("orbit", 12, (RTK, PPK)),
        ("grid", 12, (RTK, CONSUMER)),
    )
    for fix_m in receivers
    for control in (0, 3, 8)
] + [Case("orbit", 12, CONSUMER, 0), Case("grid", 12, PPK, 4)]


def test_statements_of_clean_surveys_are_true_and_blame_nobody() -> None:
    pooled, blamed = [], {}
    for seed, case in enumerate(CASES):
        of, rng = block(case.layout, case.images), np.random.default_rng(seed)
        common = np.array(session_of(case.fix_m[0]).sigma_common_m) * (case.control > 0)
        noise = Noise(fix_m=case.fix_m, pixel_px=0.2, bias_m=tuple(common * rng.normal(size=3)))
        model, survey = adjusted_model(of, noise, rng), survey_of(of.scene, noise, WITH_GCPS, rng)
        points = survey.control_points
        survey = survey.model_copy(
            update={
                "control_points": points[: case.control],
                "check_points": points[CONTROL:],
                "sessions": survey.sessions if case.control else (),
            }
        )
        statement = state(survey, model)
        pooled.append(statement.normalised_errors(of.scene.gcp_in_geo[CONTROL:]).mean())
        if statement.codes - BLAMELESS:
            blamed[case] = statement.cautions
    assert not blamed
    # Check points of a survey share most of their error: some three degrees of freedom each, σ of the mean of 20 is
    # √(2/60) = 0.18. The range is that of the promise.
    assert len(pooled) >= 20
    assert 0.7 < np.mean(pooled) < 1.4
