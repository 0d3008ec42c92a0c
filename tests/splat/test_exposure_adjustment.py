"""Exposures from the colours of points: against the truth of drawn colours and exposures."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.splat.exposure import PointColours, adjusted_exposures

NOISE = 0.01


def flight(images: int, seed: int, *, outliers: float = 0.0) -> tuple[PointColours, np.ndarray, np.ndarray]:
    """Photographs in a row, each point in five neighbours; exposures whose mean is the identity; the colours."""
    rng = np.random.default_rng(seed)
    points = 30 * images
    first = np.clip(np.sort(rng.uniform(0, images, points)).astype(int) - 2, 0, images - 5)
    point, image = np.repeat(np.arange(points), 5), (first[:, None] + np.arange(5)).ravel()
    colour = np.clip(rng.uniform(0.2, 0.8, (points, 1)) + rng.normal(0, 0.06, (points, 3)), 0.05, 0.95)
    change = np.zeros((images, 3, 4))
    change[:, range(3), range(3)] = rng.normal(0, 0.15, (images, 1)) + rng.normal(0, 0.03, (images, 3))
    exposure = np.eye(3, 4) + change - change.mean(axis=0)
    shown = seen_as(exposure[image], colour[point]) + rng.normal(0, NOISE, (len(point), 3))
    spoilt = rng.random(len(point)) < outliers
    shown[spoilt] = rng.random((int(spoilt.sum()), 3))
    return PointColours(point, image, shown.astype(np.float32)), exposure, colour


def seen_as(exposure: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Colours (M, 3) under exposures (M, 3, 4)."""
    return np.asarray((exposure[:, :, :3] @ colour[:, :, None])[:, :, 0] + exposure[:, :, 3])


def colour_errors(found: np.ndarray, true: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Root mean squares (n,) of the error of a photograph's colours."""
    change = (found - true)[:, None]
    errors = (change[..., :3] @ colour[:100, :, None])[..., 0] + change[..., 3]
    return np.asarray(np.sqrt((errors**2).mean(axis=(1, 2))))


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_exposures_are_those_of_the_photographs(outliers: float) -> None:
    observed, true, colour = flight(24, 0, outliers=outliers)
    found = adjusted_exposures(observed, 24, np.arange(24))
    np.testing.assert_allclose(found.mean(axis=0), np.eye(3, 4), atol=1e-12)
    # 150 observations of a photograph average its noise; the chain of 24 photographs adds it up: to half of one
    # observation's noise. Without exposures the colours differ by ten times as much.
    errors = colour_errors(found, true, colour)
    assert np.sqrt((errors**2).mean()) < NOISE / 2
    assert np.sqrt((colour_errors(np.tile(np.eye(3, 4), (24, 1, 1)), true, colour) ** 2).mean()) > 5 * NOISE


def test_photographs_without_points_keep_the_identity() -> None:
    observed, true, colour = flight(10, 1)
    moved = PointColours(observed.point, observed.image + 2, observed.colour)
    found = adjusted_exposures(moved, 13, np.arange(13))
    np.testing.assert_array_equal(found[[0, 1, 12]], np.tile(np.eye(3, 4), (3, 1, 1)))
    assert colour_errors(found[2:12], true, colour).max() < NOISE


def test_single_observations_tell_nothing() -> None:
    lone = PointColours(np.arange(4), np.arange(4), np.full((4, 3), 0.5, dtype=np.float32))
    np.testing.assert_array_equal(adjusted_exposures(lone, 4, np.arange(4)), np.tile(np.eye(3, 4), (4, 1, 1)))
