"""Places of floaters: before a measured surface, and far from all others."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.clean.floaters import LEAST_VIEWS, SIGMA_DEPTH, MeasuredView, before_surface, isolated
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.splat.gaussians import Gaussians

CAMERA = Pinhole(80, 60, 80.0, 80.0, 40.0, 30.0)
HEIGHT_M = 20.0
SIGMAS = 4.0


def looking_down(places: list[tuple[float, float]], *, hole: bool = False) -> list[MeasuredView]:
    """Return depth maps of level ground, from cameras that look down on it."""
    depth = np.full((60, 80), HEIGHT_M, dtype=np.float32)
    if hole:
        depth[20:40, 30:50] = 0
    down = np.diag([1.0, -1.0, -1.0])
    return [MeasuredView(ViewPose(CAMERA, down, np.array([x, y, HEIGHT_M])), depth) for x, y in places]


def discs(height_m: list[float], sigma_up_m: float = 0.001) -> Gaussians:
    """Return Gaussians above the middle, of a σ along the vertical."""
    count = len(height_m)
    return Gaussians(
        torch.tensor([[0.0, 0.0, height] for height in height_m]),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.tensor([0.2, 0.2, sigma_up_m]).log().repeat(count, 1),
        torch.zeros(count),
        torch.zeros(count, 1, 3),
    )


VIEWS = [(0.0, 0.0), (1.0, 0.0), (0.0, 2.0), (-2.0, 1.0)]


def test_distance_counts_in_sigmas_of_the_surface() -> None:
    # At the height z the surface's σ is 0.5 % of the depth, 20 − z: 4 σ are 0.4 m on the ground.
    limit_m = SIGMAS * SIGMA_DEPTH * HEIGHT_M
    heights = [-2.0, 0.0, 0.9 * limit_m, 1.1 * limit_m, 3.0, 15.0]
    found = before_surface(discs(heights), looking_down(VIEWS), SIGMAS)
    assert found.tolist() == [False, False, False, True, True, True]


@pytest.mark.parametrize(("sigma_up_m", "floats"), [(0.1, True), (0.45, True), (0.6, False)])
def test_large_gaussian_touches_what_is_behind(sigma_up_m: float, floats: bool) -> None:
    """Two metres above the ground, 4 σ of 0.6 m reach it; the rays are nearly plumb."""
    assert before_surface(discs([2.0], sigma_up_m), looking_down(VIEWS), SIGMAS).tolist() == [floats]


def test_views_must_be_enough_and_must_have_measured() -> None:
    few = looking_down(VIEWS[: LEAST_VIEWS - 1])
    assert not before_surface(discs([5.0]), few, SIGMAS).any()
    assert not before_surface(discs([5.0]), looking_down(VIEWS[:3], hole=True), SIGMAS).any()
    assert before_surface(discs([5.0]), looking_down(VIEWS[:3]), SIGMAS).all()


def test_isolated_are_few_far_from_the_others() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-20, 20, (4000, 2)), rng.normal(0, 0.02, 4000)])
    sparse = np.column_stack([rng.uniform(20, 40, (300, 1)), rng.uniform(-20, 20, (300, 1)), np.zeros(300)])
    single, clump = np.array([[0.0, 0, 9]]), np.array([10.0, 5.0, 12.0]) + rng.normal(0, 0.1, (7, 3))
    sky = np.array([[0.0, 0, 90]])
    place = np.concatenate([ground, sparse, single, clump, sky])
    sigma = np.concatenate([np.full(4000, 0.3), np.full(300, 1.0), [0.2], np.full(7, 0.2), [40.0]])
    found = isolated(place, sigma)
    assert not found[:4300].any()
    assert found[4300:4308].all()  # one, and a clump of seven
    assert not found[4308]  # as large as its distance
    assert not isolated(place[:8], sigma[:8]).any()
