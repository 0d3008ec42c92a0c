"""A date that is adjusted onto an earlier one: is the difference of both as small, and as well known, as it says?

Both dates have positions of a consumer receiver, or of RTK, with an error that all of a date share, and no control.
Apart, the same ground lies metres apart in both solutions.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pipelines.adjust.relative import Relative, relative
from pipelines.geodesy.enu import Origin, ecef_from_enu_rotation, lla_of
from pipelines.geometry.statistics import outlier_gate
from tests.two_dates import ASIDE, CHECK, COMMON, CONSUMER, HERE, RTK, Date, Receiver, common_of, draw_date, ground

pytestmark = pytest.mark.usefixtures("one_thread")
DRAWS = 6
IDS = tuple(range(1, COMMON + 1))
IN_A_CORNER = "common-points-in-a-corner"


@pytest.fixture(autouse=True)
def _coarse_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """σ over the scene vary slowly: forty cells show them."""
    monkeypatch.setattr("pipelines.adjust.accuracy_grid._CELLS", 6)


@cache
def pair(
    seed: int,
    receiver: Receiver = CONSUMER,
    earlier_origin: Origin = HERE,
    ids: tuple[int, ...] = IDS,
    **later: object,
) -> tuple[Date, Date, Relative]:
    """Return two dates, which nobody changes, and their difference."""
    rng = np.random.default_rng(seed)
    earlier = draw_date(0, rng, receiver=receiver, origin=earlier_origin)
    common = common_of(earlier, np.array(ids))
    tied = draw_date(1, rng, receiver=receiver, common=common, **later)  # type: ignore[arg-type]
    assert tied.survey.common is not None
    return earlier, tied, relative(tied.solved, earlier.solved, tied.survey.common)


def apart(earlier: Date, later: Date) -> np.ndarray:
    """Later minus earlier place (J, 3) of check points, east, north, up."""
    return (later.seen(CHECK) - earlier.seen(CHECK)) @ ecef_from_enu_rotation(lla_of(HERE))


@pytest.mark.parametrize(("receiver", "origin"), [(CONSUMER, HERE), (CONSUMER, ASIDE), (RTK, ASIDE)])
def test_difference_is_as_well_known_as_it_says(receiver: Receiver, origin: Origin) -> None:
    squares, errors = [], []
    for seed in range(DRAWS):
        earlier, later, found = pair(seed, receiver, origin)
        assert found.grid is not None
        error = apart(earlier, later)
        squares.append(error**2 / np.diagonal(found.grid.cov_at(CHECK), axis1=1, axis2=2))
        errors.append(error)
        # Both share the place on Earth, which their own positions know to metres, or to centimetres.
        total = np.sqrt(np.diag(later.posterior.of_similarity)[4:])
        assert (total > 0.4 * np.array(receiver.common_m)).all()
    # Half a pixel is 4 cm on the ground, and sixty points carry it: the difference is known to a tenth of that.
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
    # The twelve points of a draw share most of their error: twenty values, σ of the mean 0.3.
    assert 0.5 < np.mean(squares) < 1.7
    assert found.used.mean() > 0.95


def test_apart_the_dates_differ_by_the_errors_of_their_positions() -> None:
    rng = np.random.default_rng(3)
    earlier, later = draw_date(0, rng), draw_date(1, rng)
    assert np.abs(apart(earlier, later)).max() > 0.5


@pytest.mark.slow
def test_moved_ground_is_left_out() -> None:
    # A quarter of the points, all in the east, have risen by half a metre.
    moved = tuple(np.argsort(-ground()[:COMMON, 0])[: COMMON // 4].tolist())
    earlier, later, found = pair(1, moved=moved, by_m=0.5)
    assert not found.used[list(moved)].any()
    assert found.used.mean() > 0.7
    assert np.sqrt(np.mean(apart(earlier, later) ** 2)) < 0.03
    np.testing.assert_allclose(found.missed_m[list(moved), 2], 0.5, atol=0.1)


@pytest.mark.slow
def test_a_lens_that_is_wrong_at_one_date_domes_no_difference() -> None:
    """k1 is wrong by 5 % at one date: both take one shape, as points in common are everywhere."""
    squares, errors = [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng(60 + seed)
        earlier_wrong, later_wrong = (0.05, 0.0) if seed % 2 else (0.0, 0.05)
        earlier = draw_date(0, rng, k1_wrong=earlier_wrong)
        later = draw_date(1, rng, common=common_of(earlier, np.array(IDS)), k1_wrong=later_wrong)
        assert later.survey.common is not None
        found = relative(later.solved, earlier.solved, later.survey.common)
        assert found.grid is not None
        errors.append(apart(earlier, later))
        squares.append(errors[-1] ** 2 / np.diagonal(found.grid.cov_at(CHECK), axis1=1, axis2=2))
        assert found.used.mean() > 0.9
    assert np.sqrt(np.mean(np.square(errors))) < 0.02  # a quarter of a pixel on the ground, as without
    assert 0.5 < np.mean(squares) < 1.7  # of twenty values, as without


def test_points_in_a_corner_know_less_beyond_it() -> None:
    corner = tuple((np.argsort(ground()[:COMMON].sum(axis=1))[:12] + 1).tolist())
    _, _, everywhere = pair(2)
    earlier, later, found = pair(2, ids=corner)
    assert found.grid is not None
    assert everywhere.grid is not None
    far, near = np.array([[8.0, 8.0, 0.0]]), np.array([[-6.0, -6.0, 0.0]])
    sigma = [np.sqrt(np.diagonal(found.grid.cov_at(place)[0])) for place in (far, near)]
    assert (sigma[0] > 1.5 * sigma[1]).all()
    assert (sigma[0] > 2 * np.sqrt(np.diagonal(everywhere.grid.cov_at(far)[0]))).all()
    cov = found.grid.cov_at(CHECK)
    squared = np.einsum("ji,jik,jk->j", apart(earlier, later), np.linalg.inv(cov), apart(earlier, later))
    assert np.median(squared) < outlier_gate(3)


def test_few_points_are_a_caution() -> None:
    _, later, _ = pair(2, ids=IDS[:12])
    assert "few-common-points" in {one.code for one in later.posterior.solution.cautions}
    _, later, _ = pair(2)
    assert not {"few-common-points", IN_A_CORNER} & {one.code for one in later.posterior.solution.cautions}


def test_points_in_a_corner_are_a_caution() -> None:
    rng = np.random.default_rng(2)
    earlier = draw_date(0, rng)
    later = draw_date(1, rng, common=common_of(earlier, np.array(IDS), spread=0.2))
    assert IN_A_CORNER in {one.code for one in later.posterior.solution.cautions}


@pytest.mark.slow
def test_a_better_own_place_is_told() -> None:
    # RTK at the later date finds the metre by which a consumer receiver had put the earlier one.
    rng = np.random.default_rng(4)
    earlier = draw_date(0, rng, receiver=CONSUMER)
    later = draw_date(1, rng, receiver=RTK, common=common_of(earlier, np.array(IDS)))
    solution = later.posterior.solution
    assert "earlier-date-less-accurate" in {one.code for one in solution.cautions}
    (error,) = (one for one in solution.estimated_errors if one.name == "earlier-date")
    missed = (earlier.seen(CHECK).mean(axis=0) - later.seen(CHECK).mean(axis=0)) @ ecef_from_enu_rotation(
        lla_of(HERE)
    )
    np.testing.assert_allclose(missed, 0.0, atol=0.03)  # the later date lies where the earlier does, all the same
    assert max(error.sigma) < 0.1
    assert np.abs(error.value).max() > 0.5


def test_the_solution_says_what_it_is_tied_to() -> None:
    _, later, found = pair(5)
    record = later.posterior.solution.earlier
    assert record is not None
    assert record.points == COMMON
    assert record.used == int(found.used.sum())
    factors = {one.group: one for one in later.posterior.solution.variance_factors}
    assert factors["common points"].count == COMMON
    assert factors["common points"].estimated == pytest.approx(1.0, abs=0.4)
