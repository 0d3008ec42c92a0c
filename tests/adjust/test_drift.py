"""Fixes that drift, in flights without attitudes: is the survey level, and are the σ of its tilt true?"""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.adjust import solution
from pipelines.adjust.drift import drift_shapes
from pipelines.adjust.level import level_by_views
from pipelines.adjust.measurements import problem_of
from pipelines.geometry.rotations import exp_so3
from pipelines.survey.scene import initial_scene
from tests.drifting_flights import Drift, flight, solved, survey_with
from tests.scenes import Noise, initial_product, sparse_model

pytestmark = pytest.mark.usefixtures("one_thread")
CLIMB = Drift(climb_m=100.0)
WALK = Drift(climb_m=60.0, walk=(1.5, 3.0))


@pytest.fixture(autouse=True)
def _without_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """The σ over the scene are not asked for here, and take half of the time."""
    monkeypatch.setattr(solution, "accuracy_grid", lambda *_: None)


@pytest.mark.slow
def test_heights_that_climb_do_not_tilt_the_survey() -> None:
    result = solved(CLIMB, seed=1)
    # As independent errors, 100 m over 88 m of lines would tilt it by more than 40°.
    assert np.degrees(np.linalg.norm(result.tilt_rad)) < 8.0
    assert result.normalised < 9.0
    assert "position-drift" in result.codes
    factors = {factor.group: factor.applied for factor in result.posterior.solution.variance_factors}
    assert factors["vertical drift"] > 50.0
    # The mean of the drift is not seen either: no height is known to metres.
    assert np.sqrt(result.posterior.of_similarity[6, 6]) > 15.0


def test_no_drift_is_seen_where_there_is_none() -> None:
    result = solved(Drift(), seed=2)
    assert not {"position-drift", "ground-steep", "sigma-rejected", "other-photographs"} & result.codes
    assert all(factor.applied == 1.0 for factor in result.posterior.solution.variance_factors)
    assert np.sqrt(result.posterior.of_similarity[6, 6]) < 4.0


@pytest.mark.parametrize("receiver", ["RTK fixed", "PPK of a service"])
def test_fixes_with_corrections_do_not_drift(receiver: str) -> None:
    rng = np.random.default_rng(0)
    of = Drift(receiver=receiver)
    scene = flight(of, rng)
    survey, model = survey_with(of, scene, rng), sparse_model(scene, Noise(), rng)
    start = initial_product(scene.geo_from_local.to_record("local", "geo"))
    problem = problem_of(initial_scene(model, survey, start), survey)
    assert not survey.drifts
    assert {term.kind for term in problem.terms} == {"fixes", "systematic errors"}
    assert [block.name for block in problem.errors.blocks] == ["bias"]


def test_shapes_have_the_covariance_of_the_drift() -> None:
    time_s = np.sort(np.random.default_rng(0).uniform(0, 400, 60))
    shapes = drift_shapes(time_s, 300.0)
    expected = np.exp(-np.abs(time_s[:, None] - time_s) / 300.0)
    center = np.eye(60) - 1 / 60
    expected = center @ expected @ center
    np.testing.assert_allclose(shapes @ shapes.T, expected, atol=0.06)
    assert np.trace(shapes @ shapes.T) == pytest.approx(np.trace(expected), rel=0.06)
    assert drift_shapes(np.full(10, 5.0), 300.0).shape == (10, 0)
    assert np.isfinite(drift_shapes(np.full(10, np.nan), 300.0)).all()


def views(pitch_deg: float, roll_deg: float, swing_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Rotations cam ← geo of lines in four headings, of a camera with a mount and a swing of its own."""
    heading = np.repeat([0.0, np.pi, np.pi / 2, -np.pi / 2] * 3, 6)
    upright = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # looks down, top of the picture north
    mount = exp_so3([np.radians(pitch_deg), 0, 0]) @ exp_so3([0, np.radians(roll_deg), 0])
    held = exp_so3(rng.normal(0, np.radians(swing_deg), (len(heading), 3)))
    turned = exp_so3(heading[:, None] * [0.0, 0.0, 1.0]) @ upright @ mount @ held
    return np.swapaxes(turned, 1, 2)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (35.0, 0.0), (0.0, 6.0), (70.0, 2.0)])
@pytest.mark.parametrize("swing_deg", [0.5, 3.0, 15.0])
def test_level_by_views_is_as_good_as_its_sigma(pitch_deg: float, roll_deg: float, swing_deg: float) -> None:
    rng = np.random.default_rng(int(pitch_deg + roll_deg))
    local_from_geo = exp_so3([0.4, 2.0, -0.7])
    seen = views(pitch_deg, roll_deg, swing_deg, rng)
    level = level_by_views(seen @ local_from_geo.T, np.ones(len(seen), dtype=np.int64))
    angle = np.degrees(np.arccos(np.clip(level.up_in_local @ local_from_geo[:, 2], -1, 1)))
    assert angle < 3 * np.degrees(level.sigma_rad)
    # Steady cameras tell it to a degree; those that swing, as below a kite, to no better than their swing.
    assert np.degrees(level.sigma_rad) < 2.0 + 1.5 * swing_deg
    assert np.degrees(level.sigma_rad) > max(1.0, 0.5 * swing_deg)


def ratio(of: Drift, draws: int) -> float:
    return float(np.sqrt(np.mean([solved(of, seed).normalised for seed in range(draws)])))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "draws"),
    [
        (CLIMB, 12),
        (WALK, 12),
        (Drift(climb_m=-80.0, walk=(0.5, 1.0), pitch_deg=25.0), 12),
        (Drift(climb_m=100.0, times=False), 12),
    ],
    ids=["climb", "walk", "oblique", "without times"],
)
def test_sigma_of_the_tilt_is_true(of: Drift, draws: int) -> None:
    # 24 values know their root mean square to 14 %.
    assert 0.7 < ratio(of, draws) < 1.4


@pytest.mark.slow
def test_sigma_of_the_tilt_holds_what_one_heading_does_not_tell() -> None:
    # Nothing but the assumption of a view straight down, without roll, levels such a flight.
    assert ratio(Drift(climb_m=90.0, wobble_deg=1.5, lean_deg=3.0, headings=False), draws=8) < 1.4
