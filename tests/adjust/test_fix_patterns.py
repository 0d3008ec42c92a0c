"""Lag and lever arm of fixes against the motion of the cameras: found where determined, else not blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pipelines.adjust.calibrate import lag_of, with_lag
from pipelines.adjust.fix_patterns import level_axes, pattern_of
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.navigation import FIX_LAG, FIX_LAG_OPEN, RigCalibration, at_exposures
from pipelines.survey.survey import Survey
from tests.refusals import codes, numbers, said
from tests.scenes import Measured, Noise, TrueScene, looking_at, make_scene, sparse_model, survey_of

CONSUMER, RTK = (2.5, 2.5, 5.0), (0.02, 0.02, 0.03)


def lines(count: int = 32, ahead_m: float = 12.0, pause_s: float = 9.0) -> tuple[TrueScene, np.ndarray, np.ndarray]:
    """A flight in lines of eight, to and fro, nadir with the nose ahead: scene, times (n,), velocities (n, 3)."""
    line, along = np.divmod(np.arange(count), 8)
    way = np.where(line % 2, -1.0, 1.0)
    east = way * (along - 3.5) * ahead_m
    center = np.column_stack([east, 14.0 * line - 20.0, np.full(count, 80.0)])
    time_s = 2.0 * np.arange(count) + pause_s * line
    velocity = np.column_stack([way * ahead_m / 2.0, np.zeros(count), np.zeros(count)])
    target = center + np.column_stack([way * 1e-3, np.zeros(count), np.full(count, -80.0)])
    scene = make_scene("grid", images=count, points=120)
    return replace(scene, center_in_geo=center, geo_from_cam=looking_at(center, target)), time_s, velocity


def rings(count: int = 40, speed_m_s: float = 15.0) -> tuple[TrueScene, np.ndarray, np.ndarray]:
    """Two circles at two heights, looking inward: scene, times (n,), velocities (n, 3)."""
    scene = make_scene("orbit", images=count, points=120)
    center = scene.center_in_geo
    step_m = np.linalg.norm(np.diff(center[:, :2], axis=0), axis=1).mean()
    tangent = np.column_stack([-center[:, 1], center[:, 0], np.zeros(count)])
    velocity = speed_m_s * tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    return scene, step_m / speed_m_s * np.arange(count), velocity


def measured(
    scene: TrueScene, time_s: np.ndarray, error_m: np.ndarray, fix_m: tuple[float, float, float], seed: int = 0
) -> tuple[Survey, SparseModel]:
    """Survey whose fixes, as of EXIF, have errors (n, 3), and the SfM model."""
    rng = np.random.default_rng(seed)
    noise = Noise(fix_m=fix_m, pixel_px=0.2)
    survey = survey_of(scene, noise, Measured(attitudes=False), rng)
    images = []
    for image, when, error in zip(survey.images, time_s.tolist(), error_m, strict=True):
        assert image.fix is not None
        place = tuple((np.array(image.fix.position_in_geo) + error).tolist())
        fix = image.fix.model_copy(update={"position_in_geo": place, "source": "exif"})
        images.append(image.model_copy(update={"fix": fix, "timestamp_s": when}))
    return survey.model_copy(update={"images": tuple(images)}), sparse_model(scene, noise, rng)


def places(survey: Survey) -> np.ndarray:
    return np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])


@pytest.mark.parametrize("lag_s", [0.73, -0.77, 0.2])
@pytest.mark.parametrize("fix_m", [CONSUMER, (0.5, 0.5, 1.0), RTK], ids=["consumer", "float", "RTK"])
def test_a_lag_is_found_on_lines_in_two_directions(lag_s: float, fix_m: tuple[float, float, float]) -> None:
    """σ of the lag: that of a fix over the speed, 6 m/s, and the root of the photographs: below 0.15 s."""
    scene, time_s, velocity = lines()
    survey, model = measured(scene, time_s, -lag_s * velocity, fix_m)
    found = pattern_of(survey, model)
    assert found is not None and not found.has_arm
    assert abs(found.lag_s - lag_s) < 3.0 * found.sigma_lag_s + 2e-3
    assert found.sigma_lag_s < 0.15
    assert found.has_lag or abs(lag_s) < 5.0 * found.sigma_lag_s


def test_positions_are_moved_to_the_exposures() -> None:
    """A lag of 4 m: what is left of it is the noise of the fixes, and σ says so."""
    scene, time_s, velocity = lines()
    survey, model = measured(scene, time_s, -0.73 * velocity, (0.5, 0.5, 1.0))
    calibration = with_lag(survey, model, None, RigCalibration())
    assert calibration.fix_lag is not None and calibration.fix_lag.applied
    moved = at_exposures(survey, calibration.fix_lag)
    before, after = (np.abs(places(one) - scene.center_in_geo)[:, 0].mean() for one in (survey, moved))
    assert before > 3.5 and after < 0.6
    value, sigma = numbers(said(moved.cautions, FIX_LAG))[:2]
    assert abs(value - 0.73) < 3.0 * sigma + 0.01  # two digits
    whitened = [
        np.linalg.solve(np.linalg.cholesky(image.fix.cov_in_geo), np.array(image.fix.position_in_geo) - center)
        for image, center in zip(moved.images, scene.center_in_geo, strict=True)
        if image.fix is not None
    ]
    assert 0.7 < float(np.sqrt(np.square(whitened).mean())) < 1.4


def test_a_lag_that_one_direction_leaves_open_is_a_sigma_along_the_motion() -> None:
    scene, time_s, velocity = rings(speed_m_s=8.0)
    survey, model = measured(scene, time_s, 0.0 * velocity, CONSUMER)
    found = pattern_of(survey, model)
    assert found is not None and not found.has_lag
    lag = lag_of(survey, found)
    assert 0.3 <= lag.sigma_along_s <= found.sigma_lag_s
    widened = at_exposures(survey, lag)
    np.testing.assert_array_equal(places(widened), places(survey))
    assert FIX_LAG_OPEN in codes(widened.cautions)
    ahead = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    for image, forward in zip(widened.images, ahead, strict=True):
        assert image.fix is not None
        sigma = np.sqrt(forward @ np.array(image.fix.cov_in_geo) @ forward)
        assert sigma == pytest.approx(np.hypot(2.5, lag.sigma_along_s * 8.0), rel=0.05)


@pytest.mark.parametrize("arm_m", [(1.0, 0.0), (0.8, -0.3), (-0.7, 0.0)])
def test_a_lever_arm_is_found_where_the_camera_turns(arm_m: tuple[float, float]) -> None:
    """Two circles at two heights: another scale explains the arm on one of them, not on both."""
    scene, time_s, _ = rings()
    error = level_axes(scene.geo_from_cam) @ np.array(arm_m)
    survey, model = measured(scene, time_s, error, RTK)
    found = pattern_of(survey, model)
    assert found is not None and found.has_arm and not found.has_lag
    assert (np.abs(found.arm_m - arm_m) < 3.0 * found.sigma_arm_m).all()


def test_a_late_clock_in_an_orbit_is_no_lever_arm() -> None:
    """0.2 s at 15 m/s turn the whole flight; what the second circle shows of it is the pattern of a lag."""
    scene, time_s, _ = rings()
    error = CubicSpline(time_s, scene.center_in_geo)(time_s - 0.2) - scene.center_in_geo
    assert np.linalg.norm(error, axis=1).mean() > 2.5
    found = pattern_of(*measured(scene, time_s, error, RTK))
    assert found is not None and found.has_lag and not found.has_arm
    assert abs(found.lag_s - 0.2) < 0.03  # 0.45 m of 3 m


@pytest.mark.parametrize("fix_m", [CONSUMER, RTK], ids=["consumer", "RTK"])
@pytest.mark.parametrize("flight", [lines, rings])
def test_a_clean_flight_has_no_pattern(flight, fix_m: tuple[float, float, float]) -> None:  # type: ignore[no-untyped-def]
    """Of four seeds none, also where errors drift as those of receivers do."""
    scene, time_s, _ = flight()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        phase, period_s = rng.uniform(0, 2 * np.pi, 3), rng.uniform(40.0, 120.0, 3)
        drift = np.array(fix_m) * np.sin(2 * np.pi * time_s[:, None] / period_s + phase)
        found = pattern_of(*measured(scene, time_s, drift, fix_m, seed))
        assert found is None or not (found.has_lag or found.has_arm), seed


def test_photographs_without_times_have_no_lag() -> None:
    scene, time_s, velocity = lines()
    survey, model = measured(scene, time_s, -0.73 * velocity, RTK)
    timeless = tuple(image.model_copy(update={"timestamp_s": None}) for image in survey.images)
    assert pattern_of(survey.model_copy(update={"images": timeless}), model) is None
    assert (
        with_lag(survey.model_copy(update={"images": timeless}), model, None, RigCalibration()) == RigCalibration()
    )


def test_a_lag_that_leaves_most_of_the_scatter_is_none() -> None:
    """Against a bent model a lag lowers the residuals a little, and explains nothing."""
    scene, time_s, velocity = lines()
    bend = np.random.default_rng(1).normal(0, 9.6, (len(time_s), 3)) * [1.0, 1.0, 0.3]
    survey, model = measured(scene, time_s, bend - 1.2 * velocity, (1.0, 1.0, 2.0))
    found = pattern_of(survey, model)
    assert found is None or not found.has_lag
