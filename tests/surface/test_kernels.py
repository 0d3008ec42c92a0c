"""The kernels of stereo against plain, slow versions of the same sums."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.cameras import Pinhole
from pipelines.surface.agreement import AgreementSettings, agreed_depth
from pipelines.surface.matching import UNSEEN, Matcher, MatchSettings, StereoView, WinnerTakesAll
from tests.stereo_oracles import agreed_by_numpy, score_of_depth
from tests.stereo_scenes import depth_estimate, neighbours_of, ring_of_views, true_depth

# float32: sums of squares of grey levels have an error of 1e-7, that is 0.01 grey levels² of a variance of 0.3
# or more; and OpenCV's remap, in the oracle, takes places in steps of 1/32 px.
TOLERANCE = 0.03


@pytest.fixture(scope="module")
def ring() -> list[StereoView]:
    return ring_of_views(Pinhole(60, 44, 55.0, 55.0, 30.0, 22.0))


@pytest.mark.parametrize("match", [MatchSettings(), MatchSettings(window_px=3, reach_px=2, views=9)])
@pytest.mark.parametrize("off_m", [0.0, 3.0, -60.0])
def test_scores_are_those_of_the_plain_version(ring: list[StereoView], match: MatchSettings, off_m: float) -> None:
    """At the true depth, beside it, and where part of the hypothesis lies behind the camera."""
    depth = (true_depth(ring[2].camera) + off_m * np.linspace(0.5, 1, 60)).astype(np.float32)
    neighbours = neighbours_of(ring, 2)
    score = Matcher(ring[2], neighbours, match)(depth)
    plain = score_of_depth(ring[2], neighbours, depth, match)
    # A place within 1/32 px of the image's end is inside for one version alone.
    assert np.quantile(np.abs(score - plain), 0.99) < TOLERANCE
    assert (score[depth <= 0] == UNSEEN).all()


def test_rows_have_the_scores_that_they_have_in_the_whole_view(ring: list[StereoView]) -> None:
    match = MatchSettings(reach_px=2)
    matcher, depth = Matcher(ring[2], neighbours_of(ring, 2), match), true_depth(ring[2].camera).astype(np.float32)
    whole, part = matcher(depth), matcher(depth, slice(8, 40))
    inner = slice(8 + match.support_px, 40 - match.support_px)
    np.testing.assert_allclose(part[match.support_px : -match.support_px], whole[inner], atol=1e-4)


def test_neighbours_of_different_sizes_and_hypotheses_without_end(ring: list[StereoView]) -> None:
    larger = ring_of_views(Pinhole(90, 66, 82.5, 82.5, 45.0, 33.0))
    depth = true_depth(ring[2].camera).astype(np.float32)
    neighbours = [ring[1], larger[3]]
    plain = score_of_depth(ring[2], neighbours, depth, MatchSettings())
    assert np.quantile(np.abs(Matcher(ring[2], neighbours, MatchSettings())(depth) - plain), 0.99) < TOLERANCE
    depth[5:9] = [[np.nan], [np.inf], [-np.inf], [0.0]]
    score = Matcher(ring[2], neighbours, MatchSettings())(depth)
    assert (score[5:9] == UNSEEN).all()
    assert np.isfinite(score).all()


def test_agreement_is_that_of_the_plain_version() -> None:
    ring = ring_of_views()
    surfaces = [depth_estimate(ring, index) for index in range(5)]
    others = [surfaces[index] for index in (0, 1, 3, 4)]
    agreed = agreed_depth(surfaces[2], others, AgreementSettings())
    plain = agreed_by_numpy(surfaces[2], others, AgreementSettings())
    # Rounding decides for a pixel on the border of a threshold: one in a thousand at the most.
    assert ((agreed > 0) == (plain > 0)).mean() > 0.999
    both = (agreed > 0) & (plain > 0)
    assert both.mean() > 0.5
    assert np.quantile(np.abs(agreed - plain)[both], 0.999) < 1e-4


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), count=st.integers(3, 9))
def test_the_winner_is_the_largest_score_with_the_scores_around_it(seed: int, count: int) -> None:
    scores = np.random.default_rng(seed).uniform(-0.9, 1.0, (count, 4, 5)).astype(np.float32)
    search = WinnerTakesAll((4, 5))
    for score in scores:
        search.add(score)
    winner, best = search.winner(), scores.argmax(axis=0)
    np.testing.assert_array_equal(winner.score, scores.max(axis=0))
    np.testing.assert_array_equal(winner.inner, (best > 0) & (best < count - 1))
    assert (np.abs(winner.hypothesis - best) <= 0.5).all()
    padded = np.concatenate([scores[:1], scores, scores[-1:]])
    before, after = (np.take_along_axis(padded, best[None] + k, axis=0)[0] for k in (0, 2))
    parabola = best + 0.5 * (after - before) / (2 * winner.score - before - after)
    np.testing.assert_allclose(winner.hypothesis[winner.inner], parabola[winner.inner].clip(0, count), atol=1e-3)
