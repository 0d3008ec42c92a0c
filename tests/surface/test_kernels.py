"""The kernels of stereo against plain, slow versions of the same sums, by OpenCV and numpy, an image at a time."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.types import Float32Array
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.surface.agreement import FREE, LEAST_SCORE, LEAST_VIEWS, MOST_THROUGH, SAME_STEPS, agreed_depth
from pipelines.surface.matching import (
    NOISE_VARIANCE,
    UNSEEN,
    Matcher,
    MatchSettings,
    StereoView,
    WinnerTakesAll,
    camera_matrix,
    is_hypothesis,
)
from pipelines.surface.sweep import SweepResult
from tests.cli_runs import REPOSITORY
from tests.stereo_scenes import depth_estimate, neighbours_of, ring_of_views, true_depth

# float32: sums of squares of grey levels have an error of 1e-7, that is 0.01 grey levels² of a variance of 0.3
# or more; and OpenCV's remap, in the oracle, takes places in steps of 1/32 px.
TOLERANCE = 0.03


def score_of_depth(
    reference: StereoView, neighbours: list[StereoView], depth: np.ndarray, settings: MatchSettings
) -> Float32Array:
    """Return the score (H, W) of depths (H, W), step by step as `Matcher` describes it."""
    grey = reference.grey.astype(np.float32)
    scores = [correlation(grey, warped(reference.camera, other, depth), settings) for other in neighbours]
    largest = np.sort(np.stack(scores), axis=0)[::-1][:3]
    guide = cv2.ximgproc.createGuidedFilter(grey, settings.reach_px, settings.edge_grey**2)
    return np.asarray(guide.filter(np.ascontiguousarray(largest.mean(axis=0), dtype=np.float32)))


def warped(camera: ViewPose, other: StereoView, depth: np.ndarray) -> Float32Array:
    """Return the other view's grey levels (H, W) at the depths of a camera's rays; 0 outside its image."""
    place = camera.center_in_model + np.maximum(depth, 0)[..., None] * camera.rays() - other.camera.center_in_model
    x, y, z = np.moveaxis(place @ (camera_matrix(other.camera.pinhole, 0.5) @ other.camera.cam_from_model).T, -1, 0)
    u, v = (along / np.where(z > 0, z, 1) for along in (x, y))
    height, width = other.grey.shape
    inside = (z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = (np.where(inside, along, 0).astype(np.float32) for along in (u, v))
    grey = other.grey.astype(np.float32)
    return np.where(inside, cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), 0)


def correlation(image: Float32Array, other: Float32Array, settings: MatchSettings) -> Float32Array:
    """Return the normalised cross-correlation (H, W) over square windows; −1 where `other` is 0."""

    def mean(values: np.ndarray) -> np.ndarray:
        side = (settings.window_px, settings.window_px)
        return np.asarray(cv2.boxFilter(values.astype(np.float64), -1, side, borderType=cv2.BORDER_REFLECT))

    def variance(values: np.ndarray) -> np.ndarray:
        return np.maximum(mean(values.astype(np.float64) ** 2) - mean(values) ** 2, NOISE_VARIANCE)

    product = mean(image.astype(np.float64) * other) - mean(image) * mean(other)
    level = product / np.sqrt(variance(image) * variance(other))
    return np.where(other == 0, UNSEEN, level).astype(np.float32)


def agreed_by_numpy(reference: SweepResult, others: list[SweepResult]) -> np.ndarray:
    """Return the depths (H, W) of `agreed_depth`, from whole arrays."""
    own, rays = reference.depth(), reference.camera.rays()
    good = (reference.score > LEAST_SCORE) & np.isfinite(own) & (own > 0)
    point = reference.camera.center_in_model + np.where(good, own, 1.0)[..., None] * rays
    weight = (reference.normals.offset_per_metre(reference.camera) * reference.sharpness) ** 2
    total, agree, through = np.zeros(own.shape), np.zeros(own.shape), np.zeros(own.shape)
    for other in others:
        camera, sweep = other.camera, other
        in_cam = (point - camera.center_in_model) @ camera.cam_from_model.T
        ahead, pinhole = np.where(in_cam[..., 2] > 0, in_cam[..., 2], 1.0), camera.pinhole
        column = np.floor(pinhole.fx * in_cam[..., 0] / ahead + pinhole.cx).astype(int)
        row = np.floor(pinhole.fy * in_cam[..., 1] / ahead + pinhole.cy).astype(int)
        seen = (in_cam[..., 2] > 0) & (row >= 0) & (row < camera.pinhole.height)
        seen &= (column >= 0) & (column < camera.pinhole.width)
        row, column = np.where(seen, row, 0), np.where(seen, column, 0)
        seen &= sweep.score[row, column] > LEAST_SCORE
        normal = sweep.normals.normal_in_model[row, column]
        offset = (point * normal).sum(axis=-1)
        residual, along = sweep.offset_m[row, column] - offset, (rays * normal).sum(axis=-1)
        through += seen & (residual / (offset - normal @ camera.center_in_model) > FREE)
        near = seen & (np.abs(residual) < SAME_STEPS * sweep.step_m[row, column])
        near &= np.abs(residual / along) < 0.1 * own
        of_view = np.where(near, (along * sweep.sharpness[row, column]) ** 2, 0.0)
        total += of_view * np.where(near, residual / along, 0.0)
        weight = weight + of_view
        agree += near
    agreed = good & (agree >= LEAST_VIEWS) & (through < MOST_THROUGH * agree)
    return np.where(agreed, own + total / weight, 0.0)


@pytest.fixture(scope="module")
def ring() -> list[StereoView]:
    return ring_of_views(Pinhole(60, 44, 55.0, 55.0, 30.0, 22.0))


@pytest.mark.parametrize("match", [MatchSettings(), MatchSettings(window_px=3, reach_px=2)])
@pytest.mark.parametrize("off_m", [0.0, 3.0, -60.0])
def test_scores_are_those_of_the_plain_version(ring: list[StereoView], match: MatchSettings, off_m: float) -> None:
    """At the true depth, beside it, and where part of the hypothesis lies behind the camera."""
    depth = (true_depth(ring[2].camera) + off_m * np.linspace(0.5, 1, 60)).astype(np.float32)
    neighbours = neighbours_of(ring, 2)
    score = Matcher(ring[2], neighbours, match)(depth)
    plain = score_of_depth(ring[2], neighbours, depth, match)
    # A place within 1/32 px of the image's end is inside for one version alone.
    assert np.quantile(np.abs(score - plain)[depth > 0], 0.99) < TOLERANCE


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
    assert np.isfinite(score).all()
    search = WinnerTakesAll(score.shape)
    search.add(score, is_hypothesis(depth))
    assert (search.winner().score[5:9] == UNSEEN).all()


def test_agreement_is_that_of_the_plain_version() -> None:
    ring = ring_of_views()
    surfaces = [depth_estimate(ring, index) for index in range(5)]
    others = [surfaces[index] for index in (0, 1, 3, 4)]
    agreed = agreed_depth(surfaces[2], others)
    plain = agreed_by_numpy(surfaces[2], others)
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
        search.add(score, np.ones(score.shape, np.bool_))
    winner, best = search.winner(), scores.argmax(axis=0)
    np.testing.assert_array_equal(winner.score, scores.max(axis=0))
    np.testing.assert_array_equal(winner.inner, (best > 0) & (best < count - 1))
    assert (np.abs(winner.hypothesis - best) <= 0.5).all()
    padded = np.concatenate([scores[:1], scores, scores[-1:]])
    before, after = (np.take_along_axis(padded, best[None] + k, axis=0)[0] for k in (0, 2))
    parabola = best + 0.5 * (after - before) / (2 * winner.score - before - after)
    np.testing.assert_allclose(winner.hypothesis[winner.inner], parabola[winner.inner].clip(0, count), atol=1e-3)


def test_depth_maps_load_without_opencvs_contributed_modules() -> None:
    """A machine without them can train on depth maps that exist."""
    code = "import cv2; vars(cv2).pop('ximgproc', None); import pipelines.surface.depth_maps as m; print(m)"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
    assert "depth_maps.py" in done.stdout
