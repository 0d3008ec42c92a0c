"""Sessions of fixes with a common error: are σ true with it, and do control points take it away?

Check points share the common error, so that their errors count through their joint covariance C: the mean of
eᵀ C⁻¹ e over the degrees of freedom is 1 where all σ are true, whatever the points share.
"""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.adjust import solution
from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from tests.drawn_surveys import Flight, Receiver, drawn, flight, missed, surveyed

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
RTK = Receiver((0.01, 0.01, 0.01), (0.03, 0.03, 0.05))
CONSUMER = Receiver((2.5, 2.5, 5.0), (2.0, 2.0, 4.0))
# PPK has the σ of RTK: one profile serves for both.
PROFILES = {"rtk, control": (RTK, 0.01), "rtk": (RTK, None), "consumer": (CONSUMER, None)}


@pytest.fixture(autouse=True)
def _without_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """The σ over the scene are not asked for here, and take time."""
    monkeypatch.setattr(solution, "accuracy_grid", lambda *_: None)


def normalised(of: Flight, receiver: Receiver, control_m: float | None, draws: int) -> tuple[np.ndarray, float]:
    """eᵀ C⁻¹ e over the degrees of freedom of each draw, and the horizontal RMSE of all."""
    squares, errors = [], []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        survey = surveyed(of, drawn(of, rng), receiver, control_m, rng)
        points = geolocate(survey, of.model, GeolocateOptions()).points
        posterior, _ = estimate_similarity(survey, of.model, points, InitSim3Options())
        error, joint = missed(posterior, survey)
        squares.append(error.ravel() @ np.linalg.solve(joint, error.ravel()) / error.size)
        errors.append(error)
    return np.array(squares), float(np.sqrt((np.array(errors)[:, :, :2] ** 2).sum(axis=2).mean()))


@pytest.mark.parametrize("profile", PROFILES)
def test_sigma_is_true_with_a_common_error_of_the_fixes(profile: str) -> None:
    squares, rmse_h_m = normalised(flight(60, 400), *PROFILES[profile], draws=5)
    assert 0.6 < squares.mean() < 1.5  # σ of the mean of 5 × 36 squares: 0.1
    if PROFILES[profile][1] is not None:
        assert rmse_h_m < 0.015


@pytest.mark.parametrize("profile", PROFILES)
def test_sigma_of_four_hundred_cameras_is_true(profile: str) -> None:
    squares, rmse_h_m = normalised(flight(400, 2500), *PROFILES[profile], draws=8)
    assert 0.7 < squares.mean() < 1.4
    if PROFILES[profile][1] is not None:
        assert rmse_h_m <= 0.015
